"""Policies in environments, a batch of episodes side by side."""

from collections.abc import Callable, Sequence

import numpy as np

from fdtasil.rollouts.behaviours import Behaviour
from fdtasil.rollouts.environments import EnvironmentPool, simulator_warnings
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.recording import Recording

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
    members = pool.take(min(len(seeds), _SLOTS))
    with simulator_warnings():
        for first in range(0, len(seeds), len(members)):
            chunk = range(first, min(first + len(members), len(seeds)))
            environments = dict(zip(chunk, members, strict=False))
            alive = list(chunk)
            first_ones = [record.reset(environments[e], e) for e in alive]
            batch = record.observed(first_ones, alive, None)
            for step in range(horizon):
                decision = behaviour(batch, [generators[e] for e in alive])
                allowed = record.decide(alive, step, batch, decision)
                after, going = [], np.ones(len(alive), bool)
                for row, episode in enumerate(alive):
                    observation, going[row] = record.step(
                        environments[episode], allowed[row], episode, step
                    )
                    after.append(observation)
                on_step(len(alive))
                record.check_rewards(alive, step)
                batch = record.observed(after, alive, step)[going]
                alive = [episode for row, episode in enumerate(alive) if going[row]]
                if not alive:
                    break
    return record.episodes()


def first_observations(pool: EnvironmentPool, seeds: Sequence[int]) -> np.ndarray:
    """Return the (E, n) float32 observations that episodes of these seeds start from."""
    (environment,) = pool.take(1)
    record, numbers = Recording(seeds, 0, pool), range(len(seeds))
    with simulator_warnings():
        return record.observed([record.reset(environment, e) for e in numbers], numbers, None)
