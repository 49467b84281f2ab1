"""Where to probe: every design lowers to a bank of directions and row numbers per state."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Protocol

import numpy as np

from fdtasil.checks import check_count

__all__ = [
    "USUAL_COUNT",
    "Directions",
    "Draw",
    "Jacobian",
    "OrthogonalFrames",
    "RandomSphere",
    "StandardBasis",
]

USUAL_COUNT = 10
"""Probes of a state, where nobody says another number."""

# Rows of a bank: with more states than this, states share directions, which costs no accuracy
# (the states differ) and keeps Humanoid's 100,000 states from storing gigabytes of directions.
_BANK = 4096


Draw = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]
"""Number of states to probe, and what draws -> a bank of directions, and which of them each state
is probed along: (P, d), in units of a step, and (rows, count) row numbers in it."""


class Directions(Protocol):
    """Where to probe, in the coordinates that are live.

    Attributes:
        name: What a derivative source calls the design.
        exact: Whether the expert is differentiated along the directions, and not asked.
    """

    name: ClassVar[str]
    exact: ClassVar[bool]

    def count(self, dimension: int) -> int:
        """Return how many directions each state is probed along."""
        ...

    def reach(self, dimension: int) -> float:
        """Return the length of a step that moves the coordinates it moves by one unit each."""
        ...

    def around(self, states: np.ndarray) -> Draw:
        """Return how directions around states are drawn; what that takes is computed once.

        Args:
            states: (S, d) demonstrated states, in units of a step; most designs only look at d.
        """
        ...


@dataclass(frozen=True)
class StandardBasis:
    """One direction along each coordinate; all of them together are the whole Jacobian."""

    name: ClassVar[str] = "basis"
    exact: ClassVar[bool] = False

    def count(self, dimension: int) -> int:
        """One for each coordinate."""
        return dimension

    def reach(self, dimension: int) -> float:
        """One coordinate moves."""
        return 1.0

    def around(self, states: np.ndarray) -> Draw:
        """See `Directions.around`."""
        return partial(self._draw, states.shape[1])

    def _draw(
        self, dimension: int, rows: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Nothing is random."""
        numbers = np.broadcast_to(np.arange(dimension, dtype=np.int32), (rows, dimension))
        return np.eye(dimension), numbers


@dataclass(frozen=True)
class RandomSphere:
    """`probes` independent directions for each state, uniform on the sphere (TaSIL, appendix)."""

    probes: int = USUAL_COUNT
    name: ClassVar[str] = "sphere"
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
        return partial(self._draw, states.shape[1])

    def _draw(
        self, dimension: int, rows: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        size = min(rows * self.probes, max(_BANK, self.probes))
        bank = random.standard_normal((size, dimension), np.float32)
        bank /= np.linalg.norm(bank, axis=1, keepdims=True)
        # Neighbours in the bank are independent, so a run of them is a fresh sample for a state.
        starts = np.arange(rows) * self.probes
        if size < rows * self.probes:
            starts = random.integers(size, size=rows)
        return bank, _runs(starts, self.probes, size)


@dataclass(frozen=True)
class OrthogonalFrames:
    """`probes` directions for each state, taken from random orthonormal frames.

    Less variance than independent directions, and none when `probes` is the number of
    coordinates; more than that are taken from further frames.

    Attributes:
        probes: Directions for each state, or None for one whole frame.
    """

    probes: int | None = USUAL_COUNT
    name: ClassVar[str] = "orthogonal"
    exact: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.probes is not None:
            object.__setattr__(self, "probes", check_count("probes", self.probes))

    def count(self, dimension: int) -> int:
        """As many as asked for, or one for each coordinate."""
        return dimension if self.probes is None else self.probes

    def reach(self, dimension: int) -> float:
        """All coordinates move."""
        return dimension**0.5

    def around(self, states: np.ndarray) -> Draw:
        """See `Directions.around`."""
        return partial(self._draw, states.shape[1])

    def _draw(
        self, dimension: int, rows: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        count = self.count(dimension)
        frames_each = -(-count // dimension)
        frames = min(rows * frames_each, max(_BANK // dimension, frames_each))
        gaussian = random.standard_normal((frames, dimension, dimension))
        orthogonal, triangular = np.linalg.qr(gaussian)
        # The signs make the frames uniform (Haar); QR alone prefers some.
        signs = np.sign(np.einsum("fii->fi", triangular))
        bank = (orthogonal * signs[:, None, :]).transpose(0, 2, 1).reshape(-1, dimension)
        first = random.integers(frames, size=rows)
        within = random.integers(dimension, size=rows)
        turn = within[:, None] + np.arange(count)
        frame = (first[:, None] + np.arange(count) // dimension) % frames
        return bank, (frame * dimension + turn % dimension).astype(np.int32)


@dataclass(frozen=True)
class Jacobian:
    """Whole orthonormal frames along which a differentiable expert is differentiated."""

    name: ClassVar[str] = "jacobian"
    exact: ClassVar[bool] = True

    def count(self, dimension: int) -> int:
        """One for each coordinate."""
        return dimension

    def reach(self, dimension: int) -> float:
        """All coordinates move."""
        return dimension**0.5

    def around(self, states: np.ndarray) -> Draw:
        """See `Directions.around`."""
        return OrthogonalFrames(None).around(states)


def _runs(starts: np.ndarray, length: int, size: int) -> np.ndarray:
    return ((starts[:, None] + np.arange(length)) % size).astype(np.int32)
