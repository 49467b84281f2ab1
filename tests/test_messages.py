"""What is said to who makes a usual mistake for the first time: it names the way out."""

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil import Mlp, Student
from fdtasil.errors import EnvironmentFault, FdtasilError
from fdtasil.probes.answers import ask_moved

pytestmark = pytest.mark.usefixtures("no_pictures")

STATES = np.zeros((4, 5), np.float32)


def asked(answer):
    return lambda: fdtasil.load_expert(lambda rows: answer, 5, 2).ask(STATES, "act")


def sums(rows):
    return rows.sum(axis=1)


def one_state(row):
    return GAIN @ row


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (asked(None), "a row of NaN"),
        (asked([None]), "a row of NaN"),
        (asked(np.zeros(4)), "one row of actions for each row"),
        (asked([]), "one row of actions for each row"),
        (lambda: fdtasil.load_expert(sums, 5, 2).ask(STATES, "act"), "one row of actions"),
        (lambda: fdtasil.load_expert(one_state, 5, 2).ask(STATES, "act"), "for row in rows"),
        (
            lambda: fdtasil.load_expert(Mlp(4).build(3, 1, torch.Generator()).state_dict()),
            "module",
        ),
        (lambda: fdtasil.load_expert(onnx.ModelProto()), r"onnx.save\(model"),
        (lambda: fdtasil.load_expert(b"onnx"), "write them to a file"),
        (lambda: fdtasil.load_expert("mpc.py"), r"fdtasil.distill\(function"),
        (lambda: fdtasil.load_expert("mpc:plan"), r"fdtasil.distill\(function"),
        (lambda: fdtasil.load_expert("127.0.0.1:8000/act"), "begins with http://"),
        (lambda: fdtasil.load_expert("ws://localhost:8000/act"), "begins with http://"),
        (lambda: fdtasil.distill(len, TOY, "4,central,forward"), "'central' beside 'forward'"),
        (lambda: fdtasil.distill(len, TOY, "4,labels,both"), "'labels' beside 'both'"),
        (lambda: fdtasil.distill(len, TOY, "4,radius=abc"), "radius=0.3, radius=0.2"),
        (lambda: fdtasil.distill(len, TOY, student="small"), r"fdtasil.Mlp\(\(64, 64\)\)"),
        (lambda: fdtasil.distill(len, TOY, resume="nowhere"), "start it again"),
    ],
)
def test_the_way_out_is_named(call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FdtasilError, match=said) as caught:
        call()
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.parametrize("option", ["central,central", "labels,labels,radius=0.3"])
def test_an_option_may_be_said_twice(option):
    fdtasil.distill(lambda rows: rows @ GAIN.T, TOY, f"2,{option}", **QUICK)


@pytest.mark.parametrize("missing", ["observation_space", "action_space"])
def test_an_environment_without_a_space(missing):
    class Bare(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1, 1, (5,))
        action_space = gymnasium.spaces.Box(-1, 1, (2,))

    delattr(Bare, missing)
    with pytest.raises(EnvironmentFault, match=f"no {missing}") as caught:
        fdtasil.distill(lambda rows: rows @ GAIN.T, Bare, **QUICK)
    assert f"self.{missing} = gymnasium.spaces.Box" in caught.value.next_step


@pytest.mark.parametrize(
    ("problem", "advised"), [(ConnectionRefusedError, False), (MemoryError, True)]
)
def test_a_connection_that_broke_is_no_matter_of_the_radius(problem, advised):
    def gone(rows):
        raise problem("gone")

    with pytest.raises(FdtasilError, match="states moved by probes") as caught:
        ask_moved(fdtasil.load_expert(gone, 5, 2), STATES, "probe")
    assert ("radius" in caught.value.next_step) == advised


@pytest.mark.parametrize("path", ["C:/models/e.onnx", "runs/2024-01-01T12:00:00/student.onnx"])
def test_a_path_with_a_colon_is_no_address(path):
    with pytest.raises(FdtasilError, match="No such file") as caught:
        fdtasil.load_expert(path)
    assert "http://" not in caught.value.next_step


@pytest.mark.parametrize("call", [lambda r: r.save(None), lambda r: r.export(None)])
def test_no_path_is_no_path(call, quick):
    with pytest.raises(FdtasilError, match="=None"):
        call(quick)


def test_a_dictionary_in_the_place_of_the_numbers_of_a_history(quick):
    run = {**QUICK, "history": 2}
    result = fdtasil.distill(lambda rows: rows @ GAIN.T, TOY, 0, **run)
    with pytest.raises(FdtasilError, match="an observation that is a dict"):
        fdtasil.History(result.student, 2).predict({"speed": np.zeros(5)})
    fdtasil.History(result.student, 2).predict((0.1, 0.2, 0.3, 0.4, 0.5))


@pytest.mark.parametrize("seen", [{"student_obs": [0, 1]}, {"history": 2}])
def test_the_file_of_a_student_that_sees_otherwise_is_no_expert(seen, tmp_path):
    """`evaluate` knows what it sees; whoever takes an expert is told so."""
    law = lambda rows: rows @ GAIN.T  # noqa: E731
    result = fdtasil.distill(law, TOY, 0, **QUICK, **seen)
    result.export(tmp_path / "student.onnx")
    problem = fdtasil.inspect(tmp_path / "student.onnx", TOY, episodes=1, horizon=5).problem
    assert "judge it with fdtasil.evaluate, which knows what it sees" in str(problem)
    found = fdtasil.evaluate(tmp_path / "student.onnx", law, TOY, episodes=2, horizon=5)
    assert found.normalized_return is not None


def test_what_is_shown_at_a_prompt_is_short():
    expert = fdtasil.load_expert(lambda rows: rows @ GAIN.T)
    states = np.random.default_rng(0).standard_normal((4, 5))
    found = fdtasil.gains(expert, states)
    student = Student(Mlp(4), np.zeros(5), np.ones(5), -np.ones(2), np.ones(2), torch.Generator())
    told = f"? observations -> ? actions, {sum(expert.queries.values()):,} queries)"
    assert repr(expert).startswith("Expert(")
    assert repr(expert).endswith(told)
    assert repr(found).startswith("Gains(4 states, Jacobians of 2 x 5, error 0.")
    assert "5 observations -> 2 actions, -1 to 1" in repr(student)
    past = Student(Mlp(4), np.zeros(8), np.ones(8), -np.ones(1), np.ones(1), torch.Generator())
    assert repr(fdtasil.History(past, 3)) == "History(3 observations of 2 -> 1 actions)"
