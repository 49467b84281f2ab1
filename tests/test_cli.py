"""The shell: the same arguments and defaults as the functions, exit codes, short errors."""

import inspect
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from conftest import TOY, mlp_onnx

import fdtasil
from fdtasil.shell.main import COMMANDS

QUICK = [
    "--episodes",
    "2",
    "--horizon",
    "20",
    "--steps",
    "40",
    "--hidden",
    "16",
    "--evaluation-episodes",
    "2",
]


def shell(*arguments, cwd="."):
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    command = [sys.executable, "-m", "fdtasil", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment)


@pytest.mark.parametrize("name", ["distill", "evaluate"])
def test_the_shell_has_the_functions_arguments_and_defaults(name):
    function = inspect.signature(getattr(fdtasil, name)).parameters
    command = inspect.signature(COMMANDS[name]).parameters
    assert set(function) - set(command) <= {"progress", "callback"}
    assert set(command) - set(function) <= {"out", "compare"}
    for argument in set(function) & set(command):
        default = function[argument].default
        # A shell's run is always saved; one that goes on stays on its device.
        if argument not in ("out", "device"):
            assert command[argument].default in (default, str(default))


def test_a_stable_baselines3_agent_becomes_an_expert(tmp_path):
    from stable_baselines3 import SAC

    state = torch.get_rng_state(), np.random.get_state()
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}).save(tmp_path / "agent.zip")
    torch.set_rng_state(state[0])
    np.random.set_state(state[1])
    exported = ["export-sb3", "agent.zip", "--env", "Pendulum-v1", "--out", "agent.onnx"]
    done = shell(*exported, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for expert in ("agent.zip", "agent.onnx"):
        shown = shell("inspect", expert, "Pendulum-v1", "--episodes", 1, cwd=tmp_path)
        assert shown.returncode == 0, shown.stderr
        assert "a torch twin agrees with it" in shown.stdout


def test_inspect_distill_evaluate(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    shown = shell("inspect", expert, TOY, "--episodes", 2)
    assert shown.returncode == 0, shown.stderr
    for promised in ("sha256", "determinism", "batch independence", "action bounds", "return"):
        assert promised in shown.stdout
    done = shell("distill", expert, TOY, *QUICK, "--compare", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no terminal, no bars
    for promised in ("expert", "plain cloning", "student", "rows asked of the expert"):
        assert promised in done.stdout
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["queries"]["probe"] == 400
    judged = shell("evaluate", tmp_path / "run" / "student.onnx", TOY, "--expert", expert)
    assert judged.returncode == 0, judged.stderr
    assert "normalised return" in judged.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "found"),
    [
        (["distill", "none.onnx", TOY], 1, "none.onnx can't be read"),
        (["distill", "EXPERT", TOY, "--probes", "spere:3"], 2, "spere:3"),
        (["distill", "EXPERT", "Pendulum-v1"], 1, "wants 5 observations"),
        (["distill", "EXPERT", "NoSuch-v0"], 1, "can't be made"),
        (["inspect", "EXPERT", "CartPole-v1"], 1, "actions Discrete"),
        pytest.param(
            ["distill", "EXPERT", TOY, "--prbes", "3"], 2, "--probes", marks=pytest.mark.fault(107)
        ),
        (["distil"], 2, "distill"),
    ],
)
def test_an_error_is_short_and_says_the_next_step(arguments, code, found, tmp_path):
    expert = str(mlp_onnx(tmp_path / "e.onnx"))
    failed = shell(*[expert if a == "EXPERT" else a for a in arguments], cwd=tmp_path)
    assert failed.returncode == code
    assert found in failed.stderr + failed.stdout
    assert "Traceback" not in failed.stderr
    if code == 1:
        assert len(failed.stderr.strip().splitlines()) <= 6
        assert "next step" in failed.stderr


def test_a_run_goes_on_as_it_was_begun_and_a_failed_call_changes_nothing(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    failed = shell("distill", tmp_path / "none.onnx", TOY, *QUICK, "--out", tmp_path / "run")
    assert failed.returncode == 1
    assert not (tmp_path / "run").exists()
    assert shell("distill", expert, TOY, *QUICK, "--out", tmp_path / "run").returncode == 0
    before = (tmp_path / "run/command.json").read_bytes()
    shell("distill", tmp_path / "none.onnx", TOY, *QUICK, "--out", tmp_path / "run")
    assert (tmp_path / "run/command.json").read_bytes() == before
    other = shell("distill", "--resume", tmp_path / "run", "--seed", "7")
    assert other.returncode == 2
    assert "--seed beside --resume" in other.stderr
    replacing = shell("distill", expert, TOY, *QUICK, "--seed", 1, "--out", tmp_path / "run")
    assert "which this one replaces" in replacing.stderr


def test_a_run_goes_on_where_it_was_begun_or_where_it_is_told_to(tmp_path):
    begun = {"expert": "e.onnx", "env": "Pendulum-v1", "trust": None, "device": "tpu"}
    (tmp_path / "command.json").write_text(json.dumps(begun))
    for arguments, found in {(): "device='tpu'", ("--device", "npu"): "device='npu'"}.items():
        refused = shell("distill", "--resume", tmp_path, *arguments)
        assert refused.returncode == 2
        assert found in refused.stderr


def test_a_module_of_the_current_folder_and_a_warning_without_source(tmp_path):
    """As the installed command, which does not look into the current folder by itself."""
    expert = mlp_onnx(tmp_path / "e.onnx")
    (tmp_path / "mine.py").write_text(
        "import gymnasium, toy_environments as toys\n"
        "gymnasium.register('My-v0', entry_point=toys.Integrator, max_episode_steps=15)\n"
    )
    start = "import sys; sys.path.remove(''); from fdtasil.shell.main import main; main()"
    command = [sys.executable, "-c", start, "distill", str(expert), "mine:My-v0", *QUICK]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("fdtasil: warning: horizon=20")


def test_the_version_is_told():
    assert shell("--version").stdout == f"fdtasil {fdtasil.__version__}\n"


def test_no_other_file_of_the_current_folder_is_run(tmp_path):
    """Optional modules that dependencies look for may lie in a folder that was downloaded."""
    expert = mlp_onnx(tmp_path / "e.onnx")
    for name in ("glfw_preview", "cffi", "tensorboard"):
        (tmp_path / f"{name}.py").write_text("print('CODE OF THE FOLDER')")
    start = "import sys; sys.path.remove(''); from fdtasil.shell.main import main; main()"
    command = [sys.executable, "-c", start, "inspect", str(expert), TOY, "--episodes", "1"]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert "CODE OF THE FOLDER" not in done.stdout + done.stderr
