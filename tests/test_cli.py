"""The shell: the same arguments and defaults as the functions, exit codes, short errors."""

import inspect
import json
import os
import shutil
import subprocess
import sys
from dataclasses import fields
from importlib import import_module

import gymnasium
import numpy as np
import pytest
import torch
from conftest import TOY, mlp_onnx
from shells import shell

import fdtasil
from fdtasil import Fit, Mlp
from fdtasil.run.presets import preset_of
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
SETTINGS = {field.name for part in (Fit, Mlp) for field in fields(part)}

pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


# --- arguments

_OF_ITS_OWN = {"distill": {"json"}, "evaluate": {"json"}, "inspect": {"json", "picture"}}


@pytest.mark.parametrize("name", ["distill", "evaluate", "inspect"])
def test_the_shell_has_the_functions_arguments_and_defaults(name):
    function = inspect.signature(getattr(fdtasil, name)).parameters
    command = inspect.signature(import_module(f"fdtasil.shell.{name}").command).parameters
    assert set(function) - set(command) <= {
        "progress",
        "callback",
        "student",
        "fit",
        "constraints",
    }
    added = {"output", "inputs", "trust", "env_kwargs", "reset_options"}
    numbers, added = {"num_envs"}, added | _OF_ITS_OWN.get(name, set())
    if name == "distill":
        added |= {"out", "baseline", "log_formats"} | SETTINGS
    assert set(command) - set(function) <= added | numbers
    for argument in set(function) & set(command):
        default = function[argument].default
        # A shell's run is always saved; one that goes on stays on its device.
        if argument not in ("out", "device"):
            assert command[argument].default in (default, str(default))
    for argument in added - {"out", "baseline", "log_formats"}:
        assert command[argument].default is None


def test_the_environment_is_made_and_reset_as_flags_say(called, inside, tmp_path):
    options = ["--env-kwargs", '{"wall": 0.9}', "--reset-options", '{"a": [1]}', "--num-envs", "2"]
    assert inside("distill", "e.onnx", TOY, *options, cwd=tmp_path).returncode == 130
    assert called["env"] == fdtasil.Environment(TOY, {"wall": 0.9}, {"a": [1]}, 2)
    for text in ("{", "[1]", "3"):
        done = inside("distill", "e.onnx", TOY, "--env-kwargs", text, cwd=tmp_path)
        assert done.returncode == 2
        assert "a JSON object" in done.stderr


def test_what_a_student_sees_by_number_or_name(called, inside, tmp_path):
    for words, expected in ((["0", "2"], (0, 2)), (["arm", "leg"], ("arm", "leg"))):
        inside("distill", "e.onnx", TOY, "--student-obs", *words, cwd=tmp_path)
        assert called["student_obs"] == expected


def test_a_file_of_weights_is_no_policy(expert, inside, tmp_path):
    done = inside("evaluate", tmp_path / "student.safetensors", TOY, "--expert", expert)
    assert "student.onnx" in done.stderr


def test_another_gravity_is_judged_otherwise(expert, inside):
    line = ["evaluate", expert, TOY, "--expert", expert, "--episodes", "2", "--horizon", "30"]
    made = inside(*line, "--env-kwargs", '{"wall": 1.01}')
    assert made.returncode == 0, made.stderr
    assert "survival 1.00" not in made.stdout
    assert "survival 1.00" in inside(*line).stdout


@pytest.fixture
def called(monkeypatch):
    """The arguments that `distill` is called with; it does nothing else."""
    found = {}

    def note(**arguments):
        found.update(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr("fdtasil.shell.call.distill", note)
    return found


def test_what_is_left_out_in_a_shell_is_left_to_the_function(called, inside, tmp_path):
    assert inside("distill", "e.onnx", TOY, cwd=tmp_path).returncode == 130
    function = inspect.signature(fdtasil.distill).parameters
    expected = {name: p.default for name, p in function.items() if name in called}
    expected |= {"expert": "e.onnx", "env": TOY, "fit": Fit()}
    found = {**called, "out": str(called["out"])}
    assert found == {**expected, "out": str(tmp_path / "runs" / "latest")}


def test_what_is_said_in_a_shell_is_what_the_function_is_given(called, inside, tmp_path):
    said = ["--hidden", "8", "4", "--activation", "tanh", "--steps", "7", "--order", "2"]
    said += ["--weight-decay", "0.5", "--probes", "10,central", "--preset", "paper"]
    said += ["--student-obs", "2", "0", "--dataset", "there", "--out", "run"]
    said += ["--log-formats", "csv", "json"]
    assert inside("distill", "e.onnx", TOY, *said, cwd=tmp_path).returncode == 130
    assert called["student"] == Mlp((8, 4), "tanh")
    paper = preset_of("paper")
    assert called["fit"] == paper.fit_with(steps=7, order=2, weight_decay=0.5)
    assert called["fit"].epsilon == paper.fit.epsilon != Fit().epsilon
    assert (called["probes"], called["preset"]) == ("10,central", "paper")
    assert (called["student_obs"], called["dataset"]) == ((2, 0), "there")
    assert isinstance(called["callback"], fdtasil.Log)


def test_a_student_by_its_name(called, inside, tmp_path):
    assert inside("distill", "e.onnx", TOY, "--student", "micro", cwd=tmp_path).returncode == 130
    assert called["student"] == "micro"
    wrong = inside("distill", "e.onnx", TOY, "--student", "micro", "--hidden", "8", cwd=tmp_path)
    assert "--student micro beside --hidden" in wrong.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_is_explained(name, inside, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    module = import_module(f"fdtasil.shell.{name.replace('-', '_')}")
    shown = inside(name, "--help")
    assert shown.returncode == 0
    text = " ".join(shown.stdout.replace("│", " ").split())
    for argument, parameter in inspect.signature(module.command).parameters.items():
        if parameter.kind is not inspect.Parameter.POSITIONAL_ONLY:
            flag = f"--{argument.replace('_', '-')}"
            assert flag in text or argument in (
                "expert",
                "env",
                "policy",
                "agent_zip",
                "student",
                "policies",
                "run",
                "file",
            ), argument
    if name == "distill":
        assert "States in a minibatch at most" in text
        assert "Width of each hidden layer" in text
        assert "Name of the ONNX output" in text


# --- what commands do


def test_inspect_distill_evaluate(expert, inside, tmp_path):
    """With a baseline, in a process beside it; a distillation of its own process is below."""
    shown = inside("inspect", expert, TOY, "--episodes", 2)
    assert shown.returncode == 0, shown.stderr
    for promised in ("sha256", "determinism", "batch independence", "action bounds", "return"):
        assert promised in shown.stdout
    both = ("--baseline", "--json", tmp_path / "found.json")
    done = inside("distill", expert, TOY, *QUICK, *both, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no terminal, no bars
    for promised in ("expert", "plain cloning", "student", "queries: "):
        assert promised in done.stdout
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["queries"]["probe"] == 1600  # 40 states, 40 steps, ten visits a sample
    found = json.loads((tmp_path / "found.json").read_text())
    assert found == {**report, "baseline": found["baseline"], "folder": str(tmp_path / "run")}
    assert found["baseline"]["expert_return"] == report["evaluation"]["expert_return"]
    assert found["baseline"]["student_return"] != report["evaluation"]["student_return"]
    judged = inside("evaluate", tmp_path / "run" / "student.onnx", TOY, "--expert", expert)
    assert judged.returncode == 0, judged.stderr
    assert "normalised return" in judged.stdout


def test_a_stable_baselines3_agent_becomes_an_expert(inside, tmp_path):
    from stable_baselines3 import SAC

    state = torch.get_rng_state(), np.random.get_state()
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}).save(tmp_path / "agent.zip")
    torch.set_rng_state(state[0])
    np.random.set_state(state[1])
    exported = ["export-sb3", "agent.zip", "--env", "Pendulum-v1", "--out", "agent.onnx"]
    done = inside(*exported, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for expert in ("agent.zip", "agent.onnx"):
        shown = inside("inspect", expert, "Pendulum-v1", "--episodes", 1, cwd=tmp_path)
        assert shown.returncode == 0, shown.stderr
        assert "a torch twin agrees with it" in shown.stdout


def test_a_script_reads_what_a_run_came_to(expert, inside, tmp_path):
    wrong = inside("distill", expert, TOY, *QUICK, "--json", "found.txt", cwd=tmp_path)
    assert wrong.returncode == 2
    assert not list(tmp_path.iterdir())
    done = inside("distill", expert, TOY, *QUICK, "--json", "-", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["baseline"] is None
    assert found["evaluation"]["student_return"] > 0
    begun = ("distill", expert, TOY, *QUICK, "--resume", tmp_path / "run")
    again = inside(*begun, "--json", "-")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == found


def test_logs_are_written_beside_a_run(expert, inside, tmp_path):
    done = inside(
        "distill", expert, TOY, *QUICK, "--log-formats", "csv", "--out", tmp_path / "run"
    )
    assert done.returncode == 0, done.stderr
    assert "train/loss" in (tmp_path / "run" / "log" / "progress.csv").read_text()


def test_options_of_the_expert_are_told(inside, tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx", sizes=(5, 8, 2), extra_outputs={"other": 2})
    unnamed = inside("inspect", expert, TOY, "--episodes", 1)
    assert unnamed.returncode == 1
    assert "output=" in unnamed.stderr
    named = ("--output", "other")
    for command in (
        ("inspect", expert, TOY, "--episodes", 1, *named),
        ("distill", expert, TOY, *QUICK, *named, "--out", tmp_path / "run"),
        ("evaluate", tmp_path / "run" / "student.onnx", TOY, "--expert", expert, *named),
    ):
        done = inside(*command)
        assert done.returncode == 0, done.stderr


def test_stored_probes_need_not_be_repeated(linear, inside, tmp_path):
    """Their number is another than the usual one, which is taken where nothing is stored."""
    quick = {"episodes": 2, "horizon": 20, "evaluation_episodes": 0}
    stored = fdtasil.distill(linear, TOY, "sphere:5", **quick, student=Mlp(4), fit=Fit(steps=5))
    stored.save(tmp_path / "stored")
    short = ["--dataset", tmp_path / "stored", "--steps", 30, "--hidden", 4]
    done = inside("distill", *short, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["probes"] == stored.report["probes"]
    assert report["probes"].startswith("sphere:5,")
    assert sum(report["queries"].values()) == 0
    refused = inside("distill", *short, "--probes", 10, "--out", tmp_path / "other")
    assert refused.returncode == 2
    assert "with stored answers to 'sphere:5," in refused.stderr


@pytest.mark.fault(358)
@pytest.mark.parametrize("idle", [["--probes", "0"], ["--evaluation-episodes", "0"]])
def test_a_baseline_that_nobody_compares_is_refused(idle, expert, inside, tmp_path):
    line = ["distill", expert, TOY, "--episodes", "2", "--baseline", *idle]
    done = inside(*line, "--out", tmp_path / "run")
    assert done.returncode == 2
    assert f"--baseline beside {' '.join(idle)}" in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_folder_without_a_name_has_one(expert, inside, tmp_path):
    assert inside("distill", expert, TOY, *QUICK, "--out", tmp_path / "run").returncode == 0
    for name, cwd in ((".", tmp_path / "run"), ("..", tmp_path / "run" / "figures")):
        inside("report", name, cwd=cwd)
        assert (tmp_path / "run.html").exists()
        (tmp_path / "run.html").unlink()


@pytest.mark.fault(359)
def test_gains_beside_a_large_constant(expert, inside):
    class Offset(gymnasium.ObservationWrapper):
        def observation(self, observation):
            return observation + np.array([0, 0, 0, 0, 5e6])

    gymnasium.register("toy/Offset-v0", entry_point=lambda: Offset(gymnasium.make(TOY)))
    try:
        shown = inside("gains", expert, "toy/Offset-v0", "--states", 3, "--horizon", 20)
    finally:
        del gymnasium.registry["toy/Offset-v0"]
    assert shown.returncode == 0, shown.stderr
    assert "still      4" in shown.stdout


# --- errors


@pytest.mark.parametrize(
    ("arguments", "code", "found"),
    [
        (["distill", "none.onnx", TOY], 1, "none.onnx can't be read"),
        (["distill", "EXPERT", TOY, "--probes", "spere:3"], 2, "spere:3"),
        (["distill", "EXPERT", "Pendulum-v1"], 1, "wants 5 observations"),
        (["distill", "EXPERT", "NoSuch-v0"], 1, "can't be made"),
        (["inspect", "EXPERT", "CartPole-v1"], 1, "wants 5 observations"),
        pytest.param(
            ["distill", "EXPERT", TOY, "--prbes", "3"], 2, "--probes", marks=pytest.mark.fault(107)
        ),
        (["distil"], 2, "distill"),
        (["report", "nothing"], 1, "there is no folder nothing"),
        (["report", "EXPERT"], 1, "e.onnx is a file"),
        ([], 2, "no command"),
        (["distill", "EXPERT", TOY, "--activation", "gellu"], 2, "activation='gellu'"),
        (["distill", "EXPERT", TOY, "--steps", "0"], 2, "steps=0"),
    ],
)
def test_an_error_is_short_and_says_the_next_step(
    arguments, code, found, expert, inside, tmp_path
):
    failed = inside(*[expert if a == "EXPERT" else a for a in arguments], cwd=tmp_path)
    assert failed.returncode == code
    assert found in failed.stderr + failed.stdout
    assert "Traceback" not in failed.stderr
    if code == 1:
        assert len(failed.stderr.strip().splitlines()) <= 6
        assert "next step" in failed.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code"), [(["distill", "none.onnx", TOY], 1), (["dist"], 2)]
)
def test_a_process_ends_with_the_code_of_its_error(arguments, code, tmp_path):
    failed = shell(*arguments, cwd=tmp_path)
    assert failed.returncode == code
    assert failed.stdout == ""
    assert failed.stderr.startswith("fdtasil: ")
    assert ("next step: " in failed.stderr) == (code == 1)
    assert not list(tmp_path.iterdir())  # not even an empty runs/
    assert "Traceback" not in failed.stderr


# --- runs that go on


def test_a_run_goes_on_as_it_was_begun_and_a_failed_call_changes_nothing(expert, inside, tmp_path):
    failed = inside("distill", tmp_path / "none.onnx", TOY, *QUICK, "--out", tmp_path / "run")
    assert failed.returncode == 1
    assert not (tmp_path / "run").exists()
    assert inside("distill", expert, TOY, *QUICK, "--out", tmp_path / "run").returncode == 0
    before = (tmp_path / "run/command.json").read_bytes()
    inside("distill", tmp_path / "none.onnx", TOY, *QUICK, "--out", tmp_path / "run")
    assert (tmp_path / "run/command.json").read_bytes() == before
    other = inside("distill", "--resume", tmp_path / "run", "--seed", "7")
    assert other.returncode == 2
    assert "--seed beside --resume" in other.stderr
    one = [*QUICK[:-1], 1]  # evaluation episode
    replacing = inside("distill", expert, TOY, *one, "--seed", 1, "--out", tmp_path / "run")
    assert "which this one replaces" in replacing.stderr
    assert "95 % interval n/a: of a single pair" in replacing.stdout


def test_a_run_is_resumed_with_nothing_but_its_folder(expert, inside, tmp_path, monkeypatch):
    """The arguments are those that it was begun with; the bytes those of a run left alone."""
    import fdtasil.shell.call

    class Stop(fdtasil.FdtasilError):
        pass

    def stop(event):
        raise Stop("a stop", "none", "go on")

    def stopped(**arguments):
        return fdtasil.distill(**{**arguments, "callback": stop})

    environment = "Pendulum-v1"  # which no module has to be imported for
    expert = mlp_onnx(tmp_path / "swing.onnx", sizes=(3, 8, 1))
    begun = ["distill", expert, environment, *QUICK, "--activation", "tanh"]
    assert inside(*begun, "--out", tmp_path / "whole").returncode == 0
    with monkeypatch.context() as patch:
        patch.setattr(fdtasil.shell.call, "distill", stopped)
        failed = inside(*begun, "--out", tmp_path / "run")
    assert failed.returncode == 1
    assert f"--resume {tmp_path / 'run'}" in failed.stderr
    resumed = inside("distill", "--resume", tmp_path / "run")
    assert resumed.returncode == 0, resumed.stderr
    for name in ("student.safetensors", "student.onnx", "config.json"):
        found, expected = ((tmp_path / run / name).read_bytes() for run in ("run", "whole"))
        assert found == expected, name


def test_a_run_goes_on_where_it_was_begun_or_where_it_is_told_to(inside, tmp_path):
    begun = {"expert": "e.onnx", "env": "Pendulum-v1", "trust": None, "device": "tpu"}
    (tmp_path / "command.json").write_text(json.dumps(begun))
    for arguments, found in {(): "device='tpu'", ("--device", "npu"): "device='npu'"}.items():
        refused = inside("distill", "--resume", tmp_path, *arguments)
        assert refused.returncode == 2
        assert found in refused.stderr


# --- surroundings


@pytest.mark.torture
def test_a_module_of_the_current_folder_and_a_warning_without_source(expert, tmp_path):
    """As the installed command, which does not look into the current folder by itself."""
    (tmp_path / "theirs.py").write_text("from toy_environments import Integrator\n")
    (tmp_path / "mine.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('My-v0', entry_point='theirs:Integrator', max_episode_steps=15)\n"
    )
    start = "import sys; sys.path.remove(''); from fdtasil.shell.main import main; main()"
    command = [sys.executable, "-c", start, "distill", str(expert), "mine:My-v0", *QUICK]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()  # no terminal, no bars
    assert line.startswith("fdtasil: warning: horizon=20")
    for promised in ("expert", "student", "queries: ", "saved in "):
        assert promised in done.stdout
    picture = tmp_path / "runs" / "latest" / "figures" / "training.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_was_found_is_written_for_a_script(expert, inside, tmp_path):
    short = ["--expert", expert, "--episodes", 2, "--horizon", 20]
    for command in ("evaluate", "diagnose"):
        found = tmp_path / f"{command}.json"
        done = inside(command, expert, TOY, *short, "--json", found, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"written: {found}" in done.stdout
        plain = json.loads(found.read_text(), parse_constant=float)
        assert plain.keys() >= {"evaluate": {"ci95"}, "diagnose": {"fidelity"}}[command]
        assert "NaN" not in found.read_text()
    refused = inside("evaluate", expert, TOY, *short, "--json", "x.csv", cwd=tmp_path)
    assert refused.returncode == 2
    assert "ends with .json" in refused.stderr


def test_a_warning_is_one_line(expert, inside, tmp_path):
    short = ["--episodes", 1, "--horizon", 50]
    done = inside("evaluate", expert, TOY, "--expert", expert, *short, cwd=tmp_path)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("fdtasil: warning: horizon=50")


def test_the_version_is_told():
    assert shell("--version").stdout == f"fdtasil {fdtasil.__version__}\n"


@pytest.mark.slow
def test_no_other_file_of_the_current_folder_is_run(expert, tmp_path):
    """Optional modules that dependencies look for may lie in a folder that was downloaded."""
    for name in ("glfw_preview", "cffi", "tensorboard"):
        (tmp_path / f"{name}.py").write_text("print('CODE OF THE FOLDER')")
    start = "import sys; sys.path.remove(''); from fdtasil.shell.main import main; main()"
    command = [sys.executable, "-c", start, "inspect", str(expert), TOY, "--episodes", "1"]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert "CODE OF THE FOLDER" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--horizon", "ten"], "fdtasil: --horizon 'ten'\n  expected: INT\n"),
        (["--hidden", "32,32"], "fdtasil: --hidden '32,32'\n  expected: [INT [INT ...]]\n"),
        (["--weight", "much"], "fdtasil: --weight 'much'\n  expected: FLOAT\n"),
    ],
)
def test_a_word_that_is_no_number_takes_three_lines(words, said, inside):
    done = inside("distill", "e.onnx", TOY, *words)
    assert done.returncode == 2
    assert done.stderr.startswith(said)
    assert len(done.stderr.splitlines()) == 3


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no such terminals")
def test_in_a_terminal_too_with_its_colours():
    import pty

    ours, theirs = pty.openpty()
    code = "from fdtasil.shell.main import main; main()"
    command = [sys.executable, "-c", code, "distill", "e.onnx", TOY, "--horizon", "ten"]
    with subprocess.Popen(command, stderr=theirs) as process:
        os.close(theirs)
        said = os.read(ours, 10_000).decode()
        process.wait(60)
    os.close(ours)
    assert said.startswith("fdtasil: --horizon 'ten'")


@pytest.mark.fault(270)
def test_trust_reaches_the_policy_that_asks_for_it(quick, inside, tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    expert = mlp_onnx(tmp_path / "e.onnx")
    quick.export(tmp_path / "s.c")
    short = ["--episodes", "2", "--horizon", "20"]
    for command in ("evaluate", "diagnose"):
        line = [command, tmp_path / "s.c", TOY, "--expert", expert, *short]
        assert "--trust c" in inside(*line).stderr
        done = inside(*line, "--trust", "c")
        assert done.returncode == 0, done.stderr


def test_json_is_printed_in_the_place_of_the_text(inside, tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    line = ("evaluate", expert, TOY, "--expert", expert, "--episodes", 2, "--horizon", 5)
    done = inside(*line, "--json", "-")
    assert json.loads(done.stdout)["normalized_return"] == 1.0
    assert done.returncode == 0


@pytest.mark.parametrize("flag", ["--student-obs", "--log-formats"])
def test_flags_that_have_swallowed_the_arguments_are_named(flag, inside, tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    for line in ([flag, "0", expert, TOY], [flag, "0", expert, TOY, "--episodes", 1]):
        done = inside("distill", *line, cwd=tmp_path)
        assert done.returncode == 2
        assert f"{flag} 0" in done.stderr
        assert "before flags of several values" in done.stderr


def test_two_folders_and_swapped_arguments(inside, tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    done = inside("distill", expert, TOY, "--resume", "a", "--out", "b", cwd=tmp_path)
    assert done.returncode == 2
    assert "--out b beside --resume a" in done.stderr
    done = inside("distill", TOY, expert, cwd=tmp_path)
    assert done.returncode == 1
    assert "in the place of the environment" in done.stderr


def test_a_folder_to_go_on_with_that_is_none_is_named(inside, tmp_path):
    nowhere = inside("distill", "--resume", tmp_path / "none")
    assert nowhere.returncode == 2
    assert "none, which is no folder" in nowhere.stderr
