"""A derivative source: directions, stencil, distance, and when to ask again."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from fdtasil.checks import check_choice, check_count, check_flag, check_number, spelt
from fdtasil.errors import SettingError
from fdtasil.probes.adaptive import AdaptiveDirections
from fdtasil.probes.directions import (
    Directions,
    Jacobian,
    OrthogonalFrames,
    RandomSphere,
    StandardBasis,
)
from fdtasil.probes.stencils import CENTRAL, EXACT, FORWARD, LABELS, Stencil

__all__ = ["DIRECTIONS", "Probes"]

DIRECTIONS: dict[str, Any] = {
    design.name: design
    for design in (AdaptiveDirections, StandardBasis, RandomSphere, OrthogonalFrames, Jacobian)
}
"""Every design by the name it is written with."""


@dataclass(frozen=True)
class Probes:
    """A derivative source: where to probe, how to difference, how far, and when to ask again.

    Attributes:
        directions: Where.
        stencil: How: `FORWARD`, `CENTRAL`, `LABELS` (no difference: augmentation, the
            baseline that benchmarks compare with), or `EXACT` (a differentiable expert only). None
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
        if self.radius is not None:
            number = check_number("radius", self.radius, positive=True)
            object.__setattr__(self, "radius", number)
        if self.space is not None:
            check_choice("space", self.space, ("whitened", "raw"))
        object.__setattr__(self, "resample", check_flag("resample", self.resample))
        if not isinstance(self.directions, tuple(DIRECTIONS.values())) or not isinstance(
            self.stencil, Stencil | None
        ):
            found = f"{spelt('directions', self.directions)}, {spelt('stencil', self.stencil)}"
            example = 'write for example fdtasil.Probes.parse("sphere:10,forward")'
            raise SettingError(found, "a design, and a stencil or None", example)
        if self.directions.exact and self.stencil is None:
            object.__setattr__(self, "stencil", EXACT)
        if self.exact != self.directions.exact:
            name = self.stencil.name if self.stencil else "open"
            raise SettingError(
                f"the {name} stencil with {self.directions.name} directions",
                "a finite stencil with asked directions, and none with differentiated ones",
                'write probes="jacobian" for the exact derivative',
            )
        if self.per_step is not None and not _is_all(self.per_step):
            object.__setattr__(self, "per_step", check_count("per_step", self.per_step))

    @staticmethod
    def parse(spec: "int | str | Probes | None") -> "Probes | None":
        """Read a derivative source as it is written in a call or a shell.

        Args:
            spec: 0 or "none" (plain behaviour cloning), N (N adaptive directions), or a text
                `design[:count][,option...]`: designs adaptive (a mere number is one), basis,
                sphere, orthogonal, jacobian; options forward, central, labels, resample,
                whitened, raw, radius=R, per_step=K. A `Probes` is returned as it is.

        Returns:
            The source, or None for plain behaviour cloning.

        Raises:
            SettingError: If it can't be read.
        """
        if spec is None or isinstance(spec, Probes):
            return spec
        if isinstance(spec, str):
            if spec.isascii() and spec.isdigit():
                return Probes.parse(int(spec))
            return None if spec == "none" else _parse_text(spec)
        try:
            count = check_count("probes", spec, least=0)
        except SettingError:
            raise SettingError(spelt("probes", spec), _GRAMMAR, _EXAMPLES) from None
        return Probes(AdaptiveDirections(count)) if count else None

    def describe(self) -> str:
        """Return the text that `parse` reads back, with the radius where it is set."""
        parts = [_describe(self.directions)]
        parts += [self.stencil.name] if self.stencil not in (None, EXACT) else []
        parts += ["resample"] if self.resample else []
        parts += [self.space] if self.space else []
        parts += [f"radius={_shortest(self.radius)}"] if self.radius is not None else []
        parts += [f"per_step={self.per_step}"] if self.per_step is not None else []
        return ",".join(parts)

    @property
    def exact(self) -> bool:
        """Whether the expert is differentiated, and not asked."""
        return self.stencil is not None and self.stencil.exact

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
        samples = self.samples(dimension, visits)
        return samples * states * count * len((self.stencil or CENTRAL).offsets)

    def samples(self, dimension: int, visits: int) -> int:
        """Return how often directions are drawn and the expert is asked; see `queries`."""
        count = self.directions.count(dimension)
        last = (visits - 1) * self.used_per_visit(count) // count
        return last + 1 if self.resample else 1

    def used_per_visit(self, count: int) -> int:
        """Return how many of a state's `count` probes one visit uses."""
        return count if self.per_step == "all" else min(self.per_step or 1, count)


def _is_all(value: object) -> bool:
    return isinstance(value, str) and value == "all"


def _shortest(number: float) -> str:
    """Return the shortest text that reads back as the same number."""
    text = f"{number:g}"
    return text if float(text) == number else repr(float(number))


_GRAMMAR = 'a number of probes, or a text like "sphere:10,resample", "basis,central", "jacobian"'
_EXAMPLES = "write for example probes=10, or probes=0 for plain behaviour cloning"
_FLAGS: dict[str, tuple[str, object]] = {
    **{stencil.name: ("stencil", stencil) for stencil in (FORWARD, CENTRAL, LABELS)},
    "resample": ("resample", True),
    "whitened": ("space", "whitened"),
    "raw": ("space", "raw"),
}
_NUMBERS: dict[str, Callable[[str], object]] = {
    "radius": float,
    "per_step": lambda text: text if text == "all" else int(text),
}


def _describe(directions: Directions) -> str:
    count = getattr(directions, "probes", "")
    return f"{directions.name}:{'all' if count is None else count}".rstrip(":")


def _parse_text(spec: str) -> Probes:
    design, *options = (part.strip() for part in spec.split(","))
    name, colon, count = (f"adaptive:{design}" if design.isdigit() else design).partition(":")
    if name not in DIRECTIONS:
        number = not set(name) - set("-+.0123456789")
        advice = _EXAMPLES if number else f"designs: {', '.join(DIRECTIONS)}"
        raise SettingError(f"probes={spec!r}", _GRAMMAR, advice)
    design, counted = DIRECTIONS[name], "probes" in DIRECTIONS[name].__dataclass_fields__
    if colon and not counted:
        raise SettingError(f"probes={spec!r}: {name} takes no count", _GRAMMAR, f'write "{name}"')
    try:
        counts = [None if count == "all" else int(count)] if colon else []
        directions = design(*counts)
    except ValueError:  # no number, or none that can be used
        raise SettingError(f"probes={spec!r}", _GRAMMAR, _EXAMPLES) from None
    fields: dict[str, Any] = {}
    for option in options:
        fields |= _parse_option(option, spec)
    if directions.exact and "stencil" in fields:
        raise SettingError(f"probes={spec!r}", "no stencil: the derivative is exact", _EXAMPLES)
    return Probes(directions, **fields)


def _parse_option(option: str, spec: str) -> dict[str, object]:
    key, _, value = option.partition("=")
    if not value and key in _FLAGS:
        return dict([_FLAGS[key]])
    try:
        return {key: _NUMBERS[key](value)}
    except (KeyError, ValueError):
        known = ", ".join([*_FLAGS, *(f"{name}=..." for name in _NUMBERS)])
        raise SettingError(
            f"probes={spec!r}: unknown option {option!r}", f"one of {known}", _EXAMPLES
        ) from None
