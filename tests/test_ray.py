"""Experts asked on a Ray cluster: the bytes of one process, whatever is lost on the way."""

import os
import signal
import threading
import time
import types
from concurrent.futures import CancelledError, ThreadPoolExecutor

import numpy as np
import pytest

from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.experts.workers import on_ray

GAIN = np.random.default_rng(0).standard_normal((2, 5)).astype(np.float32)
ROWS = np.random.default_rng(1).standard_normal((60, 5)).astype(np.float32)


@pytest.mark.parametrize(
    ("workers", "rest"),
    [("rays", {}), ("ray:", {}), ("ray:0", {}), ("ray:x", {}), ("ray", {"threads": True})],
    ids=str,
)
def test_wrong_workers_are_named(workers, rest):
    with pytest.raises(SettingError, match="workers='ray"):
        load_expert(lambda rows: rows, workers=workers, **rest)
    with pytest.raises(SettingError, match="waits for a server"):
        load_expert("http://127.0.0.1:1/act", 5, 2, workers="ray")


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.mark.fault(212)
@pytest.mark.torture
@pytest.mark.usefixtures("cluster")
def test_the_bytes_are_those_of_one_process_though_a_worker_is_killed(tmp_path):
    marker = str(tmp_path / "killed")

    def frail(rows):
        if rows[0, 0] == ROWS[24, 0] and not os.path.exists(marker):
            open(marker, "w").close()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.tanh(rows @ GAIN.T)

    expert = load_expert(frail, 5, 2, workers="ray:2")
    answers = expert.ask(ROWS, "probe")
    assert os.path.exists(marker)
    alone = load_expert(frail, 5, 2, batch=8).ask(ROWS, "probe")
    assert np.array_equal(answers, alone)
    assert expert.queries["probe"] == 60


@pytest.mark.torture
@pytest.mark.usefixtures("cluster")
def test_what_an_expert_raises_there_is_told_here():
    def limited(rows):
        if (rows[:, 0] > 1).any():
            raise ValueError("infeasible")
        return rows @ GAIN.T

    expert = load_expert(limited, 5, 2, workers="ray")
    answers = expert.ask(ROWS, "probe")
    assert np.array_equal(np.isnan(answers).all(axis=1), ROWS[:, 0] > 1)

    del expert  # and with it its cores

    def lost(rows):
        os._exit(3)

    with pytest.raises(ExpertError, match="lost 3 times with a batch of 8"):
        load_expert(lost, 5, 2, workers="ray:1").ask(ROWS[:8], "probe")


@pytest.mark.fault(264)
def test_an_actor_that_was_ended_is_not_begun_again():
    """With a stand-in for ray: its actor waits until it is ended."""
    said, ended = [], threading.Event()

    class Lost(Exception):
        pass

    class Ray:
        exceptions = types.SimpleNamespace(
            GetTimeoutError=TimeoutError, RayTaskError=ZeroDivisionError, RayError=Lost
        )

        def remote(self, **_):
            said.append("begun")
            method = types.SimpleNamespace(remote=lambda *_: "reply")
            handle = types.SimpleNamespace(opened=method, answer=method)
            return lambda _: types.SimpleNamespace(remote=lambda _: handle)

        def wait(self, opened, timeout):
            return opened, []

        def get(self, _, timeout=0.0):
            if timeout is None:
                said.append("asked")
                ended.wait(10)
                raise Lost
            return True

        def is_initialized(self):
            return True

        def kill(self, _):
            said.append("ended")
            ended.set()

    actor = on_ray._Actor(Ray(), "the expert", b"", None)
    with ThreadPoolExecutor(1) as thread:
        answer = thread.submit(actor.answer, ROWS)
        while "asked" not in said:
            time.sleep(0.01)
        actor.stop()
        with pytest.raises(CancelledError):
            answer.result(10)
    assert said == ["begun", "asked", "ended"]


def test_an_expert_that_can_not_be_opened_there_is_told_so():
    """With a stand-in for ray: its actor fails when it is made."""

    class Failed(Exception):
        actor_init_failed = True

    class Ray:
        exceptions = types.SimpleNamespace(
            GetTimeoutError=TimeoutError, RayTaskError=ZeroDivisionError, RayError=Failed
        )

        def remote(self, **_):
            method = types.SimpleNamespace(remote=lambda *_: "reply")
            return lambda _: types.SimpleNamespace(
                remote=lambda _: types.SimpleNamespace(opened=method, answer=method)
            )

        def wait(self, opened, timeout):
            return opened, []

        def get(self, *_, **__):
            raise Failed("The actor died\nModuleNotFoundError: No module named 'planner'")

        def is_initialized(self):
            return False

    actor = on_ray._Actor(Ray(), "the expert on Ray", b"", None)
    with pytest.raises(ExpertError, match="can't open it: ModuleNotFoundError"):
        actor.answer(ROWS)
