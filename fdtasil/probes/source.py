"""A derivative source: directions, stencil, distance, what is matched, and when to ask again."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

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
from fdtasil.probes.stencils import CENTRAL, EXACT, FORWARD, Stencil

__all__ = ["DIRECTIONS", "FRESH", "Match", "Probes", "Radius", "radius_text"]

DIRECTIONS: dict[str, Any] = {
    design.name: design
    for design in (AdaptiveDirections, StandardBasis, RandomSphere, OrthogonalFrames, Jacobian)
}
"""Every design by the name it is written with."""


Match = Literal["differences", "labels", "both"]
"""What of the expert's answers a student is held to."""

Radius = float | tuple[float, float] | Literal["wide"]
"""One distance, or the nearest and the farthest of many."""


@dataclass(frozen=True)
class Probes:
    """A derivative source: where to probe, how far, what is matched, and when to ask again.

    Attributes:
        directions: Where.
        stencil: How: `FORWARD`, `CENTRAL`, or `EXACT` (a differentiable expert only). None
            leaves it to the calibration, or is forward for first order and central for second.
        radius: How far. Whitened space: standard deviations moved by each coordinate that moves
            (root mean square). Raw space: Euclidean length of the displacement. Two numbers:
            each direction has a length of its own between them, log-uniform. "wide": from 0.2, or
            as near as the expert allows, to 2. None leaves it to the calibration, or the preset.
        space: "whitened" scales each coordinate by its standard deviation over the
            demonstrations and freezes those that do not move; "raw" takes observations as they
            are. None leaves it to the preset.
        resample: Whether new directions are drawn and the expert is asked again each time that
            the stored answers have been used once.
        per_step: How many of a state's probes one visit of the state uses, or "all" (the cost of
            a training step then grows with their number). None leaves it to the preset.
        match: "differences" between moved and demonstrated states; "labels", the answers at the
            moved states as they are (data augmentation); or "both". None is the labels where there
            are many distances (both for a loss of second order); else it leaves it to the
            calibration, or is the differences.

    Example:
        >>> Probes.parse("sphere:5,resample") == Probes(RandomSphere(5), resample=True)
        True
        >>> Probes.parse("sphere:10,forward").queries(states=300, dimension=17, visits=100)
        3000
    """

    directions: Directions
    stencil: Stencil | None = None
    radius: Radius | None = None
    space: Literal["whitened", "raw"] | None = None
    resample: bool = False
    per_step: int | Literal["all"] | None = None
    match: Match | None = None

    def __post_init__(self) -> None:
        if self.radius is not None:
            object.__setattr__(self, "radius", _checked_radius(self.radius))
        if self.space is not None:
            check_choice("space", self.space, ("whitened", "raw"))
        if self.match is not None:
            check_choice("match", self.match, _MATCHES)
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
        if self.exact:  # a derivative stays the same
            object.__setattr__(self, "resample", False)
        if self.exact and self.has_labels:
            raise SettingError(
                f"match={self.match!r} with exact derivatives",
                "answers at moved states, of which there are none",
                'write for example probes="10,both"',
            )
        if self.per_step is not None and not _is_all(self.per_step):
            object.__setattr__(self, "per_step", check_count("per_step", self.per_step))

    @staticmethod
    def parse(spec: "int | str | Probes | None") -> "Probes | None":
        """Read a derivative source as it is written in a call or a shell.

        Args:
            spec: 0 or "none" (plain behaviour cloning), N (N adaptive directions), or a text
                `design[:count][,option...]`: designs adaptive (a mere number is one), basis,
                sphere, orthogonal, jacobian, fresh; options forward, central, differences,
                labels, both, resample, whitened, raw, radius=R, radius=LOW..HIGH, radius=wide,
                per_step=K. "fresh" is "adaptive:10,resample,radius=wide". A `Probes` is returned
                as it is.

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
        parts += [self.match] if self.match else []
        parts += ["resample"] if self.resample else []
        parts += [self.space] if self.space else []
        parts += [f"radius={radius_text(self.radius)}"] if self.radius is not None else []
        parts += [f"per_step={self.per_step}"] if self.per_step is not None else []
        return ",".join(parts)

    @property
    def exact(self) -> bool:
        """Whether the expert is differentiated, and not asked."""
        return self.stencil is not None and self.stencil.exact

    @property
    def is_open(self) -> bool:
        """Whether a calibration finds the radius or the stencil."""
        return self.radius in (None, "wide") or self.stencil is None

    @property
    def is_ranged(self) -> bool:
        """Whether each direction has a distance of its own."""
        return self.radius == "wide" or (
            isinstance(self.radius, tuple) and self.radius[0] != self.radius[1]
        )

    @property
    def has_labels(self) -> bool:
        """Whether the answers at the moved states are matched as they are."""
        return self.match in ("labels", "both")

    @property
    def reaches(self) -> tuple[float, float]:
        """The nearest and the farthest distance, once the radius is known."""
        assert isinstance(self.radius, int | float | tuple), "the preset sets the radius"
        return self.radius if isinstance(self.radius, tuple) else (self.radius, self.radius)

    def with_order(self, order: int, usual: Stencil | None = FORWARD) -> "Probes":
        """Return the source with a stencil that has differences up to `order`.

        Args:
            order: 1 or 2.
            usual: The stencil of first order where none is set; None leaves it open.

        Raises:
            SettingError: If the stencil that was asked for has none of second order.
        """
        match = self.match
        if match is None and self.is_ranged and not self.exact:
            # Differences of near probes would outweigh the far ones, which teach to come back.
            match = "labels" if order == 1 else "both"
        if match in ("labels", "both"):
            usual = FORWARD  # a label needs no other side
        stencil = self.stencil or (CENTRAL if order == 2 else usual)
        if order == 2 and match == "labels":
            raise SettingError(
                "order=2 with labels",
                "second differences to match",
                'write for example probes="10,central,both"',
            )
        if order == 2 and stencil and not stencil.exact and stencil.second is None:
            raise SettingError(
                f"order=2 with the {stencil.name} stencil",
                "a stencil with second differences",
                'write probes="sphere:10,central"',
            )
        return replace(self, stencil=stencil, match=match)

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


def _checked_radius(radius: object) -> Radius:
    if isinstance(radius, str):
        check_choice("radius", radius, ("wide",))
        return "wide"
    if not isinstance(radius, tuple | list):
        return check_number("radius", radius, positive=True)
    ends = tuple(check_number("radius", end, positive=True) for end in radius)
    if len(ends) != 2 or not ends[0] <= ends[1]:
        raise SettingError(
            spelt("radius", radius), "the nearest and the farthest", "write radius=0.2..2"
        )
    return ends


def radius_text(radius: Radius) -> str:
    """Return the text of a radius that `Probes.parse` reads back."""
    if isinstance(radius, str):
        return radius
    ends = radius if isinstance(radius, tuple) else (radius,)
    return "..".join(_shortest(end) for end in ends)


def _read_radius(text: str) -> Radius:
    if text == "wide":
        return "wide"
    ends = [float(end) for end in text.split("..")]
    return ends[0] if len(ends) == 1 else tuple(ends)  # pyright: ignore[reportReturnType]


def _shortest(number: float) -> str:
    """Return the shortest text that reads back as the same number."""
    text = f"{number:g}"
    return text if float(text) == number else repr(float(number))


FRESH = "fresh"
"""What asks anew, at many distances, as long as it trains."""
_FRESH = {"resample": True, "radius": "wide"}

_GRAMMAR = 'a number of probes, or a text like "sphere:10,resample", "basis,central", "jacobian"'
_EXAMPLES = "write for example probes=10, or probes=0 for plain behaviour cloning"
_MATCHES: tuple[Match, ...] = get_args(Match)
_FLAGS: dict[str, tuple[str, object]] = {
    **{stencil.name: ("stencil", stencil) for stencil in (FORWARD, CENTRAL)},
    **{match: ("match", match) for match in _MATCHES},
    "resample": ("resample", True),
    "whitened": ("space", "whitened"),
    "raw": ("space", "raw"),
}
_NUMBERS: dict[str, Callable[[str], object]] = {
    "radius": _read_radius,
    "per_step": lambda text: text if text == "all" else int(text),
}


_LIKE = {
    "radius": "radius=0.3, radius=0.2..2 or radius=wide",
    "per_step": "per_step=2 or per_step=all",
}


def _describe(directions: Directions) -> str:
    count = getattr(directions, "probes", "")
    return f"{directions.name}:{'all' if count is None else count}".rstrip(":")


def _parse_text(spec: str) -> Probes:
    design, *options = (part.strip() for part in spec.split(","))
    name, colon, count = (f"adaptive:{design}" if design.isdigit() else design).partition(":")
    fields: dict[str, Any] = {}
    if name == FRESH:
        name, fields = AdaptiveDirections.name, dict(_FRESH)
    if name not in DIRECTIONS:
        number = not set(name) - set("-+.0123456789")
        advice = _EXAMPLES if number else f"designs: {', '.join([*DIRECTIONS, FRESH])}"
        raise SettingError(f"probes={spec!r}", _GRAMMAR, advice)
    design, counted = DIRECTIONS[name], "probes" in DIRECTIONS[name].__dataclass_fields__
    if colon and not counted:
        raise SettingError(f"probes={spec!r}: {name} takes no count", _GRAMMAR, f'write "{name}"')
    try:
        counts = [None if count == "all" else int(count)] if colon else []
        directions = design(*counts)
    except ValueError:  # no number, or none that can be used
        raise SettingError(f"probes={spec!r}", _GRAMMAR, _EXAMPLES) from None
    told: dict[str, str] = {}
    for option in options:
        field, value = _parse_option(option, spec)
        if field in told and fields[field] != value:
            found = f"probes={spec!r}: {told[field]!r} beside {option!r}"
            raise SettingError(found, "one of the two", "leave one out")
        fields[field], told[field] = value, option
    if directions.exact and "stencil" in fields:
        raise SettingError(f"probes={spec!r}", "no stencil: the derivative is exact", _EXAMPLES)
    return Probes(directions, **fields)


def _parse_option(option: str, spec: str) -> tuple[str, object]:
    key, _, value = option.partition("=")
    if not value and key in _FLAGS:
        return _FLAGS[key]
    known = ", ".join([*_FLAGS, *(f"{name}=..." for name in _NUMBERS)])
    if key not in _NUMBERS:
        found = f"probes={spec!r}: unknown option {option!r}"
        raise SettingError(found, f"one of {known}", _EXAMPLES)
    try:
        return key, _NUMBERS[key](value)
    except ValueError:
        found = f"probes={spec!r}: {value!r} in {option!r}"
        raise SettingError(found, _LIKE[key], "write one of these") from None
