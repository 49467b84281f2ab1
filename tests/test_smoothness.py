"""Roughness of actions: known signals have known values."""

import tracemalloc
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from conftest import QUICK
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.probes.scales import measure_scales
from fdtasil.results.smoothness import smoothness_of
from fdtasil.results.stability import distances
from fdtasil.rollouts.behaviours import Decision, follow
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
        episodes = rollout(act, pool, [0, 1], horizon)
        return smoothness_of(episodes, pool, episodes)


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


@pytest.mark.fault(277)
def test_every_step_counts_the_same_in_the_spectrum():
    """A slow sine of 64 steps, and a fall of 16 fast ones with half of its squares."""

    def act(observations, _):
        k = len(steps)
        steps.append(k)
        slow, fast = 0.5 * np.sin(2 * np.pi * k / 64), 0.5 * (-1) ** k
        return Decision(np.float32([[slow, 0], [fast, 0]]), None)

    steps = []
    with EnvironmentPool(lambda: InForm("box", "box", wall=99)) as pool:
        episodes = rollout(act, pool, [0, 1], 64)
        valid = episodes.valid.copy()
        valid[1, 16:] = False
        episodes = replace(episodes, valid=valid)
        found = smoothness_of(episodes, pool, episodes)
    assert found.high_frequency == pytest.approx(1 / 3, abs=1e-3)


def test_actions_without_bounds_are_measured_by_the_experts():
    unbounded = lambda: gymnasium.wrappers.TransformAction(  # noqa: E731
        InForm("box", "box", wall=99),
        lambda action: np.clip(action, -1, 1),
        gymnasium.spaces.Box(-np.inf, np.inf, (2,)),
    )
    law = lambda x: -x[:, :2] - x[:, 2:4]  # noqa: E731
    found = fdtasil.evaluate(
        lambda x: 10 * law(x), law, unbounded, episodes=2, horizon=20, progress=False
    )
    assert found.roughness > 3 * found.expert_roughness


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


class Mixed(gymnasium.Env):
    """A number that is a fast or a slow signal, beside a choice that is made anew or kept."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Dict(
        {"b": gymnasium.spaces.Discrete(2), "u": gymnasium.spaces.Box(-1, 1, (1,))}
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.float32([self.time % 2]), 1.0, False, False, {}


def test_a_mixed_action_is_as_rough_as_its_parts():
    """The choice of two scores changes never or always, the number by half of its range."""
    for (b, u), rough, fast in (((0, 1), 0.5, 1.0), ((1, 0), 0.5, None), ((1, 1), 1.0, 1.0)):

        def law(rows, b=b, u=u):
            odd = 2 * rows - 1
            return np.concatenate([b * odd, -b * odd, 0.5 * u * odd], axis=1)

        made = lambda: gymnasium.wrappers.TimeLimit(Mixed(), 20)  # noqa: E731
        found = fdtasil.evaluate(law, law, made, episodes=2, progress=False)
        assert found.roughness == pytest.approx(rough)
        assert found.high_frequency == (fast if fast is None else pytest.approx(fast))


@pytest.mark.fault(346)
def test_a_horizon_far_beyond_what_is_played_costs_no_memory():
    brief = lambda: gymnasium.wrappers.TimeLimit(InForm(), 10)  # noqa: E731
    idle, push = (
        follow(lambda rows, push=push: np.full((len(rows), 2), push, np.float32))
        for push in (0.0, 0.5)
    )
    found = []
    with EnvironmentPool(brief) as pool:
        for horizon in (10, 100_000):
            theirs, ours = (rollout(one, pool, [1, 2], horizon) for one in (idle, push))
            scales = measure_scales(theirs.observations[theirs.valid])
            tracemalloc.start()
            rough = smoothness_of(ours, pool, theirs)
            found.append((distances(theirs, ours, scales).tolist(), rough))
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
    assert found[0] == found[1]
    assert peak < 40 * 2 * 100_000  # a few numbers for each step, however long observations are
