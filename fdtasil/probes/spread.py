"""Coordinates that stand still in the demonstrations, and will not on the machine."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.checks import check_count, check_number, spelt
from fdtasil.errors import SettingError
from fdtasil.probes.scales import least_steps
from fdtasil.rollouts.naming import columns_named
from fdtasil.rollouts.spaces import Layout

__all__ = ["Spread", "SpreadLike", "stands_still"]

SpreadLike = Mapping[int, float] | Mapping[str, float] | Mapping[int | str, float] | str
"""Coordinate, or name of a part -> the deviation that it is probed by, as a text "3:0.5,goal:0.1"
too; or "bounds", the deviations of uniform values in the bounds of the observations."""

_STILL = 1e-3  # of what a coordinate varies between episodes, that it may vary within one
_EXPECTED = 'a deviation for each coordinate, or "bounds"'
_EXAMPLE = "write for example spread={0: 0.5}, in a shell --spread 0:0.5"


@dataclass(frozen=True)
class Spread:
    """How far coordinates will go that hardly move in the demonstrations.

    Attributes:
        deviations: By coordinate, in units of the observations.
        where_still: Whether it holds only for coordinates that are constant within episodes.
    """

    deviations: Mapping[int, float]
    where_still: bool = False

    @classmethod
    def of(
        cls,
        given: SpreadLike | None,
        low: np.ndarray | None,
        high: np.ndarray | None,
        n: int,
        layout: Layout | None = None,
    ) -> "Spread":
        """Read the argument `spread`.

        Args:
            given: Deviations by coordinate, "bounds", or None for none.
            low: (n,) bounds of the observations, or None where there is no environment.
            high: (n,) upper bounds.
            n: Length of an observation.
            layout: What its parts are called.

        Raises:
            SettingError: If it can't be used.
        """
        if given is None:
            return cls({})
        if isinstance(given, str) and given != "bounds":
            given = _read(given)
        if isinstance(given, Mapping):
            checked = sorted(
                _checked(column, value, n)
                for key, value in given.items()
                for column in _columns(key, value, layout)
            )
            if len(dict(checked)) < len(checked):
                raise SettingError(
                    f"{spelt('spread', given)} of a coordinate twice", _EXPECTED, _EXAMPLE
                )
            return cls(dict(checked))
        if not isinstance(given, str):
            raise SettingError(spelt("spread", given), _EXPECTED, _EXAMPLE)
        if (
            low is None
            or high is None
            or not (bounded := np.isfinite(low) & np.isfinite(high) & (low < high)).any()
        ):
            raise SettingError(
                "spread='bounds' of observations without bounds", "finite ones", _EXAMPLE
            )
        # Of values that are uniform between the bounds.
        deviations = {int(i): float(high[i] - low[i]) / 12**0.5 for i in np.flatnonzero(bounded)}
        return cls(deviations, where_still=True)

    def among(self, observations: np.ndarray, episode: np.ndarray) -> dict[int, float]:
        """Return the deviations that hold for (N, n) states of (N,) episodes."""
        if not self.where_still:
            return dict(self.deviations)
        within = _widest_within(observations, episode)
        return {i: d for i, d in self.deviations.items() if within[i] <= _STILL * d}

    def to_json(self) -> dict[str, Any] | None:
        """Return the deviations by coordinate as plain JSON values, or None without any."""
        plain = {str(i): d for i, d in self.deviations.items()}
        return ({"bounds": plain} if self.where_still else plain) or None

    @classmethod
    def from_json(cls, written: Any, n: int) -> "Spread":
        """Read what `to_json` returned, of observations of length n.

        Raises:
            ValueError: If it is something else.
        """
        where_still = isinstance(written, dict) and "bounds" in written
        plain = written["bounds"] if where_still else written
        if not isinstance(plain, dict | None):
            raise ValueError(f"the deviations {written!r}")
        try:
            read = dict(_checked(int(i), d, n) for i, d in (plain or {}).items())
        except SettingError as error:
            raise ValueError(error.found) from None
        return cls(read, where_still)


def _checked(coordinate: object, deviation: object, n: int) -> tuple[int, float]:
    try:
        return (
            check_count("coordinate", coordinate, 0, n - 1),
            check_number("deviation", deviation, positive=True),
        )
    except SettingError as error:
        raise SettingError(f"spread: {error.found}", error.expected, _EXAMPLE) from None


def _columns(key: object, value: object, layout: Layout | None) -> tuple[object, ...]:
    if not isinstance(key, str):
        return (key,)
    return columns_named(key, layout, spelt("spread", {key: value}), _EXAMPLE)


def _coordinate(text: str) -> int | str:
    """Return a number, or the name of a part, in quotation marks or without."""
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        text = text[1:-1]
    if not text:
        raise ValueError("a deviation of nothing")
    try:
        return int(text)
    except ValueError:
        return text


def _read(text: str) -> dict[int | str, float]:
    """Read "3:0.5,goal:0.1", in the braces of Python too, as a warning writes them."""
    inside = text.strip()
    if inside.startswith("{") and inside.endswith("}"):
        inside = inside[1:-1]
    try:
        pairs = [part.rpartition(":")[::2] for part in inside.split(",")]
        read = {_coordinate(one.strip()): float(deviation) for one, deviation in pairs}
        if len(read) < len(pairs):
            raise ValueError("a coordinate twice")
        return read
    except ValueError:
        raise SettingError(spelt("spread", text), _EXPECTED, _EXAMPLE) from None


def stands_still(observations: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Return (n,) bool, the coordinates that are constant within episodes and differ between them.

    Args:
        observations: (N, n) states.
        episode: (N,) their episodes; those of a single state say nothing.
    """
    _, own, lengths = np.unique(episode, return_inverse=True, return_counts=True)
    longer = lengths[own] > 1
    observations, episode = observations[longer], episode[longer]
    if not len(episode):
        return np.zeros(observations.shape[1], bool)
    numbers = np.unique(episode)
    means = np.stack([observations[episode == e].mean(axis=0, dtype=np.float64) for e in numbers])
    between = means.std(axis=0)
    differs = between > least_steps(means)
    return differs & (_widest_within(observations, episode) <= _STILL * between)


def _widest_within(observations: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Return (n,) the largest range of each coordinate within an episode."""
    ranges = [np.ptp(observations[episode == e], axis=0) for e in np.unique(episode)]
    return np.max(ranges, axis=0)
