"""Who acts in an environment: a policy, or a behaviour that may also ask the expert."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

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
