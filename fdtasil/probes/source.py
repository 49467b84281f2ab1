"""A derivative source: directions, stencil, distance, and when to ask again."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.probes.adaptive import AdaptiveDirections
from fdtasil.probes.directions import Directions, OrthogonalFrames, RandomSphere, StandardBasis
from fdtasil.probes.stencils import CENTRAL, EXACT, FORWARD, LABELS, STENCILS, Stencil

__all__ = ["DIRECTIONS", "USUAL_COUNT", "Probes"]

USUAL_COUNT = 10
"""Probes of a state, where nobody says another number."""

DIRECTIONS: dict[str, Callable[[int | None], Directions]] = {
    "adaptive": lambda count: AdaptiveDirections(USUAL_COUNT if count is None else count),
    "basis": lambda count: StandardBasis(),
    "sphere": lambda count: RandomSphere(USUAL_COUNT if count is None else count),
    "orthogonal": lambda count: OrthogonalFrames(USUAL_COUNT if count is None else count),
    "jacobian": lambda count: OrthogonalFrames(),
}
"""Every design by the name it is written with; the count may be left open."""


@dataclass(frozen=True)
class Probes:
    """A derivative source: where to probe, how to difference, how far, and when to ask again.

    Attributes:
        directions: Where.
        stencil: How: `FORWARD`, `CENTRAL`, `LABELS` (no difference: augmentation, the rival that
            benchmarks compare with), or `EXACT` (a differentiable expert only). None
            leaves it to the calibration, or is forward for first order and central for second.
        radius: How far. Whitened space: standard deviations moved by each coordinate that moves
            (root mean square). Raw space: Euclidean length of the displacement.
            None leaves it to the calibration, or to the preset.
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
        >>> Probes.parse("sphere:10,forward").queries(states=300, dimension=17, visits=100)
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
            spec: 0 or "none" (plain behaviour cloning), N (N adaptive directions), or a text
                `design[:count][,option...]`: designs adaptive, basis, sphere, orthogonal,
                jacobian; options forward, central, labels, resample, whitened, raw, radius=R,
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
        return Probes(AdaptiveDirections(int(spec))) if spec else None

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
        parts += [f"radius={_shortest(self.radius)}"] if self.radius is not None else []
        parts += [f"per_step={self.per_step}"] if self.per_step is not None else []
        return ",".join(parts)

    @property
    def exact(self) -> bool:
        """Whether the expert is differentiated, and not asked."""
        return self.stencil is EXACT

    def with_order(self, order: int, usual: Stencil | None = FORWARD) -> "Probes":
        """Return the source with a stencil that has differences up to `order`.

        Args:
            order: 1 or 2.
            usual: The stencil of first order where none is set; None leaves it open.

        Raises:
            SettingError: If the stencil that was asked for has none of second order.
        """
        stencil = self.stencil or (CENTRAL if order == 2 else usual)
        if order == 2 and stencil and not stencil.exact and stencil.second is None:
            raise SettingError(
                f"order=2 with the {stencil.name} stencil",
                "a stencil with second differences",
                'write probes="sphere:10,central"',
            )
        return replace(self, stencil=stencil)

    def queries(self, states: int, dimension: int, visits: int) -> int:
        """Return the rows that the expert is asked for, at most where the stencil is open.

        Args:
            states: Number of labelled states.
            dimension: Number of coordinates that are probed.
            visits: How often training visits each state.
        """
        count = self.directions.count(dimension)
        pools = self.pools(dimension, visits)
        return pools * states * count * len((self.stencil or CENTRAL).offsets)

    def pools(self, dimension: int, visits: int) -> int:
        """Return how often the expert is asked for a new set of answers; see `queries`."""
        count = self.directions.count(dimension)
        last = (visits - 1) * self.used_per_visit(count) // count
        return last + 1 if self.resample else 1

    def used_per_visit(self, count: int) -> int:
        """Return how many of a state's `count` probes one visit uses."""
        return count if self.per_step == "all" else min(self.per_step or 1, count)


def _shortest(number: float) -> str:
    """Return the shortest text that reads back as the same number."""
    text = f"{number:g}"
    return text if float(text) == number else repr(float(number))


_GRAMMAR = 'a number of probes, or a text like "sphere:10,resample", "basis,central", "jacobian"'
_EXAMPLES = "write for example probes=10, or probes=0 for plain behaviour cloning"


def _parse_text(spec: str) -> Probes:
    design, *options = (part.strip() for part in spec.split(","))
    match = re.fullmatch(r"([a-z]+)(?::(\d+|all))?", design)
    if not match or match[1] not in DIRECTIONS or match[2] == "0":
        number = re.fullmatch(r"[-+.\d]+", design) is not None
        advice = _EXAMPLES if number else f"designs: {', '.join(DIRECTIONS)}"
        raise SettingError(f"probes={spec!r}", _GRAMMAR, advice)
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
        "labels": {"stencil": LABELS},
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
