"""Other episodes in the place of those that the environment ended."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fdtasil.errors import warn
from fdtasil.rollouts.episodes import Episodes

__all__ = ["ATTEMPTS", "KEEPS", "SURVIVORS", "survivors"]

SURVIVORS = "survivors"
KEEPS = ("all", SURVIVORS)
"""Which demonstrations are kept."""
ATTEMPTS = 3
"""Episodes at most that are recorded in the place of one."""


def survivors(
    episodes: Episodes, record: Callable[[int, Sequence[int]], Episodes], name: str
) -> tuple[Episodes, int]:
    """Record other episodes in the place of those that the environment ended.

    Args:
        episodes: What was recorded.
        record: Number of the first further episode, and in the place of which -> those episodes.
        name: Of the environment.

    Returns:
        As many episodes, and how many others were recorded.
    """
    recorded = 0
    for _ in range(ATTEMPTS):
        fallen = np.flatnonzero(episodes.terminated | episodes.given_up)
        if len(fallen):
            episodes = _replaced(episodes, fallen, record(recorded, fallen.tolist()))
            recorded += len(fallen)
    left = int(episodes.terminated.sum())
    if left:
        warn(
            f"{name}: {left} of {len(episodes.terminated)} demonstrations ended early, after "
            f"{ATTEMPTS} others were recorded in their place; they are kept"
        )
    return episodes, recorded


def _replaced(episodes: Episodes, rows: np.ndarray, others: Episodes) -> Episodes:
    """Return the episodes with others in some rows; clipped actions of all are counted."""
    arrays = {}
    for name, value in vars(episodes).items():
        if isinstance(value, np.ndarray):
            arrays[name] = value.copy()
            arrays[name][rows] = getattr(others, name)
    clipped = episodes.clipped_actions + others.clipped_actions
    return replace(episodes, **arrays, clipped_actions=clipped)
