"""Who acts in an environment: a policy, or a behaviour that may also ask the expert."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fdtasil.rollouts.environments import EnvironmentPool

__all__ = ["Behaviour", "Decision", "Policy", "follow"]

Policy = Callable[[np.ndarray], np.ndarray]
"""(B, n) float32 raw observations -> (B, m) float32 actions in environment units."""


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


def random_behaviour(pool: EnvironmentPool) -> Behaviour:
    """Return the behaviour of uniformly random actions; unbounded ones are standard normal."""
    low, high, bounded = pool.boxes.low, pool.boxes.high, pool.boxes.bounded

    def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
        rows = []
        for random in noise:
            uniform = random.uniform(np.where(bounded, low, 0), np.where(bounded, high, 1))
            rows.append(np.where(bounded, uniform, random.standard_normal(len(low))))
        return Decision(np.asarray(rows, np.float32), None)

    return act
