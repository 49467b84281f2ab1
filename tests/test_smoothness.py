"""Roughness of actions: known signals have known values."""

import numpy as np
import pytest
from conftest import QUICK
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.results.smoothness import smoothness_of
from fdtasil.rollouts.behaviours import Decision
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout

pytestmark = pytest.mark.usefixtures("no_pictures")


def played(signal, horizon=32, done="box"):
    """Episodes in which action 0 follows a signal of the step, and action 1 rests."""
    count = [0]

    def act(observations, _):
        value = signal(count[0])
        count[0] += 1
        return Decision(np.tile(np.float32([value, 0.5]), (len(observations), 1)), None)

    with EnvironmentPool(lambda: InForm("box", done, wall=99)) as pool:
        return smoothness_of(rollout(act, pool, [0, 1], horizon), pool)


@pytest.mark.parametrize(
    ("signal", "rough", "fast"),
    [
        (lambda k: 0.5, 0.0, None),
        (lambda k: 0.5 * (-1) ** k, 0.5, 1.0),  # the fastest there is; the mean is of two actions
        (lambda k: 0.5 * np.sin(2 * np.pi * k / 32), 0.0314, 0.0),
        (lambda k: 3 * (-1) ** k, 1.0, 1.0),  # as the environment takes it, clipped
        # As much power in the fastest as in a slow sine, which stands for two frequencies.
        (lambda k: 0.3 * (-1) ** k + 0.18**0.5 * np.sin(2 * np.pi * k / 32), None, 0.5),
    ],
)
def test_known_signals(signal, rough, fast):
    found = played(signal)
    if rough is not None:
        assert found.roughness == pytest.approx(rough, abs=2e-3)
    if fast is None:
        assert found.high_frequency is None
    else:
        assert found.high_frequency == pytest.approx(fast, abs=1e-6)


def test_short_episodes():
    assert played(lambda k: (-1) ** k, horizon=8).high_frequency is None
    assert played(lambda k: 1, horizon=1).roughness is None


def test_it_is_part_of_the_evaluation():
    law = lambda x: np.clip(-x[:, :2] - x[:, 2:4], -1, 1)  # noqa: E731
    result = fdtasil.distill(law, InForm, 0, **QUICK)
    assert 0 < result.evaluation.expert_roughness < 0.5
    assert "roughness" in str(result.evaluation)
    same = fdtasil.evaluate(law, law, InForm, episodes=2, horizon=20)
    assert same.roughness == same.expert_roughness
    chosen = in_form(law, "box", "choice")
    choices = fdtasil.evaluate(
        chosen, chosen, lambda: InForm("box", "choice"), episodes=2, horizon=20
    )
    assert 0 <= choices.roughness <= 1
    assert choices.high_frequency is None
