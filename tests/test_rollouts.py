"""Rollouts: one episode a seed, masked after its end, the same whatever runs beside it."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, TOY
from toy_environments import Integrator, Jumps

from fdtasil.errors import EnvironmentFault, FdtasilWarning, SettingError
from fdtasil.rollouts.behaviours import Decision, farthest_apart, follow, random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool, resolve_horizon
from fdtasil.rollouts.episodes import check_episodes
from fdtasil.rollouts.rollout import rollout

WALLED = "toy_environments:toy/Walled-v0"


def still(observations):
    return np.zeros((len(observations), 2), np.float32)


def run(environment, seeds, horizon=30, behaviour=None):
    with EnvironmentPool(environment) as pool:
        return rollout(behaviour or follow(still), pool, seeds, horizon)


@pytest.mark.fault(69)
def test_shapes_masks_and_ends():
    episodes = run(WALLED, range(8))
    assert episodes.observations.shape == (8, 30, 5)
    assert episodes.actions.shape == (8, 30, 2)
    assert 0 < episodes.terminated.sum() < 8
    for e in range(8):
        length = episodes.lengths[e]
        assert episodes.valid[e].tolist() == [True] * length + [False] * (30 - length)
        assert (length < 30) == episodes.terminated[e]
        assert not episodes.observations[e, length:].any()
        assert not episodes.rewards[e, length:].any()
    assert (episodes.spread(300)[:, 4] == 3).all()  # the constant, of visited states alone


def test_an_episode_does_not_depend_on_those_beside_it():
    together = run(WALLED, range(40))
    for e in (0, 17, 39):
        alone = run(WALLED, [e])
        assert np.array_equal(alone.observations[0], together.observations[e])
        assert np.array_equal(alone.rewards[0], together.rewards[e])


def test_an_instance_gives_the_same_episodes_one_at_a_time():
    def push(observations):
        return observations @ GAIN.T

    many = run(TOY, range(5), behaviour=follow(push))
    one = run(Integrator(), range(5), behaviour=follow(push))
    made = run(Integrator, range(5), behaviour=follow(push))
    assert np.allclose(many.observations, one.observations, atol=1e-6)
    assert np.array_equal(many.observations, made.observations)


def test_noise_belongs_to_the_episode():
    def noisy(observations, noise):
        assert len(noise) == len(observations)
        rows = [random.uniform(-1, 1, 2) for random in noise]
        return Decision(np.asarray(rows, np.float32), None)

    with EnvironmentPool(WALLED) as pool:
        generators = [np.random.default_rng(e) for e in range(30)]
        together = rollout(noisy, pool, range(30), 20, generators)
        alone = rollout(noisy, pool, [29], 20, [np.random.default_rng(29)])
    assert np.array_equal(alone.actions[0], together.actions[29])


def test_actions_are_clipped_for_the_environment_only():
    episodes = run(TOY, [0], behaviour=follow(lambda x: np.full((len(x), 2), 7, np.float32)))
    assert (episodes.actions[episodes.valid] == 7).all()
    assert episodes.clipped_actions == episodes.valid.sum()


@pytest.mark.fault(68)
def test_the_time_limit_is_the_default_horizon():
    with EnvironmentPool(TOY) as pool:
        assert resolve_horizon(None, pool) == 40
    with EnvironmentPool("toy_environments:toy/Endless-v0") as pool:
        with pytest.raises(SettingError, match="no horizon for toy/Endless-v0"):
            resolve_horizon(None, pool)
        for wrong in (0, -1, 2.5, True):
            with pytest.raises(SettingError):
                resolve_horizon(wrong, pool)


class Broken(Integrator):
    """Goes wrong in its third step, in the way that it is told."""

    def __init__(self, how):
        super().__init__()
        self.how, self.steps = how, 0

    def step(self, action):
        self.steps += 1
        observation, *rest = super().step(action)
        return self.how(self.steps, observation), *rest


def _raise(step, observation):
    if step == 3:
        raise ValueError("boom")
    return observation


@pytest.mark.parametrize(
    ("how", "found"),
    [
        (_raise, r"step\(\) raised ValueError: boom"),
        (lambda step, x: x * np.nan if step == 3 else x, "5 of the observation's 5 values"),
        (lambda step, x: x[:4], r"shape \(4,\)"),
    ],
)
def test_a_broken_environment_is_described(how, found):
    with pytest.raises(EnvironmentFault, match=found):
        run(lambda: Broken(how), [0])


@pytest.mark.parametrize(
    ("environment", "found"),
    [
        ("NoSuchThing-v0", "can't be made"),
        (lambda: 3, "factory returned int"),
        (3, "env is a int"),
        (
            lambda: gymnasium.wrappers.TransformObservation(
                Integrator(), lambda x: {"x": x}, gymnasium.spaces.Dict(x=gymnasium.spaces.Text(3))
            ),
            "observations whose 'x' is Text",
        ),
    ],
)  # fmt: skip
def test_an_environment_that_can_not_be_used_is_described(environment, found):
    with pytest.raises(EnvironmentFault, match=found):
        EnvironmentPool(environment)


@pytest.mark.fault(76)
def test_a_silent_physics_reset_is_counted():
    with pytest.warns(FdtasilWarning, match="reset itself in 1 of 1 episodes"):
        assert run(Jumps, [0], horizon=12).physics_resets.tolist() == [2]


def test_other_data_than_a_simulators_is_left_alone():
    class Trades(Integrator):
        class data:
            time = np.arange(3)

    assert run(Trades, [0], horizon=3).physics_resets.tolist() == [0]


def test_what_can_be_learnt_from_an_experts_episodes():
    """A single one may fall by chance, and so may a step be all there is."""
    episodes = run(TOY, range(4), horizon=5)
    short = np.tile(np.arange(5) < 1, (4, 1))
    resets = np.array([1, 2, 0, 0])
    for good in (
        episodes,
        replace(episodes, physics_resets=resets),
        replace(episodes, valid=short | (np.arange(4) == 2)[:, None]),
        replace(episodes, valid=short[:1]),
        replace(episodes, valid=short[:, :1]),
    ):
        check_episodes(good, "toy")
    with pytest.raises(EnvironmentFault, match="reset itself in 3 of 4 episodes"):
        check_episodes(replace(episodes, physics_resets=resets[[0, 1, 1, 2]]), "toy")
    with pytest.raises(
        EnvironmentFault, match="all 4 episodes of the expert ended at their first"
    ):
        check_episodes(replace(episodes, valid=short), "toy")


def test_random_actions_are_uniform_between_bounds_and_normal_without():
    class Free(Integrator):
        def __init__(self):
            super().__init__()
            ends = np.float32([-1, -np.inf]), np.float32([3, np.inf])
            self.action_space = gymnasium.spaces.Box(*ends)

    with EnvironmentPool(Free) as pool:
        act, random = random_behaviour(pool), np.random.default_rng(0)
        bounded, free = act(np.zeros((4000, 5)), [random] * 4000).action.T
    shares = np.histogram(bounded, bins=[-1, 0, 1, 2, 3])[0] / 4000
    assert shares == pytest.approx([0.25] * 4, abs=0.03)
    assert (free.mean(), free.std()) == pytest.approx((0, 1), abs=0.05)


def test_answers_are_compared_where_both_are_some():
    ours, theirs = np.array([[np.nan, 1, 2, 9], [0, np.nan, 5, 9]])[..., None]
    ours, theirs = (np.pad(one, [(0, 0), (0, 1)]) for one in (ours, theirs))  # and a whole action
    assert farthest_apart(ours, theirs) == 3
    assert farthest_apart(ours[:2], theirs[:2]) == 0
