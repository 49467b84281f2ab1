"""Who acts in an environment: a policy, or a behaviour that may also ask the expert."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fdtasil.rollouts.environments import EnvironmentPool

__all__ = [
    "Behaviour",
    "Decision",
    "Policy",
    "farthest_apart",
    "follow",
    "follow_answers",
    "has_none",
    "largest_action",
    "random_behaviour",
    "silent_rows",
]

Policy = Callable[[np.ndarray], np.ndarray]
"""(B, n) float32 raw observations -> (B, m) float32 actions in environment units."""


class Decision(NamedTuple):
    """What a behaviour does, and the expert's answer where the behaviour asked for it.

    Attributes:
        action: (B, m) float32, sent to the environment after clipping to its bounds.
        expert_action: (B, m) float32 unclipped expert answer at the same states, or None; a row
            of NaN where it has none.
        silent: (B,) bool, where who acts has no answer, and the last action is held; None for
            nowhere.
    """

    action: np.ndarray
    expert_action: np.ndarray | None
    silent: np.ndarray | None = None


Behaviour = Callable[[np.ndarray, Sequence[np.random.Generator]], Decision]
"""(B, n) observations and B generators, one an episode -> who acts, and how."""


def follow(policy: Policy) -> Behaviour:
    """Return the behaviour that does what `policy` says."""
    return lambda observations, _: Decision(policy(observations), None)


def follow_answers(policy: Policy) -> Behaviour:
    """Return the behaviour that does what `policy` says; rows of NaN are no answer."""

    def act(observations: np.ndarray, _: Sequence[np.random.Generator]) -> Decision:
        answers = policy(observations)
        return Decision(answers, None, silent_rows(answers))

    return act


def silent_rows(answers: np.ndarray) -> np.ndarray | None:
    """Return (B,) bool, the rows of (B, m) answers that are none; None where all are answers."""
    none = has_none(answers)
    return none if none.any() else None


def has_none(answers: np.ndarray) -> np.ndarray:
    """Return (B,) bool, the rows of (B, m) answers that are none."""
    return np.asarray(np.isnan(answers).any(axis=1))


def farthest_apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the largest difference of (B, m) answers, where both are some; else 0."""
    both = ~(has_none(ours) | has_none(theirs))
    return float(np.abs(ours[both] - theirs[both]).max(initial=0.0))


def largest_action(answers: np.ndarray) -> float:
    """Return the size of the largest action among (B, m) answers; 1 where all are zero or none.

    What two answers differ by is small or large beside it, whatever actions are measured in.

    Example:
        >>> largest_action(np.array([[1e-5, -3e-5]])), largest_action(np.zeros((2, 2)))
        (3e-05, 1.0)
    """
    return float(np.abs(answers[~has_none(answers)]).max(initial=0.0)) or 1.0


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
