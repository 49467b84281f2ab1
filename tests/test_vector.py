"""Environments that step together: the same demonstrations as from single ones."""

import multiprocessing
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecNormalize,
)
from toy_environments import Integrator, Jumps
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import EnvironmentFault, FdtasilWarning
from fdtasil.rollouts import vector
from fdtasil.rollouts.behaviours import follow, random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout

pytestmark = pytest.mark.usefixtures("no_pictures")
MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
ARRAYS = ("observations", "actions", "rewards", "valid", "terminated", "seeds")


def walled(seen="box", done="box"):
    """Some of its episodes end early, all after 30 steps."""
    return gymnasium.wrappers.TimeLimit(InForm(seen, done, wall=0.9), 30)


def sync(mode, seen="box", done="box"):
    return SyncVectorEnv([lambda: walled(seen, done)] * 3, autoreset_mode=mode)


KINDS = {
    **{f"sync, {mode.value}": lambda mode=mode: sync(mode) for mode in AutoresetMode},
    **{
        f"async, {mode.value}": lambda mode=mode: AsyncVectorEnv([walled] * 3, autoreset_mode=mode)
        for mode in AutoresetMode
    },
    "DummyVecEnv": lambda: DummyVecEnv([walled] * 3),
    "SubprocVecEnv": lambda: SubprocVecEnv([walled] * 3),
}


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


@pytest.mark.slow
@pytest.mark.fault(216)
@pytest.mark.parametrize("kind", KINDS)
def test_episodes_are_those_of_single_environments(kind):
    with EnvironmentPool(walled) as single, EnvironmentPool(KINDS[kind]) as many:
        assert many.together.count == 3
        seeds = [11, 5, 8, 3, 4, 90, 2]  # three, three, and one beside two that idle
        found, expected = (
            rollout(random_behaviour(pool), pool, seeds, 30) for pool in (many, single)
        )
    assert 0 < expected.terminated.sum() < 7
    for name in ARRAYS:
        ours, theirs = getattr(found, name), getattr(expected, name)
        if name == "rewards" and kind.startswith("Dummy"):  # which it keeps in float32
            theirs = theirs.astype(np.float32)
        assert np.array_equal(ours, theirs), name


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[pytest.mark.torture] * kind.startswith("Subproc"))
        for kind in KINDS
    ],
)
def test_a_whole_run(kind, tmp_path):
    """Rollout, probes, training, evaluation, ONNX, resume."""
    options = {**QUICK, "progress": False, "trainer": "dagger", "episodes": 3}

    def stop(event):
        if event.kind == "round":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fdtasil.distill(law, KINDS[kind], 2, **options, out=tmp_path / "run", callback=stop)
    many = fdtasil.distill(law, KINDS[kind], 2, **options, resume=tmp_path / "run")
    single = fdtasil.distill(law, walled, 2, **options)
    assert many.demonstrations.observations == pytest.approx(
        single.demonstrations.observations, abs=1e-5
    )
    assert many.evaluation.student_returns == pytest.approx(
        single.evaluation.student_returns, abs=1e-3
    )
    judged = fdtasil.evaluate(
        str(tmp_path / "run" / "student.onnx"), law, KINDS[kind], episodes=2, horizon=20
    )
    assert judged.student_returns == pytest.approx(many.evaluation.student_returns, rel=1e-4)


def test_other_forms_step_together_too():
    options = {**QUICK, "progress": False}
    seen, done = "nested", "choice"
    expert = in_form(law, seen, done)
    many, single = (
        fdtasil.distill(expert, env, 2, **options)
        for env in (lambda: sync(AutoresetMode.NEXT_STEP, seen, done), lambda: walled(seen, done))
    )
    assert np.array_equal(many.demonstrations.observations, single.demonstrations.observations)
    assert many.evaluation == single.evaluation


class OneSeed(gymnasium.vector.VectorEnv):
    """As simulators on a GPU are: tensors, one seed for all, a reset in the same step."""

    def __init__(self, count=4, limit=20):
        self.num_envs, self.max_episode_length = count, limit
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,))
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (2,))
        self.device = torch.device("cpu")

    def _new(self, which):
        fresh = torch.rand((self.num_envs, 4), generator=self.random) * 2 - 1
        self.state = torch.where(which[:, None], fresh, self.state)
        self.steps = torch.where(which, 0, self.steps)

    def reset(self, *, seed=None, options=None):
        assert seed is None or isinstance(seed, int)
        self.random = torch.Generator().manual_seed(seed or 0)
        self.state = torch.zeros((self.num_envs, 4))
        self.steps = torch.zeros(self.num_envs, dtype=torch.int64)
        self._new(torch.ones(self.num_envs, dtype=torch.bool))
        return self._observe(), {}

    def step(self, actions):
        assert isinstance(actions, torch.Tensor)
        assert actions.shape == (self.num_envs, 2)
        assert bool((actions.abs() <= 1).all())
        place, speed = self.state[:, :2], self.state[:, 2:]
        speed = speed + 0.1 * actions
        self.state = torch.cat([place + 0.1 * speed, speed], dim=1)
        self.steps = self.steps + 1
        reward = 1 - self.state[:, :2].abs().sum(dim=1)
        terminated = (self.state[:, :2].abs() > 1.2).any(dim=1)
        truncated = self.steps >= self.max_episode_length
        self._new(terminated | truncated)
        return self._observe(), reward, terminated, truncated, {}

    def _observe(self):
        return torch.cat([self.state, torch.full((self.num_envs, 1), 3.0)], dim=1)


@pytest.mark.fault(216)
def test_a_simulator_with_tensors_and_one_seed():
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", FdtasilWarning)
        result = fdtasil.distill(law, OneSeed, 2, **{**QUICK, "episodes": 6, "horizon": None})
        again = fdtasil.evaluate(law, law, OneSeed, episodes=6)
    assert any("one seed for all of its 4" in str(one.message) for one in heard)
    assert result.settings["horizon"] == 20
    states = result.demonstrations
    assert states.episodes == 6
    assert states.actions == pytest.approx(law(states.observations), abs=1e-6)
    assert again.student_returns == again.expert_returns


def test_an_own_vector_environment_is_not_closed():
    own = sync(AutoresetMode.NEXT_STEP)
    first, second = (fdtasil.distill(law, own, 2, **QUICK) for _ in range(2))
    assert first.dataset.to_bytes() == second.dataset.to_bytes()
    assert not own.closed


def test_frames_stacked_by_stable_baselines3():
    stacked = lambda: VecFrameStack(DummyVecEnv([walled] * 2), 3)  # noqa: E731
    newest = lambda rows: law(rows[:, -5:])  # noqa: E731
    result = fdtasil.distill(newest, stacked, 2, **QUICK)
    assert result.demonstrations.observations.shape[1] == 15
    first = result.demonstrations.observations[0]
    assert not first[:10].any()  # each episode begins with an empty stack


@pytest.mark.fault(336)
@pytest.mark.parametrize(
    "kind",
    [
        *(lambda mode=mode: SyncVectorEnv([Jumps] * 2, autoreset_mode=mode) for mode in MODES),
        lambda: DummyVecEnv([Jumps] * 2),
        fdtasil.Environment("toy_environments:toy/Jumps-v0", num_envs=2),
    ],
)
def test_a_silent_physics_reset_is_counted_in_each(kind):
    idle = follow(lambda rows: np.zeros((len(rows), 2), np.float32))
    with (
        EnvironmentPool(kind) as pool,
        EnvironmentPool(Jumps) as alone,
        pytest.warns(FdtasilWarning, match="reset itself in 3 of 3 episodes"),
    ):
        found, expected = (rollout(idle, one, [1, 2, 3], 12) for one in (pool, alone))
    assert found.physics_resets.tolist() == expected.physics_resets.tolist() == [2, 2, 2]


class Batched(SyncVectorEnv):
    """One whose `envs` are no environments, and whose info is none."""

    def __init__(self):
        super().__init__([Integrator] * 2)
        self.inner, self.envs = self.envs, 2

    def step(self, actions):
        self.envs = self.inner
        found = super().step(actions)
        self.envs = 2
        return *found[:4], None

    def reset(self, **named):
        self.envs = self.inner
        found = super().reset(**named)
        self.envs = 2
        return found


def test_what_is_called_envs_may_be_something_else():
    idle = follow(lambda rows: np.zeros((len(rows), 2), np.float32))
    with EnvironmentPool(Batched()) as pool, EnvironmentPool(Integrator) as alone:
        found, expected = (rollout(idle, one, [1, 2], 12) for one in (pool, alone))
    assert np.array_equal(found.observations, expected.observations)


def test_wrappers_of_copies_in_processes_are_kept():
    kwargs = {"wrappers": [lambda env: gymnasium.wrappers.TransformReward(env, lambda r: 2 * r)]}
    doubled = fdtasil.Environment("toy_environments:toy/Walled-v0", kwargs, num_envs=2)
    idle = follow(lambda rows: np.zeros((len(rows), 2), np.float32))
    with EnvironmentPool(doubled) as pool, EnvironmentPool(doubled.environment) as alone:
        found, expected = (rollout(idle, one, [1, 2], 5) for one in (pool, alone))
    assert np.allclose(found.rewards, 2 * expected.rewards)


@pytest.mark.fault(337)
def test_processes_of_environments_end_with_one_of_them():
    begun = set(multiprocessing.active_children())
    exits = fdtasil.Environment("toy_environments:toy/Exits-v0", num_envs=3)
    with pytest.raises(EnvironmentFault, match="one of its processes has ended"):
        fdtasil.distill(law, exits, 0, **QUICK)
    assert set(multiprocessing.active_children()) <= begun


@pytest.mark.fault(337)
def test_processes_of_environments_end_where_one_hangs(monkeypatch):
    monkeypatch.setattr(vector, "_PATIENCE", 0.5)
    begun = set(multiprocessing.active_children())
    hangs = fdtasil.Environment("toy_environments:toy/Sleeps-v0", num_envs=2)
    with EnvironmentPool(hangs) as pool:
        pool.together.reset([0, 1], None)
        pool.together._env.unwrapped.step_async(np.zeros((2, 2), np.float32))
        assert len(set(multiprocessing.active_children()) - begun) == 2
    assert set(multiprocessing.active_children()) <= begun


@pytest.mark.fault(217)
@pytest.mark.parametrize(
    "wrapped",
    [
        lambda: VecNormalize(DummyVecEnv([walled])),
        lambda: gymnasium.wrappers.vector.NormalizeObservation(sync(AutoresetMode.NEXT_STEP)),
    ],
)
def test_a_normaliser_that_goes_on_is_refused(wrapped):
    with pytest.raises(EnvironmentFault, match="Normalize"):
        fdtasil.distill(law, wrapped, 2, **QUICK)


@pytest.mark.parametrize("changes", [{"history": 2}])
def test_a_history_wants_a_single_environment(changes):
    with pytest.raises(EnvironmentFault, match="vector environment"):
        fdtasil.distill(law, lambda: sync(AutoresetMode.NEXT_STEP), 2, **QUICK, **changes)


def test_what_an_environment_raises_is_named():
    class Breaks(InForm):
        def step(self, action):
            raise RuntimeError("no more")

    breaks = lambda: SyncVectorEnv([Breaks, Breaks])  # noqa: E731
    with pytest.raises(EnvironmentFault, match=r"step\(\) raised RuntimeError: no more"):
        fdtasil.distill(law, breaks, 2, **QUICK)


def test_copies_in_processes():
    many = fdtasil.Environment("toy_environments:toy/Walled-v0", num_envs=3)
    idle = follow(lambda rows: np.zeros((len(rows), 2), np.float32))
    with EnvironmentPool(many) as together, EnvironmentPool(many.environment) as single:
        assert together.name == "toy/Walled-v0"
        assert together.time_limit == 40
        found, expected = (rollout(idle, pool, range(4), 10) for pool in (together, single))
    assert np.array_equal(found.observations, expected.observations)
