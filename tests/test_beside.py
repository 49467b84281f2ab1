"""The cloning beside a run: its outcome comes back, and no process is left."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest
from conftest import QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil.errors import ExpertError, FitError
from fdtasil.shell.beside import evaluated_beside

# As the shell has them, where most are left out.
SHORT = {field.name: None for part in (fdtasil.Fit, fdtasil.Mlp) for field in fields(part)}
SHORT |= {
    "output": None,
    "inputs": None,
    "trust": None,
    "log_formats": (),
    "out": None,
    "resume": None,
}
SHORT |= {"preset": "standard", "steps": 40, "hidden": (16,)}
SHORT |= {name: QUICK[name] for name in ("episodes", "horizon", "evaluation_episodes")}
ENDLESS = {"steps": 10**7}


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Arguments of a quick cloning, from a folder with a file that nobody may import."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "safetensors.py").write_text("raise SystemExit(9)\n")
    return {**SHORT, "expert": str(mlp_onnx(tmp_path / "e.onnx")), "env": TOY, "probes": 0}


@pytest.fixture
def started(monkeypatch):
    """The processes that were begun."""
    found = []

    class Noted(subprocess.Popen):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            found.append(self)

    monkeypatch.setattr("fdtasil.run.elsewhere.subprocess.Popen", Noted)
    return found


@pytest.mark.slow
def test_the_evaluation_is_that_of_the_same_call(run, tmp_path):
    """Whatever the environment prints."""
    loud = "import toy_environments\nprint('much ' * 99)\nimport os\nos.write(1, b'noise')\n"
    (tmp_path / "loud.py").write_text(loud)
    with evaluated_beside({**run, "env": "loud:toy/Integrator-v0"}) as cloning:
        expected = fdtasil.distill(run["expert"], TOY, 0, **QUICK).evaluation
        assert cloning() == expected


def test_nothing_is_begun_where_nothing_is_compared(started):
    with evaluated_beside(None) as cloning:
        assert cloning() is None
    assert started == []


@pytest.mark.slow
def test_what_the_distillation_raises_comes_back(run):
    refused = pytest.raises(ExpertError, match=r"none\.onnx can't be read")
    with evaluated_beside({**run, "expert": "none.onnx"}) as cloning, refused:
        cloning()


@pytest.mark.slow
def test_a_process_that_ends_by_itself_is_named(run, tmp_path):
    (tmp_path / "gone.py").write_text("import os, sys\nsys.stderr.write('bye')\nos._exit(3)\n")
    refused = pytest.raises(FitError, match=r"ended with code 3: .*bye")
    with evaluated_beside({**run, "env": "gone:Gone-v0"}) as cloning, refused as error:
        cloning()
    assert len(str(error.value).splitlines()) <= 6


def test_it_ends_with_the_block(run, started):
    with pytest.raises(KeyboardInterrupt), evaluated_beside({**run, **ENDLESS}):
        raise KeyboardInterrupt
    (process,) = started
    assert process.returncode == -signal.SIGKILL


@pytest.mark.torture
def test_it_ends_with_a_parent_that_is_killed(run, tmp_path):
    script = f"""
import fdtasil.run.elsewhere as elsewhere
import fdtasil.shell.beside as beside
Popen = elsewhere.subprocess.Popen
def noted(*arguments, **named):
    process = Popen(*arguments, **named)
    print(process.pid, flush=True)
    return process
elsewhere.subprocess.Popen = noted
with beside.evaluated_beside({ {**run, **ENDLESS}!r}) as cloning:
    cloning()
"""
    paths = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-P", "-c", script]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, env=paths)
    with parent:
        pid = int(parent.stdout.readline())
        time.sleep(4)  # until it has read its arguments
        assert _runs(pid)
        parent.kill()
    deadline = time.monotonic() + 20
    while _runs(pid) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not _runs(pid)


def _runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
