"""A student goes on as an agent of stable-baselines3: the same answers before the first step."""

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY
from sb3_agents import seeded
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import ExportError, SettingError
from fdtasil.student.architectures import ACTIVATIONS

pytestmark = pytest.mark.usefixtures("no_pictures")


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


@pytest.mark.parametrize("algorithm", ["SAC", "TD3"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_agent_answers_as_the_student(algorithm, activation):
    result = fdtasil.distill(law, TOY, 0, **{**QUICK, "student": fdtasil.Mlp((16, 8), activation)})
    agent = result.to_sb3(InForm(), algorithm)
    rows = result.demonstrations.observations
    expected = result.student.predict(rows)[0]
    assert agent.predict(rows, deterministic=True)[0] == pytest.approx(expected, abs=1e-5)


def test_it_learns_on():
    result = fdtasil.distill(law, TOY, 0, **QUICK)
    agent = result.to_sb3(InForm(), "SAC")
    before = result.student.to_bytes()
    with seeded():
        agent.learn(150)
    assert result.student.to_bytes() == before  # the agent has weights of its own
    again = fdtasil.distill(agent, InForm, 0, **QUICK)  # and is an expert in turn
    assert again.evaluation is not None


@pytest.mark.parametrize("done", ["choice", "choices"])
def test_choices_go_on_with_ppo(done):
    made = lambda: InForm("box", done)  # noqa: E731
    result = fdtasil.distill(in_form(law, "box", done), made, 0, **QUICK)
    agent = result.to_sb3(made(), "PPO")
    rows = result.demonstrations.observations
    chosen = agent.predict(rows, deterministic=True)[0]
    expected = result.student.predict(rows)[0]
    first = int(done == "choice")  # of this space, which stable-baselines3 counts from 0
    assert np.array_equal(chosen + first, expected)


def test_what_is_no_actor_is_refused():
    result = fdtasil.distill(law, TOY, 0, **QUICK)
    with pytest.raises(SettingError, match="algorithm"):
        result.to_sb3(InForm(), "DQN")
    with pytest.raises(ExportError, match="actor of PPO"):
        result.to_sb3(InForm(), "PPO")
    chosen = fdtasil.distill(
        in_form(law, "box", "choice"), lambda: InForm("box", "choice"), 0, **QUICK
    )
    with pytest.raises(ExportError, match="choices"):
        chosen.to_sb3(InForm("box", "choice"), "SAC")


def test_another_environment_is_refused():
    result = fdtasil.distill(law, TOY, 0, **QUICK)
    with pytest.raises(ExportError, match="from"):
        result.to_sb3("Pendulum-v1", "SAC")
    for other in ("Nope-v1", "CartPole-v1"):
        with pytest.raises(ExportError, match="makes no SAC"):
            result.to_sb3(other, "SAC")
    some = fdtasil.distill(law, TOY, 0, student_obs=[0, 1], **QUICK)
    with pytest.raises(ExportError, match="whole observation"):
        some.to_sb3(InForm(), "SAC")
