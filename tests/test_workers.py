"""Slow experts asked by several processes or threads: the same bytes, and nobody left behind."""

import ctypes
import gc
import io
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts import worker_process


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((37, 5)).astype(np.float32)


@pytest.fixture
def network():
    """A lambda whose last bits depend on which rows are asked together."""
    random = np.random.default_rng(1)
    first, second = random.standard_normal((5, 300)), random.standard_normal((300, 2))
    first, second = first.astype(np.float32), second.astype(np.float32)
    return lambda rows: np.tanh(rows @ first) @ second / 300


def gone(pids, seconds=8.0):
    """Whether all these processes end in time; one that its parent has not buried counts."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        shown = [subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout for pid in pids]  # fmt: skip  # noqa: E501
        if all(not state.strip() or state.startswith("Z") for state in shown):
            return True
        time.sleep(0.05)
    return False


def who(rows):
    """Answer with the number of the process."""
    import os

    return [[os.getpid()]] * len(rows)


# Sent by value: by name the workers would import this file, and torch with it.
WHO = type(who)(who.__code__, {"__builtins__": __builtins__}, "who")


# --- the same answers


@pytest.mark.parametrize("options", [{"workers": 1}, {"workers": 2}, {"workers": 3}, {"workers": 3, "threads": True}])  # fmt: skip  # noqa: E501
@pytest.mark.parametrize("batch", [1, 8])
def test_workers_do_not_change_a_byte(options, batch, network, rows):
    alone = fdtasil.load_expert(network, 5, 2, batch=batch)
    together = fdtasil.load_expert(network, 5, 2, batch=batch, **options)
    assert np.array_equal(alone.ask(rows, "probe"), together.ask(rows, "probe"))
    assert np.array_equal(alone.ask(rows[:1], "act"), together.ask(rows[:1], "act"))
    assert np.array_equal(alone.ask(rows[:0], "act"), together.ask(rows[:0], "act"))
    assert together.queries == alone.queries == {"probe": 37, "act": 1}


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_rows_that_are_asked_together_do_not_depend_on_the_workers(workers, rows):
    sizes = fdtasil.load_expert(lambda rows: [[len(rows)]] * len(rows), workers=workers)
    assert sizes.ask(rows, "act").ravel().tolist() == [8] * 32 + [5] * 5
    whole = fdtasil.load_expert(sizes, batch=1024)
    assert set(whole.ask(rows, "act").ravel()) == {37}


def test_a_whole_run_is_the_same_with_workers(network):
    runs = [
        fdtasil.distill(fdtasil.load_expert(network, batch=8, workers=workers), TOY, 3, **QUICK)
        for workers in (0, 2)
    ]
    first, second = (run.student.state_dict() for run in runs)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert runs[0].queries == runs[1].queries
    assert runs[0].evaluation == runs[1].evaluation


class Predicts:
    """What stable-baselines3's agents look like."""

    def predict(self, observation, deterministic=False):
        assert deterministic
        return observation @ GAIN.T, None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["predict", "module", "onnx"])
def test_other_kinds_go_to_processes_too(kind, tmp_path, rows):
    with torch.random.fork_rng():
        module = torch.nn.Linear(5, 2)
    sources = {"predict": Predicts(), "module": module, "onnx": mlp_onnx(tmp_path / "e.onnx")}
    alone = fdtasil.load_expert(sources[kind], 5, 2, batch=8)
    together = fdtasil.load_expert(sources[kind], 5, 2, workers=1)
    assert np.array_equal(alone.ask(rows, "act"), together.ask(rows, "act"))
    assert together.origin.sha256 == alone.origin.sha256


def test_a_worker_computes_on_one_thread_and_loads_what_the_expert_needs(rows):
    def look(rows):
        import os
        import sys

        print("what an expert prints does not get among the answers")
        return [[int(os.environ["OMP_NUM_THREADS"]), "torch" in sys.modules]] * len(rows)

    assert fdtasil.load_expert(look, workers=1).ask(rows[:1], "act").tolist() == [[1, 0]]


@pytest.mark.fault(118)
def test_processes_are_started_after_torch_used_several_threads(linear, rows):
    """A fork would copy the locks of threads that it does not have."""
    import torch

    torch.set_num_threads(2)
    try:
        matrix = torch.ones(512, 512)
        assert float((matrix @ matrix)[0, 0]) == 512
        answers = fdtasil.load_expert(linear, workers=1, timeout=60).ask(rows, "act")
    finally:
        torch.set_num_threads(1)
    assert np.array_equal(answers, linear(rows))


# --- at the same time


def test_processes_answer_side_by_side(tmp_path, rows):
    folder = str(tmp_path)

    def meet(rows):
        """Answer once two processes are here."""
        import os
        import time

        open(f"{folder}/{os.getpid()}", "w").close()
        while len(os.listdir(folder)) < 2:
            time.sleep(0.01)
        return [[os.getpid()]] * len(rows)

    expert = fdtasil.load_expert(meet, workers=2, timeout=20)
    assert len(set(expert.ask(rows[:16], "act").ravel())) == 2


def test_threads_answer_side_by_side(rows):
    barrier = threading.Barrier(2, timeout=20)

    def meet(rows):
        barrier.wait()
        return rows[:, :2]

    expert = fdtasil.load_expert(meet, workers=2, threads=True)
    assert np.array_equal(expert.ask(rows[:32], "act"), rows[:32, :2])


# --- what goes wrong


def error_of(expert, rows):
    with pytest.raises(ExpertError) as caught:
        expert.ask(rows, "act")
    assert len(str(caught.value).splitlines()) <= 6
    return str(caught.value)


@pytest.mark.fault(57, 59)
@pytest.mark.parametrize("options", [{"workers": 2}, {"workers": 2, "threads": True}])
@pytest.mark.parametrize(
    "answer",
    [
        lambda rows: [][len(rows)],
        lambda rows: rows[0],
        lambda rows: rows / 0.0 * 0.0,
        lambda rows: "text",
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_error_reads_as_without_workers(answer, options, rows):
    alone = error_of(fdtasil.load_expert(answer, batch=8), rows)
    assert error_of(fdtasil.load_expert(answer, batch=8, **options), rows) == alone


def test_the_workers_traceback_is_the_cause(rows):
    def broken_in_here(rows):
        raise FloatingPointError("the model diverged")

    with pytest.raises(ExpertError, match="raised FloatingPointError") as caught:
        fdtasil.load_expert(broken_in_here, workers=1).ask(rows, "act")
    assert "in broken_in_here" in str(caught.value.__cause__.__cause__)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (lambda: os._exit(3), r"ended with exit code 3 on 8 observations"),
        (lambda: ctypes.string_at(0), r"was killed by SIGSEGV on 8 observations"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), r"was killed by SIGKILL .*(?s:.*)memory"),
        (lambda: sys.exit(4), r"raised SystemExit on 8 observations: 4"),
    ],
)
def test_a_worker_that_dies_is_named(how, said, rows):
    def fragile(rows):
        return how() if rows.any() else rows[:, :2]

    expert = fdtasil.load_expert(fragile, workers=2)
    start = time.monotonic()
    with pytest.raises(ExpertError, match=rf"the function fragile {said}") as caught:
        expert.ask(rows, "act")
    assert time.monotonic() - start < 5
    assert "SystemExit" in said or "worker 1 of 2" in str(caught.value) or "worker 2 of 2" in str(caught.value)  # fmt: skip  # noqa: E501
    assert not expert.ask(np.zeros((20, 5), np.float32), "act").any()  # it is used on


def test_a_worker_that_hangs_is_ended(tmp_path, rows):
    folder = str(tmp_path)

    def hang(rows):
        import os
        import time

        open(f"{folder}/{os.getpid()}", "w").close()
        while rows.any():
            time.sleep(1)
        return rows[:, :2]

    expert = fdtasil.load_expert(hang, workers=2, timeout=0.5)
    start = time.monotonic()
    found = error_of(expert, rows[:20])
    assert "hangs on 8 observations: no answer in 0.5 s" in found
    assert time.monotonic() - start < 5
    assert gone(os.listdir(folder))
    assert not expert.ask(np.zeros((20, 5), np.float32), "act").any()


def test_one_failure_does_not_wait_for_the_others(tmp_path, rows):
    folder = str(tmp_path)

    def answer(rows):
        import os
        import time

        if rows[0, 0] == 0:
            open(f"{folder}/{os.getpid()}", "w").close()
            time.sleep(100)
        while not os.listdir(folder):  # until the other one sleeps
            time.sleep(0.01)
        raise ValueError("not here")

    rows[:8] = 0
    start = time.monotonic()
    assert "raised ValueError on 8 observations: not here" in error_of(
        fdtasil.load_expert(answer, workers=2), rows
    )
    assert time.monotonic() - start < 50
    assert gone(os.listdir(folder))


@pytest.mark.fault(58)
def test_what_can_not_be_sent_is_refused_at_once(tmp_path, rows):
    lock = threading.Lock()
    with pytest.raises(ExpertError, match=r"can't be sent .*lock(?s:.*)threads=True"):
        fdtasil.load_expert(lambda rows: lock and rows, workers=2)
    opened = fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx"))
    for options in ({}, {"threads": True}):  # an opened file opens itself again
        shared = fdtasil.load_expert(opened, workers=1, **options)
        assert np.array_equal(shared.ask(rows, "act"), opened.ask(rows, "act"))


def test_a_module_that_is_only_here_is_named(rows, monkeypatch):
    module = type(sys)("only_here")
    monkeypatch.setitem(sys.modules, "only_here", module)
    exec("def answer(rows): return rows", module.__dict__)
    module.__spec__ = type("Spec", (), {"name": "only_here"})()
    expert = fdtasil.load_expert(module.answer, workers=1)
    assert "can't open it: ModuleNotFoundError: No module named 'only_here'" in error_of(
        expert, rows
    )


@pytest.mark.slow
@pytest.mark.fault(9)
def test_a_file_that_changes_is_refused(tmp_path, rows):
    expert = fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx"), 5, 2, workers=1)
    mlp_onnx(tmp_path / "e.onnx", scale=2.0)
    assert "has changed since it was opened" in error_of(expert, rows)


@pytest.mark.parametrize(
    "arguments",
    [
        {"workers": -1},
        {"workers": True},
        {"workers": 1.5},
        {"threads": True},
        {"workers": 2, "timeout": 0},
        {"workers": 2, "timeout": float("nan")},
        {"timeout": 3},
        {"workers": 2, "threads": True, "timeout": 3},
    ],
)
def test_settings_that_can_not_be_kept(arguments):
    with pytest.raises(SettingError):
        fdtasil.load_expert(lambda rows: rows, **arguments)


# --- nobody is left behind


def test_copies_share_the_workers_and_the_last_one_ends_them(rows):
    expert = fdtasil.load_expert(WHO, workers=1)
    copy = fdtasil.load_expert(expert, 5, 1)
    (pid,) = {int(p) for e in (expert, copy) for p in e.ask(rows, "act").ravel()}
    assert copy.queries == {"act": 37}
    del expert
    gc.collect()
    assert copy.ask(rows[:1], "act") == pid
    del copy
    gc.collect()
    assert gone([pid])


# A script as users write them, without a guard: workers must not run it again.
SCRIPT = """
import ctypes, os, sys, time
import numpy as np
import fdtasil

def answer(rows):
    with open(f"{folder}/{{os.getpid()}}", "w"):
        pass
    {busy}
    return rows

expert = fdtasil.load_expert(answer, workers=2)
expert.ask(np.repeat(np.float32([[0], [1]]), 8, axis=0), "act")
"""


@pytest.fixture
def script(tmp_path):
    """Start the script; return it and its two workers once they are at work."""
    started = []

    def start(busy="time.sleep(0.2)"):
        folder = tmp_path / f"pids-{len(started)}"
        folder.mkdir()
        file = tmp_path / "script.py"
        file.write_text(textwrap.dedent(SCRIPT).format(folder=folder, busy=busy))
        process = subprocess.Popen(
            [sys.executable, str(file)],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # A shell's background jobs ignore Ctrl-C, and their children with them.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        started.append(process)
        end = time.monotonic() + 20
        while len(os.listdir(folder)) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        return process, [int(Path(name).name) for name in os.listdir(folder)]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.fault(79)
@pytest.mark.parametrize("kills", [1, pytest.param(100, marks=pytest.mark.torture)])
def test_a_killed_parent_leaves_no_worker(kills, script, figure):
    stuck = "ctypes.PyDLL(None).sleep(100)"  # in C, without letting another thread run
    busy = "time.sleep(100)"
    if sys.platform == "linux":  # whose kernel ends such a process too
        busy += f" if rows.any() else {stuck}"
    for _ in range(kills):
        process, pids = script(busy)
        assert len(pids) == 2
        process.kill()
        process.wait()
        assert gone(pids)
    figure(f"{kills} kills of a parent with two workers", "0 processes left")


@pytest.mark.slow
@pytest.mark.fault(79)
def test_an_end_leaves_no_worker(script):
    process, pids = script()
    assert process.communicate(timeout=20) == (None, "")
    assert process.returncode == 0
    assert len(pids) == 2
    assert gone(pids)


@pytest.mark.slow
@pytest.mark.fault(80)
def test_ctrl_c_shows_one_traceback_and_leaves_no_worker(script):
    process, pids = script("time.sleep(100)")
    os.killpg(process.pid, signal.SIGINT)
    error = process.communicate(timeout=10)[1]
    assert process.returncode == -signal.SIGINT
    assert error.count("Traceback") == error.count("KeyboardInterrupt") == 1
    assert gone(pids)


@pytest.mark.fault(258)
def test_a_message_that_is_cut_short_is_an_end():
    whole = io.BytesIO()
    worker_process.send(whole, list(range(1000)))
    for length in (0, 5, 8, 9, len(whole.getvalue()) - 1):
        with pytest.raises(EOFError):
            worker_process.receive(io.BytesIO(whole.getvalue()[:length]))


@pytest.mark.fault(331)
def test_ctrl_c_ends_idle_workers_too(rows, monkeypatch):
    """A notebook keeps what was interrupted, and with it who was asked."""
    expert = fdtasil.load_expert(lambda rows: rows[:, :2] + os.getpid() * 0.0, workers=2, batch=8)
    before = expert.ask(rows, "check")
    askers = expert.workers._askers
    pids = [asker._process.pid for asker in askers if asker._process is not None]
    assert pids

    def interrupted(*arguments, **named):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fdtasil.experts.workers.pool.wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            expert.ask(rows, "check")
    assert gone(pids)
    assert np.array_equal(expert.ask(rows, "check"), before)
