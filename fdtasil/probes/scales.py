"""How far each coordinate of the observations moves: what is divided by, what is probed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fdtasil.errors import SettingError

__all__ = [
    "ROUNDING",
    "Scales",
    "action_units",
    "all_but",
    "least_steps",
    "measure_actions",
    "measure_following",
    "measure_scales",
]

# A coordinate whose deviation is below this share of the median one does not move: what is left
# is rounding (Humanoid has one of 1.8e-14), and dividing by it would blow up the first bump.
# Units may lie far apart: metres of altitude beside radians of an angle.
_STILL = 1e-10
ROUNDING = 64 * float(np.finfo(np.float32).eps)
"""Share of its values below which a coordinate's movement is rounding."""


@dataclass(frozen=True)
class Scales:
    """Scales of the observations.

    Attributes:
        mean: (n,) of the states.
        scale: (n,) what the student's normaliser divides by; 1 for coordinates that do not move.
        deviation: (n,) standard deviation of the states.
        live: (n,) bool, whether the coordinate moves; others are not probed in whitened space.
        seen: (n,) bool, whether the student sees the coordinate; others are never probed.
        told: (n,) bool, whether somebody said how far the coordinate will go; it is moved alone
            too.
        following: (n, n) how far each column goes, of coordinates that the student does not see,
            with a move of one along each row, of those that it sees; None where none follow.
    """

    mean: np.ndarray
    scale: np.ndarray
    deviation: np.ndarray
    live: np.ndarray
    seen: np.ndarray
    told: np.ndarray
    following: np.ndarray | None = None

    @property
    def followers(self) -> tuple[int, ...]:
        """Those coordinates that follow others."""
        led = self.following
        return () if led is None else tuple(np.flatnonzero(led.any(axis=0)).tolist())

    def with_following(self, moves: np.ndarray) -> np.ndarray:
        """Return (P, n) moves of the coordinates that are probed, with what follows them."""
        if self.following is None:
            return moves
        return moves + (moves @ self.following).astype(moves.dtype)

    @property
    def units(self) -> np.ndarray:
        """(n,) the deviation of each coordinate; 1 for those that do not move."""
        return np.where(self.live, self.deviation, 1.0)

    def units_beside(self, rows: np.ndarray) -> np.ndarray:
        """Return `units`, none of them so small that float32 rounds it away beside (N, n) rows."""
        return np.maximum(self.units, least_steps(rows))

    def spread_by(self, deviations: Mapping[int, float]) -> "Scales":
        """Return the scales with coordinates that are said to go farther than was seen."""
        if not deviations:
            return self
        columns, values = list(deviations), list(deviations.values())
        deviation, scale = self.deviation.copy(), self.scale.copy()
        live, told = self.live.copy(), self.told.copy()
        # Less than what was seen is a mistake, and would blow up what the student is shown.
        seen = np.where(live, deviation, 0.0)[columns]
        deviation[columns] = scale[columns] = np.maximum(values, seen)
        live[columns] = told[columns] = True
        return Scales(self.mean, scale, deviation, live, self.seen, told, self.following)

    def probed(self, space: str | None) -> np.ndarray:
        """Return (n,) bool, the coordinates that are probed in a space.

        Raises:
            SettingError: If there is none.
        """
        chosen = self.seen if space == "raw" else self.seen & self.live
        if not chosen.any():
            raise SettingError(
                "the student sees no coordinate that can be probed",
                "one that moves, and is no choice and no whole number",
                "check student_obs, subtract an offset beside which float32 rounds movement away, "
                "or pass probes=0",
            )
        return chosen


def measure_scales(observations: np.ndarray, seen: np.ndarray | None = None) -> Scales:
    """Measure the scale of each coordinate.

    Args:
        observations: (N, n) raw observations.
        seen: (n,) bool, the coordinates that the student sees; None for all.
    """
    wide = observations.astype(np.float64)
    mean, deviation = wide.mean(axis=0), wide.std(axis=0)
    moving = deviation > least_steps(wide)
    if not moving.any():  # a single state tells nothing of scales: raw units
        moving, deviation = np.ones_like(moving), np.ones_like(deviation)
    live = moving & (deviation > _STILL * np.median(deviation[moving]))
    scale = np.where(live, deviation, 1.0)
    visible = np.ones_like(live) if seen is None else seen
    return Scales(mean, scale, deviation, live, visible, np.zeros_like(live))


def measure_following(
    observations: np.ndarray, scales: Scales, hidden: np.ndarray
) -> np.ndarray | None:
    """Find the hidden coordinates that others lead along, such as a goal's copy of a position.

    Where a student does not see a number that follows from those that it sees, a move of these
    alone leads to observations that can't be: its expert would say how it reacts to a
    contradiction.

    Args:
        observations: (N, n) states.
        scales: Of them, with what the student sees.
        hidden: (n,) bool, which may follow.

    Returns:
        As in `Scales.following`: linear, of those that the states leave less than a hundredth of
        their deviation of; None where there are none, or the states are too few to say.
    """
    of, to = np.flatnonzero(scales.seen & scales.live), np.flatnonzero(hidden & scales.live)
    if not len(to) or not len(of) or len(observations) < _STATES_EACH * len(of):
        return None
    rows = (observations.astype(np.float64) - scales.mean) / scales.units
    led, *_ = np.linalg.lstsq(rows[:, of], rows[:, to], rcond=_CONDITION)
    left = (rows[:, to] - rows[:, of] @ led).std(axis=0)
    lengths = np.linalg.norm(led, axis=0)
    follow = (left < _LEFT) & (lengths > 0) & (lengths < _FARTHEST)
    if not follow.any():
        return None
    found = np.zeros((len(hidden), len(hidden)))
    found[np.ix_(of, to[follow])] = led[:, follow] / scales.units[of][:, None]
    return found * scales.units


_STATES_EACH = 4  # for each coordinate that is looked at: of fewer, anything follows by chance
_LEFT, _FARTHEST, _CONDITION = 0.01, 2.0, 1e-6  # in deviations


def all_but(held: Iterable[int], n: int) -> np.ndarray:
    """Return (n,) bool, the coordinates that are not among those held."""
    return ~np.isin(np.arange(n), list(held))


def least_steps(rows: np.ndarray) -> np.ndarray:
    """Return (n,) the steps from (N, n) observations below which float32 rounds them away."""
    return ROUNDING * np.abs(rows).max(axis=0)


def measure_actions(actions: np.ndarray, choices: Iterable[tuple[int, int]] = ()) -> Scales:
    """Measure how far each action goes.

    Args:
        actions: (N, m) of the expert.
        choices: First score of each choice, and the one after its last: all scores of a choice
            have one scale, around zero.
    """
    own = measure_scales(actions)
    mean, scale = own.mean.copy(), own.scale.copy()
    for start, end in choices:
        size = float(np.sqrt(np.square(actions[:, start:end], dtype=np.float64).mean()))
        mean[start:end], scale[start:end] = 0.0, size or 1.0
    return replace(own, mean=mean, scale=scale)


def action_units(
    low: np.ndarray,
    high: np.ndarray,
    actions: np.ndarray,
    choices: Iterable[tuple[int, int]] = (),
) -> np.ndarray:
    """Return what each action is measured in, (m,): half of its range, or its own scale.

    Args:
        low: (m,) lower bounds.
        high: (m,) upper ones; where one of both is infinite, the scale counts.
        actions: (N, m) of the expert, as in `measure_actions`.
        choices: As there.
    """
    with np.errstate(invalid="ignore"):  # of infinite bounds, which are not chosen
        half = (high.astype(np.float64) - low) / 2
    scale = measure_actions(actions, choices).scale
    return np.where(np.isfinite(half) & (half > 0), half, scale)
