"""A run that was killed goes on, and ends with the bytes of one that never was."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil import rounds
from fdtasil.errors import FdtasilWarning, SettingError

FILES = (
    "student.safetensors",
    "student.onnx",
    "demonstrations.npz",
    "progress.csv",
    "config.json",
)
RUN = {**QUICK, "trainer": "dagger", "probes": "sphere:2,resample", "episodes": 6, "steps": 150}


class Stop(Exception):
    """Stands for a kill in the tests that stay in this process."""


@pytest.fixture(autouse=True)
def checkpoint_at_every_epoch(monkeypatch):
    monkeypatch.setattr(rounds, "CHECKPOINT_SECONDS", 0.0)


@pytest.fixture
def expert(tmp_path):
    return mlp_onnx(tmp_path / "e.onnx")


def golden(expert, folder):
    fdtasil.distill(expert, TOY, out=folder, **RUN)
    return read(folder)


def read(folder):
    return {name: (Path(folder) / name).read_bytes() for name in FILES}


def stop_at(count):
    """A callback that stops the run at its `count`-th event."""
    seen = 0

    def callback(event):
        nonlocal seen
        seen += 1
        if seen == count:
            raise Stop

    return callback


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 9])
def test_stopped_anywhere_it_ends_with_the_same_bytes(count, expert, tmp_path):
    expected, folder = golden(expert, tmp_path / "golden"), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(count), **RUN)
    result = fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected
    assert result.report["rows_asked_again_after_resuming"] > 0
    uninterrupted = fdtasil.Distilled.load(tmp_path / "golden")
    assert result.queries == uninterrupted.queries
    assert not (folder / "checkpoints").exists()


def test_stopped_again_and_again(expert, tmp_path):
    expected, folder = golden(expert, tmp_path / "golden"), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(1), **RUN)
    for count in (1, 2, 1, 3):
        with pytest.raises(Stop):
            fdtasil.distill(expert, TOY, resume=folder, callback=stop_at(count), **RUN)
    fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected


def test_validation_and_best_weights_are_resumed(expert, tmp_path):
    run = {**RUN, "trainer": "bc", "validation": 0.3, "patience": 50, "steps": 600}
    fdtasil.distill(expert, TOY, out=tmp_path / "golden", **run)
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(3), **run)
    fdtasil.distill(expert, TOY, resume=tmp_path / "run", **run)
    assert read(tmp_path / "run") == read(tmp_path / "golden")


def test_another_configuration_is_refused_with_the_difference(expert, tmp_path):
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(2), **RUN)
    other = {**RUN, "seed": 4, "weight_decay": 0.5}
    with pytest.raises(
        SettingError, match=r"fit\.weight_decay was 0\.01, is 0\.5; seed was 0, is 4"
    ):
        fdtasil.distill(expert, TOY, resume=tmp_path / "run", **other)
    with pytest.raises(SettingError, match="unfinished run"):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", **RUN)
    with pytest.raises(SettingError, match="no run to resume"):
        fdtasil.distill(expert, TOY, resume=tmp_path / "nothing", **RUN)


def test_a_finished_run_is_read_back(expert, tmp_path):
    first = fdtasil.distill(expert, TOY, out=tmp_path / "run", **RUN)
    again = fdtasil.distill(expert, TOY, resume=tmp_path / "run", **RUN)
    assert again.evaluation == first.evaluation
    assert again.student.to_bytes({}) == first.student.to_bytes({})


def test_a_broken_checkpoint_is_named_and_an_earlier_one_used(expert, tmp_path):
    expected, folder = golden(expert, tmp_path / "golden"), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(5), **RUN)
    (newest,) = sorted(folder.glob("checkpoints/1/training-*"))
    weights = newest / "fit.safetensors"
    weights.write_bytes(weights.read_bytes()[:-3])
    with pytest.warns(FdtasilWarning, match=r"fit\.safetensors changed after writing"):
        fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected


CHILD = """
import sys
import torch
torch.set_num_threads(1)
import fdtasil
from fdtasil import rounds
rounds.CHECKPOINT_SECONDS = 0.0
expert, folder, how = sys.argv[1:]
print("ready", flush=True)
fdtasil.distill(expert, {toy!r}, **{{how: folder}}, **{run!r})
"""


def child(expert, folder, how):
    code = CHILD.format(toy=TOY, run={**RUN, "steps": 600})
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", code, str(expert), str(folder), how]
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)


def kill_and_resume(expert, folder, delay):
    """Kill a run `delay` seconds after its first line, go on until it ends; return the kills."""
    process = child(expert, folder, "out")
    process.stdout.readline()
    time.sleep(delay)
    alive = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    begun = (folder / "checkpoints" / "config.json").exists() or (folder / "config.json").exists()
    if not begun:
        shutil.rmtree(folder, ignore_errors=True)
    assert child(expert, folder, "resume" if begun else "out").wait() == 0
    return alive


@pytest.mark.fault(108, 115)
@pytest.mark.parametrize("kills", [2, pytest.param(200, marks=pytest.mark.slow)])
def test_kills_at_random_moments(kills, expert, tmp_path, figure):
    assert child(expert, tmp_path / "golden", "out").wait() == 0
    start = time.perf_counter()
    assert child(expert, tmp_path / "again", "out").wait() == 0
    length = time.perf_counter() - start
    expected = read(tmp_path / "golden")
    assert read(tmp_path / "again") == expected
    moments, killed = random.Random(0), 0
    for number in range(kills):
        folder = tmp_path / f"run-{number}"
        killed += kill_and_resume(expert, folder, moments.uniform(0, 0.6 * length))
        assert read(folder) == expected
    assert killed >= kills // 2
    figure(
        "kills at random moments",
        f"{killed} of {kills} runs killed, {kills} resumed to the golden bytes",
    )
