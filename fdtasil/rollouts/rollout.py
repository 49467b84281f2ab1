"""Policies in environments, a batch of episodes side by side."""

from collections.abc import Callable, Sequence

import numpy as np

from fdtasil.rollouts.behaviours import Behaviour
from fdtasil.rollouts.environments import EnvironmentPool, simulator_warnings
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.recording import Recording
from fdtasil.rollouts.stepping import step_together
from fdtasil.rollouts.trials import stages_of

__all__ = ["first_observations", "rollout"]

# Copies of the environment stepped in turn: enough that asking the policy for a batch costs
# little beside the physics, few enough that making them is quick.
_SLOTS = 25


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
    record = Recording(seeds, horizon, pool)
    generators = list(noise) if noise is not None else [np.random.default_rng(s) for s in seeds]
    with simulator_warnings():
        stages = stages_of(pool, record, min(len(seeds), _SLOTS))
        for playing in stages(range(len(seeds))):
            step_together(record, playing, behaviour, generators, horizon, on_step)
    return record.episodes()


def first_observations(pool: EnvironmentPool, seeds: Sequence[int]) -> np.ndarray:
    """Return the (E, n) float32 observations that episodes of these seeds start from."""
    record = Recording(seeds, 0, pool)
    with simulator_warnings():
        stages = stages_of(pool, record, 1)
        return np.concatenate([playing.begin() for playing in stages(range(len(seeds)))])
