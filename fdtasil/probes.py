"""Where to probe the expert, how to difference it, and when to ask again.

Every design lowers to the same small thing: a bank of displacements and, for each state, the
numbers of the rows of the bank that it is probed along. Nothing else knows which design it was.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from fdtasil.errors import SettingError

__all__ = [
    "CENTRAL",
    "DIRECTIONS",
    "EXACT",
    "FORWARD",
    "STENCILS",
    "Directions",
    "OrthogonalFrames",
    "Probes",
    "RandomSphere",
    "StandardBasis",
    "Stencil",
]

# Rows of a bank: with more states than this, states share directions, which costs no accuracy
# (the states differ) and keeps Humanoid's 100,000 states from storing gigabytes of directions.
_BANK = 4096


class Directions(Protocol):
    """Where to probe: unit vectors of the live coordinates."""

    def count(self, dimension: int) -> int:
        """Return how many directions each state is probed along."""
        ...

    def reach(self, dimension: int) -> float:
        """Return the length of a step that moves the coordinates it moves by one unit each."""
        ...

    def draw(
        self, rows: int, dimension: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a bank (P, dimension) of unit rows and their numbers (rows, count) per state."""
        ...


@dataclass(frozen=True)
class StandardBasis:
    """One direction along each coordinate; all of them together are the whole Jacobian."""

    def count(self, dimension: int) -> int:
        """One for each coordinate."""
        return dimension

    def reach(self, dimension: int) -> float:
        """One coordinate moves."""
        return 1.0

    def draw(
        self, rows: int, dimension: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Directions.draw`; nothing is random."""
        numbers = np.broadcast_to(np.arange(dimension, dtype=np.int32), (rows, dimension))
        return np.eye(dimension), numbers


@dataclass(frozen=True)
class RandomSphere:
    """`probes` independent directions for each state, uniform on the sphere (TaSIL, appendix)."""

    probes: int

    def count(self, dimension: int) -> int:
        """As many as asked for."""
        return self.probes

    def reach(self, dimension: int) -> float:
        """All coordinates move."""
        return dimension**0.5

    def draw(
        self, rows: int, dimension: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Directions.draw`."""
        size = min(rows * self.probes, max(_BANK, self.probes))
        normal = random.standard_normal((size, dimension))
        bank = normal / np.linalg.norm(normal, axis=1, keepdims=True)
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

    probes: int | None = None

    def count(self, dimension: int) -> int:
        """As many as asked for, or one for each coordinate."""
        return dimension if self.probes is None else self.probes

    def reach(self, dimension: int) -> float:
        """All coordinates move."""
        return dimension**0.5

    def draw(
        self, rows: int, dimension: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Directions.draw`."""
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


DIRECTIONS: dict[str, Callable[[int | None], Directions]] = {
    "basis": lambda count: StandardBasis(),
    "sphere": lambda count: RandomSphere(10 if count is None else count),
    "orthogonal": lambda count: OrthogonalFrames(10 if count is None else count),
    "jacobian": lambda count: OrthogonalFrames(),
}


@dataclass(frozen=True)
class Stencil:
    """How to difference along one direction: values at offsets, and their weights.

    Attributes:
        name: What to call it.
        offsets: Multiples of the step at which the function is asked, the centre apart.
        weights: Weight of the value at each offset in the first difference.
        centre: Weight of the value at the centre, which is known already.
        second: Weights of the values, and last that of the centre, in the second difference;
            None where the stencil has none.
        exact: Whether the derivative is analytic, and no value is asked at all.
    """

    name: str
    offsets: tuple[float, ...]
    weights: tuple[float, ...]
    centre: float
    second: tuple[float, ...] | None = None
    exact: bool = False


FORWARD = Stencil("forward", (1.0,), (1.0,), -1.0)
CENTRAL = Stencil("central", (1.0, -1.0), (0.5, -0.5), 0.0, (1.0, 1.0, -2.0))
EXACT = Stencil("exact", (), (), 0.0, exact=True)
STENCILS = {stencil.name: stencil for stencil in (FORWARD, CENTRAL, EXACT)}


@dataclass(frozen=True)
class Probes:
    """A derivative source: where to probe, how to difference, how far, and when to ask again.

    Attributes:
        directions: Where.
        stencil: How: `FORWARD`, `CENTRAL`, or `EXACT` (a differentiable expert only). None is
            forward for first order and central for second.
        radius: How far. Whitened space: standard deviations moved by each coordinate that moves
            (root mean square). Raw space: Euclidean length of the displacement.
            None leaves it to the preset.
        space: "whitened" scales each coordinate by its standard deviation over the
            demonstrations and freezes those that do not move; "raw" takes observations as they
            are. None leaves it to the preset.
        resample: Whether new directions are drawn and the expert is asked again each time that
            the stored answers have been used once.
        per_step: How many of a state's probes one visit of the state uses, or "all" (the cost of
            a training step then grows with their number). None leaves it to the preset.

    Example:
        >>> Probes.parse("sphere:5,resample") == Probes(RandomSphere(5), resample=True)
        True
        >>> Probes.parse(10).queries(states=300, dimension=17, visits=100)
        3000
    """

    directions: Directions
    stencil: Stencil | None = None
    radius: float | None = None
    space: Literal["whitened", "raw"] | None = None
    resample: bool = False
    per_step: int | Literal["all"] | None = None

    def __post_init__(self) -> None:
        if self.radius is not None and not 0 < self.radius < float("inf"):
            raise SettingError(
                f"radius={self.radius!r}", "a positive number", "write for example radius=0.15"
            )
        if self.space not in (None, "whitened", "raw"):
            raise SettingError(f"space={self.space!r}", '"whitened" or "raw"', "choose one")
        if (
            getattr(self.directions, "probes", 1) is not None
            and not getattr(self.directions, "probes", 1) > 0
        ):
            raise SettingError(f"{self.directions}", "a positive number of probes", _EXAMPLES)
        if (self.stencil is EXACT) and self.directions != OrthogonalFrames():
            raise SettingError(
                f"the exact stencil with {self.directions}",
                "whole frames, which hold the Jacobian",
                'write probes="jacobian"',
            )
        if self.per_step not in (None, "all"):
            if not isinstance(self.per_step, int) or self.per_step < 1:
                raise SettingError(
                    f"per_step={self.per_step!r}",
                    'a positive integer or "all"',
                    "write per_step=1",
                )

    @staticmethod
    def parse(spec: "int | str | Probes | None") -> "Probes | None":
        """Read a derivative source as it is written in a call or a shell.

        Args:
            spec: 0 or "none" (plain behaviour cloning), N (N directions on the random sphere),
                or a text `design[:count][,option...]`: designs basis, sphere, orthogonal,
                jacobian; options forward, central, resample, whitened, raw, radius=R,
                per_step=K. A `Probes` is returned as it is.

        Returns:
            The source, or None for plain behaviour cloning.

        Raises:
            SettingError: If it can't be read.
        """
        if spec is None or isinstance(spec, Probes):
            return spec
        if isinstance(spec, str):
            if spec.isdigit():
                return Probes.parse(int(spec))
            return None if spec == "none" else _parse_text(spec)
        if isinstance(spec, bool) or not isinstance(spec, (int, np.integer)) or spec < 0:
            raise SettingError(f"probes={spec!r}", _GRAMMAR, _EXAMPLES)
        return Probes(RandomSphere(int(spec))) if spec else None

    def describe(self) -> str:
        """Return the text that `parse` reads back, with the radius where it is set."""
        design = next(
            name
            for name in DIRECTIONS
            if isinstance(self.directions, type(DIRECTIONS[name](1)))
            and (name == "jacobian") == (self.stencil is EXACT)
        )
        count = getattr(self.directions, "probes", None)
        if design == "orthogonal" and count is None:
            count = "all"
        parts = [design if count is None else f"{design}:{count}"]
        parts += [self.stencil.name] if self.stencil not in (None, EXACT) else []
        parts += ["resample"] if self.resample else []
        parts += [self.space] if self.space else []
        parts += [f"radius={self.radius:g}"] if self.radius is not None else []
        parts += [f"per_step={self.per_step}"] if self.per_step is not None else []
        return ",".join(parts)

    def with_order(self, order: int) -> "Probes":
        """Return the source with a stencil that has differences up to `order`.

        Raises:
            SettingError: If the stencil that was asked for has none of second order.
        """
        stencil = self.stencil or (CENTRAL if order == 2 else FORWARD)
        if order == 2 and not stencil.exact and stencil.second is None:
            raise SettingError(
                f"order=2 with the {stencil.name} stencil",
                "a stencil with second differences",
                'write probes="sphere:10,central"',
            )
        return replace(self, stencil=stencil)

    def queries(self, states: int, dimension: int, visits: int) -> int:
        """Return the rows that the expert is asked for.

        Args:
            states: Number of labelled states.
            dimension: Number of coordinates that are probed.
            visits: How often training visits each state.
        """
        count = self.directions.count(dimension)
        pools = self.pools(dimension, visits)
        return pools * states * count * len((self.stencil or FORWARD).offsets)

    def pools(self, dimension: int, visits: int) -> int:
        """Return how often the expert is asked for a new set of answers; see `queries`."""
        count = self.directions.count(dimension)
        last = (visits - 1) * self.used_per_visit(count) // count
        return last + 1 if self.resample else 1

    def used_per_visit(self, count: int) -> int:
        """Return how many of a state's `count` probes one visit uses."""
        return count if self.per_step == "all" else min(self.per_step or 1, count)


_GRAMMAR = 'a number of probes, or a text like "sphere:10,resample", "basis,central", "jacobian"'
_EXAMPLES = "write for example probes=10, or probes=0 for plain behaviour cloning"


def _parse_text(spec: str) -> Probes:
    design, *options = (part.strip() for part in spec.split(","))
    match = re.fullmatch(r"([a-z]+)(?::(\d+|all))?", design)
    if not match or match[1] not in DIRECTIONS or match[2] == "0":
        raise SettingError(f"probes={spec!r}", _GRAMMAR, f"designs: {', '.join(DIRECTIONS)}")
    if match[2] and match[1] in ("basis", "jacobian"):
        raise SettingError(
            f"probes={spec!r}: {match[1]} takes no count", _GRAMMAR, f'write "{match[1]}"'
        )
    if match[2] == "all":
        if match[1] != "orthogonal":
            raise SettingError(f"probes={spec!r}", _GRAMMAR, 'write "basis" or "orthogonal:all"')
        directions = OrthogonalFrames()
    else:
        directions = DIRECTIONS[match[1]](int(match[2]) if match[2] else None)
    probes = Probes(directions, EXACT if match[1] == "jacobian" else None)
    for option in options:
        if match[1] == "jacobian" and option in STENCILS:
            raise SettingError(
                f"probes={spec!r}", "no stencil: the derivative is exact", _EXAMPLES
            )
        probes = replace(probes, **_parse_option(option, spec))
    return probes


def _parse_option(option: str, spec: str) -> dict[str, object]:
    key, _, value = option.partition("=")
    flags: dict[str, dict[str, object]] = {
        "forward": {"stencil": FORWARD},
        "central": {"stencil": CENTRAL},
        "resample": {"resample": True},
        "whitened": {"space": "whitened"},
        "raw": {"space": "raw"},
    }
    numbers: dict[str, Callable[[str], object]] = {
        "radius": float,
        "per_step": lambda text: text if text == "all" else int(text),
    }
    if not value and key in flags:
        return flags[key]
    try:
        return {key: numbers[key](value)}
    except (KeyError, ValueError):
        known = ", ".join([*flags, *(f"{name}=..." for name in numbers)])
        raise SettingError(
            f"probes={spec!r}: unknown option {option!r}", f"one of {known}", _EXAMPLES
        ) from None


def _runs(starts: np.ndarray, length: int, size: int) -> np.ndarray:
    return ((starts[:, None] + np.arange(length)) % size).astype(np.int32)
