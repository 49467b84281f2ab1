"""Directions that look at the states: isotropic, or half of them where the states lie apart."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from fdtasil.checks import check_count
from fdtasil.probes.directions import USUAL_COUNT, Draw, RandomSphere

__all__ = ["AdaptiveDirections", "is_redundant"]

_VARIANCE = 0.99
_STATES = 2048  # looked at for excursions: enough for a bank, and 2048 x 2048 distances are quick
_APART = 10  # rows: a state's neighbours in time are not where a student would drift to
_SHORT = 0.01  # of an isotropic direction's length: asks the same query again
_STRETCH = 2.0
_MIXED = 3


@dataclass(frozen=True)
class AdaptiveDirections:
    """`probes` directions for each state, isotropic unless the observations are redundant.

    Where observations are functions of few physical coordinates (Humanoid: 60 of 257 principal
    components hold 99 % of the variance; Ant, Walker2d and HalfCheetah: more than 3 of 4), almost
    no isotropic displacement can ever occur, and the student learns answers to impossible states.
    Half of the directions are then excursions: random combinations of the differences between
    states and the nearest ones of other times, twice as long. Humanoid, 5 episodes: normalised
    return 0.81 with isotropic directions, 0.92 with the mixture.
    """

    probes: int = USUAL_COUNT
    name: ClassVar[str] = "adaptive"
    exact: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "probes", check_count("probes", self.probes))

    def count(self, dimension: int) -> int:
        """As many as asked for."""
        return self.probes

    def reach(self, dimension: int) -> float:
        """All coordinates move."""
        return dimension**0.5

    def around(self, states: np.ndarray) -> Draw:
        """See `Directions.around`."""
        isotropic = RandomSphere(self.probes).around(states)
        if not is_redundant(states):
            return isotropic
        return partial(_mixed, isotropic, _differences(states))


def is_redundant(states: np.ndarray) -> bool:
    """Return whether few of many directions hold 99 % of the variance of (S, d) states.

    Fewer states than coordinates say nothing of directions.
    """
    count, dimension = states.shape
    if count <= dimension:
        return False
    variances = np.linalg.eigvalsh(np.atleast_2d(np.cov(states.T)))
    if not variances.any():  # all of one state
        return False
    held = np.cumsum(variances[::-1]) / variances.sum()
    return int((held < _VARIANCE).sum()) + 1 < dimension / 2


def _differences(states: np.ndarray) -> np.ndarray:
    """Return (S, d) differences between states and the nearest ones of other times."""
    some = np.linspace(0, len(states) - 1, min(len(states), _STATES)).astype(int)
    points = states[some].astype(np.float64)
    squares = (points**2).sum(axis=1)
    distances = squares[:, None] + squares - 2 * points @ points.T
    near_in_time = np.abs(some[:, None] - some) < _APART
    nearest = np.where(near_in_time, np.inf, distances).argmin(axis=1)
    return (points - points[nearest]).astype(np.float32)


def _mixed(
    isotropic: Draw, differences: np.ndarray, rows: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw isotropic directions, and in the place of half of them excursions."""
    bank, numbers = isotropic(rows, random)
    picked = random.integers(len(differences), size=(len(bank), _MIXED))
    factors = random.standard_normal((len(bank), _MIXED), np.float32) * (_STRETCH / _MIXED**0.5)
    excursions = np.zeros_like(bank)
    for factor, row in zip(factors.T, picked.T, strict=True):
        excursions += factor[:, None] * differences[row]
    # At rest nothing moves: what an excursion would waste there stays isotropic.
    moves = np.linalg.norm(excursions, axis=1) > _SHORT
    chosen = (random.random(len(bank)) < 0.5) & moves
    bank[chosen] = excursions[chosen]
    return bank, numbers
