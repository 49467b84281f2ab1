"""Policies in environments; the only file that steps an environment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium
import numpy as np

from fdtasil.environments import EnvironmentPool
from fdtasil.errors import EnvironmentFault

__all__ = [
    "Behaviour",
    "Decision",
    "Episodes",
    "Policy",
    "first_observations",
    "follow",
    "rollout",
]

Policy = Callable[[np.ndarray], np.ndarray]
"""(B, n) float32 raw observations -> (B, m) float32 actions in environment units."""

# Copies of the environment stepped in turn: enough that asking the policy for a batch costs
# little beside the physics, few enough that making them is quick.
_SLOTS = 25


class Decision(NamedTuple):
    """What a behaviour does, and the expert's answer where the behaviour asked for it.

    Attributes:
        action: (B, m) float32, sent to the environment after clipping to its bounds.
        expert_action: (B, m) float32 unclipped expert answer at the same states, or None.
    """

    action: np.ndarray
    expert_action: np.ndarray | None


Behaviour = Callable[[np.ndarray, Sequence[np.random.Generator]], Decision]
"""(B, n) observations and B generators, one an episode -> who acts, and how."""


def follow(policy: Policy) -> Behaviour:
    """Return the behaviour that does what `policy` says."""
    return lambda observations, _: Decision(policy(observations), None)


@dataclass(frozen=True)
class Episodes:
    """Recorded episodes: one slot of each array is one episode, padded with zeros.

    Attributes:
        observations: (E, T, n) float32, what the policy saw.
        actions: (E, T, m) float32, what it said, before clipping to the bounds.
        expert_actions: (E, T, m) float32, the expert's answers that the behaviour had.
        answered: (E, T) bool, where it had one.
        rewards: (E, T) float64.
        valid: (E, T) bool, true up to and including the step that ended the episode.
        seeds: (E,) reset seeds.
        terminated: (E,) bool, true where the environment ended the episode (a fall), false where
            time did.
        clipped_actions: Steps at which an action had to be clipped.
        physics_resets: Steps at which the simulator silently put itself back to its start.
    """

    observations: np.ndarray
    actions: np.ndarray
    expert_actions: np.ndarray
    answered: np.ndarray
    rewards: np.ndarray
    valid: np.ndarray
    seeds: np.ndarray
    terminated: np.ndarray
    clipped_actions: int
    physics_resets: int

    @property
    def lengths(self) -> np.ndarray:
        """(E,) number of steps of each episode."""
        return self.valid.sum(axis=1)

    @property
    def returns(self) -> np.ndarray:
        """(E,) undiscounted sum of rewards of each episode."""
        return self.rewards.sum(axis=1)


def rollout(
    behaviour: Behaviour,
    pool: EnvironmentPool,
    seeds: Sequence[int],
    horizon: int,
    noise: Sequence[np.random.Generator] | None = None,
    on_step: Callable[[int], None] = lambda count: None,
) -> Episodes:
    """Record one episode for each seed, a batch of them side by side.

    An episode depends on its own seed and noise generator only, not on the episodes beside it.

    Args:
        behaviour: Who acts; `follow(policy)` for a plain policy.
        pool: Where.
        seeds: (E,) reset seed of each episode.
        horizon: T, steps after which an episode is cut.
        noise: (E,) generators handed to the behaviour; none are needed by plain policies.
        on_step: Told the number of environment steps just done.

    Returns:
        The episodes, in the order of `seeds`.

    Raises:
        EnvironmentFault: If the environment raises, or observations are not finite.
    """
    record = _Record(len(seeds), horizon, pool)
    generators = list(noise) if noise is not None else [np.random.default_rng(s) for s in seeds]
    members = pool.take(min(len(seeds), _SLOTS))
    for first in range(0, len(seeds), len(members)):
        chunk = range(first, min(first + len(members), len(seeds)))
        environments = dict(zip(chunk, members, strict=False))
        alive = list(chunk)
        batch = _observed([_reset(environments[e], int(seeds[e]), pool) for e in alive], pool)
        for step in range(horizon):
            decision = behaviour(batch, [generators[e] for e in alive])
            allowed = record.decide(alive, step, batch, decision)
            after, going = [], np.ones(len(alive), bool)
            for row, episode in enumerate(alive):
                observation, reward, terminated, truncated = _step(
                    environments[episode], allowed[row], record, pool
                )
                record.rewards[episode, step] = reward
                record.terminated[episode] = terminated
                after.append(observation)
                going[row] = not (terminated or truncated)
            on_step(len(alive))
            batch = _observed(after, pool)[going]
            alive = [episode for row, episode in enumerate(alive) if going[row]]
            if not alive:
                break
    return record.episodes(seeds)


def first_observations(pool: EnvironmentPool, seeds: Sequence[int]) -> np.ndarray:
    """Return the (E, n) float32 observations that episodes of these seeds start from."""
    (environment,) = pool.take(1)
    return _observed([_reset(environment, int(seed), pool) for seed in seeds], pool)


class _Record:
    """The arrays of `Episodes` while they are being filled."""

    def __init__(self, episodes: int, horizon: int, pool: EnvironmentPool) -> None:
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        self._low, self._high = pool.boxes.low, pool.boxes.high
        self.observations = np.zeros((episodes, horizon, n), np.float32)
        self.actions = np.zeros((episodes, horizon, m), np.float32)
        self.expert_actions = np.zeros((episodes, horizon, m), np.float32)
        self.answered = np.zeros((episodes, horizon), bool)
        self.rewards = np.zeros((episodes, horizon))
        self.valid = np.zeros((episodes, horizon), bool)
        self.terminated = np.zeros(episodes, bool)
        self.clipped_actions = self.physics_resets = 0

    def decide(
        self, alive: list[int], step: int, observations: np.ndarray, decision: Decision
    ) -> np.ndarray:
        """Record a step's decision; return its actions within the bounds."""
        expected = (len(alive), self.actions.shape[2])
        if decision.action.shape != expected:
            raise EnvironmentFault(
                f"a policy answered with actions of shape {decision.action.shape}",
                f"{expected}, as the environment takes",
                "check that policy and environment belong together",
            )
        self.observations[alive, step] = observations
        self.actions[alive, step] = decision.action
        self.valid[alive, step] = True
        if decision.expert_action is not None:
            self.expert_actions[alive, step] = decision.expert_action
            self.answered[alive, step] = True
        allowed = np.minimum(np.maximum(decision.action, self._low), self._high)
        self.clipped_actions += int((allowed != decision.action).any(axis=1).sum())
        return allowed

    def episodes(self, seeds: Sequence[int]) -> Episodes:
        return Episodes(
            self.observations,
            self.actions,
            self.expert_actions,
            self.answered,
            self.rewards,
            self.valid,
            np.asarray(seeds, np.int64),
            self.terminated,
            self.clipped_actions,
            self.physics_resets,
        )


def _reset(environment: gymnasium.Env, seed: int, pool: EnvironmentPool) -> np.ndarray:
    try:
        observation, _ = environment.reset(seed=seed)
    except Exception as error:
        raise _crash(pool, f"reset(seed={seed})", error) from error
    return observation


def _step(
    environment: gymnasium.Env, action: np.ndarray, record: _Record, pool: EnvironmentPool
) -> tuple[np.ndarray, float, bool, bool]:
    # MuJoCo resets an unstable simulation inside step() and says so only by its clock.
    data = getattr(environment.unwrapped, "data", None)
    before = getattr(data, "time", None)
    try:
        observation, reward, terminated, truncated, _ = environment.step(action)
    except Exception as error:
        raise _crash(pool, "step()", error) from error
    if before is not None and getattr(data, "time", before) < before:
        record.physics_resets += 1
    return observation, float(reward), bool(terminated), bool(truncated)


def _observed(observations: Sequence[np.ndarray], pool: EnvironmentPool) -> np.ndarray:
    """Return observations as one float32 array; looked at together, for it is quicker so."""
    expected = (pool.boxes.observation_size,)
    if all(np.shape(row) == expected for row in observations):
        batch = np.array(observations, np.float32)
        if np.isfinite(batch).all():
            return batch
    rows = [np.asarray(row, np.float32) for row in observations]
    bad = next(row for row in rows if row.shape != expected or not np.isfinite(row).all())
    raise EnvironmentFault(
        f"{pool.name} returned an observation of shape {bad.shape}, "
        f"{np.count_nonzero(~np.isfinite(bad))} of its values not finite",
        f"{expected[0]} finite numbers",
        "mend the environment, or end the episode before it diverges",
    )


def _crash(pool: EnvironmentPool, call: str, error: Exception) -> EnvironmentFault:
    return EnvironmentFault(
        f"{pool.name}: {call} raised {type(error).__name__}: {error}",
        "an environment that runs without raising",
        "run it on its own with random actions, and mend it",
    )
