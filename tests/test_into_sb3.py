"""A student goes on as an agent of stable-baselines3: the same answers before the first step."""

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY
from sb3_agents import seeded
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from toy_environments import Integrator
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


@pytest.mark.parametrize("done", ["choices", "flags"])
def test_choices_go_on_with_ppo(done):
    made = lambda: InForm("box", done)  # noqa: E731
    result = fdtasil.distill(in_form(law, "box", done), made, 0, **QUICK)
    agent = result.to_sb3(made(), "PPO")
    rows = result.demonstrations.observations
    chosen = agent.predict(rows, deterministic=True)[0]
    expected = result.student.predict(rows)[0]
    assert np.array_equal(chosen, expected)
    assert len(np.unique(expected)) > 1


@pytest.mark.parametrize("done", ["choice", "shifted"])
def test_choices_that_do_not_begin_at_0_go_on_as_the_refusal_says(done):
    """Of choices stable-baselines3 knows no start: it would act by others."""
    made = lambda: InForm("box", done)  # noqa: E731
    result, env = fdtasil.distill(in_form(law, "box", done), made, 0, **QUICK), made()
    with pytest.raises(ExportError, match="counts from 0") as caught:
        result.to_sb3(env, "PPO")
    code = caught.value.next_step.removeprefix("pass ")
    agent = result.to_sb3(eval(code, {"gymnasium": gymnasium, "env": env}), "PPO")
    rows = result.demonstrations.observations
    chosen = agent.predict(rows, deterministic=True)[0] + env.action_space.start
    assert np.array_equal(chosen, result.student.predict(rows)[0])
    inside = agent.get_env()
    inside.step(agent.predict(inside.reset(), deterministic=True)[0])  # it looks at its actions


@pytest.mark.parametrize("algorithm", ["SAC", "TD3"])
def test_actions_of_several_axes_go_on(algorithm):
    made = lambda: InForm("box", "column")  # noqa: E731
    result = fdtasil.distill(in_form(law, "box", "column"), made, 0, **QUICK)
    agent = result.to_sb3(made(), algorithm)
    rows = result.demonstrations.observations
    expected = result.student.predict(rows)[0]
    assert expected.shape == (len(rows), 2, 1)
    assert agent.predict(rows, deterministic=True)[0] == pytest.approx(expected, abs=1e-5)


@pytest.mark.fault(283)
def test_observations_are_not_normalised_twice():
    result = fdtasil.distill(law, TOY, 0, **QUICK)
    inside = DummyVecEnv([InForm])
    with pytest.raises(ExportError, match="in VecNormalize") as caught:
        result.to_sb3(VecMonitor(VecNormalize(inside)), "SAC")
    assert ".venv" in caught.value.next_step
    for env in (inside, VecNormalize(inside, norm_obs=False)):
        agent, rows = result.to_sb3(env, "SAC"), result.demonstrations.observations
        expected = result.student.predict(rows)[0]
        assert agent.predict(rows, deterministic=True)[0] == pytest.approx(expected, abs=1e-5)


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
    chosen = fdtasil.distill(
        in_form(law, "box", "choices"), lambda: InForm("box", "choices"), 0, **QUICK
    )
    with pytest.raises(ExportError, match=r"among \(2, 2\)"):
        chosen.to_sb3(InForm("box", "choice"), "PPO")  # as many scores
    some = fdtasil.distill(law, TOY, 0, student_obs=[0, 1], **QUICK)
    with pytest.raises(ExportError, match="whole observation"):
        some.to_sb3(InForm(), "SAC")


@pytest.mark.fault(298)
@pytest.mark.parametrize("seen", [[4, 3, 2, 1, 0], lambda rows: 3 * rows], ids=["turned", "grown"])
def test_a_student_that_sees_another_thing_is_no_agent(seen):
    result = fdtasil.distill(law, TOY, 0, student_obs=seen, **QUICK)
    with pytest.raises(ExportError, match="sees another thing than the observation"):
        result.to_sb3(InForm(), "SAC")


def test_a_student_of_all_columns_is_an_agent():
    result = fdtasil.distill(law, TOY, 0, student_obs=range(5), **QUICK)
    rows = result.demonstrations.observations
    answers = result.to_sb3(InForm(), "SAC").predict(rows, deterministic=True)[0]
    assert answers == pytest.approx(result.student.predict(rows)[0], abs=1e-5)


class _Beside(Integrator):
    """The toy, whose last number is a large one that stands still."""

    constant = 0.0

    def _observe(self):
        return np.concatenate([super()._observe()[:4], [self.constant]])


@pytest.mark.fault(317)
@pytest.mark.parametrize(("constant", "kept"), [(300.0, True), (1.7e9, False)])
def test_a_constant_that_rounds_away_what_moves_is_refused(constant, kept, monkeypatch):
    monkeypatch.setattr(_Beside, "constant", constant)
    result = fdtasil.distill(law, _Beside, 0, **{**QUICK, "horizon": 10})
    rows = result.demonstrations.observations
    if kept:
        agent = result.to_sb3(_Beside(), "SAC")
        expected = result.student.predict(rows)[0]
        assert agent.predict(rows, deterministic=True)[0] == pytest.approx(expected, abs=1e-3)
    else:
        with pytest.raises(ExportError, match=r"observation 4 is about 1\.7e") as caught:
            result.to_sb3(_Beside(), "SAC")
        assert "subtract" in caught.value.next_step


@pytest.mark.fault(347)
def test_small_bounds_are_compared_as_they_are():
    def small(factor):
        space = gymnasium.spaces.Box(-1e-9 * factor, 1e-9 * factor, (2,), np.float32)
        made = gymnasium.wrappers.TransformAction(Integrator(), lambda a: a / 1e-9, space)
        return gymnasium.wrappers.TimeLimit(made, 20)

    result = fdtasil.distill(lambda rows: 1e-9 * law(rows), lambda: small(1), 0, **QUICK)
    result.to_sb3(small(1), "SAC")
    with pytest.raises(ExportError, match="a student of actions from"):
        result.to_sb3(small(5), "SAC")


@pytest.mark.fault(347)
def test_an_environment_of_a_refused_agent_is_closed(monkeypatch):
    closed = []
    monkeypatch.setattr(DummyVecEnv, "close", lambda self: closed.append(self))
    result = fdtasil.distill(law, TOY, 0, **QUICK)
    with pytest.raises(ExportError, match="from"):
        result.to_sb3("Pendulum-v1", "SAC")
    assert len(closed) == 1
