"""How far to probe: what an expert's answers look like at many distances, asked once."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.expert import Expert
from fdtasil.files.plain import from_plain, to_plain
from fdtasil.probes.answers import ask_moved
from fdtasil.probes.scales import Scales
from fdtasil.probes.source import Match, Probes
from fdtasil.probes.stencils import CENTRAL, FORWARD

__all__ = ["WIDE", "Calibration", "Ladder", "calibrate", "ladder_for"]


@dataclass(frozen=True)
class Ladder:
    """The radii that a calibration asks at, on both sides of some states.

    Attributes:
        rays: Number of states, one direction each.
        steps: Number of radii: 1, 1/4, 1/16 ... standard deviations of each coordinate.
    """

    rays: int
    steps: int

    @property
    def radii(self) -> np.ndarray:
        """(steps,) ascending."""
        return 4.0 ** np.arange(1 - self.steps, 1)

    @property
    def queries(self) -> int:
        """Rows asked."""
        return self.rays * (2 * self.steps + 1)


_WHOLE, _SHORT = Ladder(rays=48, steps=10), Ladder(rays=16, steps=6)  # 1,008 and 208 rows
_DEAR = 10_000  # probe rows of a run below which the short ladder is long enough
# Differences at a radius and at a quarter of it point the same way where a derivative exists:
# smooth experts reach 0.85 and more somewhere, trees and quantised networks stay below 0.5.
_COHERENT = 0.75
# Similarity at the radius that is used, below which jumps or kinks rule there, and a difference
# over both sides teaches better. Networks have 0.70 to 0.94, a bang-bang law and a sampling
# controller, which are smooth at most states, 0.5, trees and int8 less.
_ROUGH = 0.62
# Share of rays along which something changes at that radius, below which the law is at a bound at
# some of its states: there its kinks are near the others, and both sides teach better too.
_ALL_MOVE = 0.9
_ROUGH_RADIUS = 0.5
# Change of the actions at the radius, beside how they vary over the states, above which the law is
# steep for the scale that it is probed at: a swing-up that ends in a stiff balance has 2.4,
# networks that walk 0.5 to 1. Differences alone then count more than the actions do.
_STEEP = 1.5
_RAYS = 4  # that are answered throughout, or along which something changes, at least
_NOISY_FROM = 4.0**-6  # smallest radius with a derivative; float32 rounding stays below it
_NOISY_SHARE = 0.3  # of noise in a difference; above it a given radius is warned of
WIDE = (0.2, 2.0)
"""The nearest and the farthest of the radii that teach well together, if an expert allows it."""
_FAR = 4.0  # standard deviations beyond which no demonstrated state lies, and none was asked about


def ladder_for(probe_rows: int) -> Ladder:
    """Return the ladder for a run that asks that many probes: about a tenth of them at most."""
    return _SHORT if probe_rows < _DEAR else _WHOLE


@dataclass(frozen=True)
class Calibration:
    """What the ladder of radii says of an expert.

    Attributes:
        regime: "smooth", "noisy" (a derivative exists above a noise that differences at small
            radii show), or "steps" (no radius has one).
        noise_floor: Root mean square error of an action in its unit, from second differences at
            the smallest radius, where nothing but rounding and noise is left of them.
        radius: Suggested, in standard deviations of each coordinate.
        stencil: Suggested, "forward" or "central".
        match: Suggested where the law is steep or switches, "both"; else None.
        similarity: Secant similarity at each radius and a quarter of it; the first is NaN.
        change: Root mean square change of an action in its unit, at each radius.
        radii: The radii, ascending.
        queries: Rows asked.
        no_answer: Radius, and share of the states moved so far where the expert has no answer;
            empty where it has one everywhere.
        switches: Whether each action has few values and nothing between them, as a choice or a
            relay has. Near a state nothing changes then: it is asked as far as "fresh" asks.
    """

    regime: Literal["smooth", "noisy", "steps"]
    noise_floor: float
    radius: float
    stencil: str
    similarity: tuple[float, ...]
    change: tuple[float, ...]
    radii: tuple[float, ...]
    queries: int
    match: Match | None = None
    no_answer: tuple[tuple[float, float], ...] = ()
    switches: bool = False

    def complete(self, probes: Probes) -> Probes:
        """Return the source with what it leaves open filled in; warn of a radius that misleads."""
        usual = WIDE if self.switches else self.radius
        radius = usual if probes.radius is None else probes.radius
        if radius == "wide":
            radius = max(WIDE[0], self._nearest()), WIDE[1]
        elif probes.radius is not None:
            for end in sorted(set(replace(probes, radius=radius).reaches)):
                self._warn_of(end)
        stencil = CENTRAL if self.stencil == "central" else FORWARD
        match = probes.match or self.match
        return replace(probes, radius=radius, stencil=probes.stencil or stencil, match=match)

    def _nearest(self) -> float:
        """Return the smallest radius at which differences say something of the expert."""
        if self.regime == "steps":
            return self.radius
        told = [r for r, c in zip(self.radii, self.change, strict=True) if self._heard(c)]
        return min(told, default=self.radius)

    def _heard(self, change: float) -> bool:
        return 2**0.5 * self.noise_floor <= _NOISY_SHARE * change

    def similarity_at(self, radius: float) -> float:
        """Return the similarity at a radius, interpolated between the rungs of the ladder."""
        return float(np.interp(np.log(radius), np.log(self.radii[1:]), self.similarity[1:]))

    def to_json(self) -> dict[str, Any]:
        """Return the calibration as plain JSON values."""
        return to_plain(self) | {"similarity": [None, *self.similarity[1:]]}

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> "Calibration":
        """Read what `to_json` returned."""
        similarity = [float("nan"), *fields["similarity"][1:]]
        return from_plain(cls, {**fields, "similarity": similarity})

    def _warn_of(self, radius: float) -> None:
        change = float(np.interp(np.log(radius), np.log(self.radii), self.change))
        change *= min(1.0, radius / self.radii[0])  # linear, nearer than anything that was asked
        noise = 2**0.5 * self.noise_floor
        coherent, best = self.similarity_at(radius), self.similarity_at(self.radius)
        reason = None
        if self.regime != "steps" and not self._heard(change):
            reason = f"{min(1.0, noise / change):.0%} of a difference there is noise"
        elif coherent < 0.5 * best:
            reason = f"differences there and at a quarter of it agree to {coherent:.2f} only"
        elif radius > _FAR:
            reason = "no demonstrated state lies that far from the others"
        if reason is not None:
            warn(
                f"radius={radius:g}: {reason}; the calibration suggests {self.radius:.2g} "
                f"(agreement {best:.2f}), which leaving radius= out takes"
            )


def calibrate(
    expert: Expert,
    observations: np.ndarray,
    scales: Scales,
    random: np.random.Generator,
    usual: float,
    ladder: Ladder = _WHOLE,
    units: np.ndarray | None = None,
) -> Calibration:
    """Ask an expert at a ladder of radii on both sides of some states.

    Args:
        expert: The expert.
        observations: (N, n) states of the environment.
        scales: Of these states.
        random: Draws states and directions.
        usual: The radius that teaches best where the expert allows it.
        ladder: How much is asked.
        units: (m,) that actions are measured in, from `action_units`, so that one in millimetres
            does not decide alone; None for their own.
    """
    rays, radii = ladder.rays, ladder.radii
    rows = random.choice(len(observations), size=rays, replace=len(observations) < rays)
    live = scales.probed("whitened")
    scale = np.where(live, scales.deviation, 0.0)
    normal = random.standard_normal((rays, len(scale))) * live
    directions = scale * normal / np.linalg.norm(normal, axis=1, keepdims=True) * live.sum() ** 0.5
    directions = scales.with_following(directions)
    signs = np.array([1.0, -1.0])[None, None, :, None]
    moved = directions[:, None, None, :] * radii[None, :, None, None] * signs
    points = (observations[rows][:, None, None, :] + moved).astype(np.float32)
    centres = expert.ask(observations[rows], "calibrate").astype(np.float64)
    answers = ask_moved(expert, points.reshape(-1, len(scale)), "calibrate")
    values = answers.reshape(rays, len(radii), 2, -1).astype(np.float64)
    if units is not None:
        centres, values = centres / units, values / units
    kept = _resolved(
        points - observations[rows][:, None, None, :].astype(np.float64), moved, scale
    )
    values, radii = values[:, kept:], radii[kept:]
    shares = _no_answer(values, radii)
    if np.isnan(values).any() or np.isnan(centres).any():
        values, centres = _answered(values, centres, expert)
        radii = radii[: values.shape[1]]
    secants = (values[:, :, 0] - values[:, :, 1]) / (2 * radii[None, :, None])
    similarity, moving = _similarity(secants[:, 1:], secants[:, :-1])
    second = values[:, 0, 0] + values[:, 0, 1] - 2 * centres
    floor = float(np.sqrt((second**2).mean() / 6))
    change = np.sqrt(((values - centres[:, None, None, :]) ** 2).mean(axis=(0, 2, 3)))
    regime, radius, stencil = _judge(similarity, moving, radii[1:], usual)
    radius = min(radius, float(radii[-1]))  # where it still answers
    varied = np.sqrt(centres.var(axis=0).mean())
    steep = np.interp(np.log(radius), np.log(radii), change) > _STEEP * varied
    # Where some have no answer, few may be left, and farther away there are fewer still.
    switches = not shares and _switches(values, centres)
    return Calibration(
        regime,
        floor,
        radius,
        stencil,
        (float("nan"), *similarity.tolist()),
        tuple(change.tolist()),
        tuple(radii.tolist()),
        ladder.queries,
        "both" if steep or switches else None,
        shares,
        switches,
    )


def _resolved(steps: np.ndarray, wanted: np.ndarray, scale: np.ndarray) -> int:
    """Return at how many of the smallest radii float32 rounds most of a step away.

    What is left of (rays, radii, 2, n) steps there points elsewhere, which is nothing of the
    expert's.
    """
    units = np.where(scale > 0, scale, 1)
    lost, whole = (((part / units) ** 2).sum(axis=(0, 2, 3)) for part in (steps - wanted, wanted))
    told = np.flatnonzero(lost <= _LOST**2 * whole)
    return min(int(told[0]) if len(told) else len(lost), len(lost) - 2)


def _switches(values: np.ndarray, centres: np.ndarray) -> bool:
    """Whether each of the actions in (rays, radii, 2, m) values that changes has few of them."""
    m = centres.shape[1]
    said = np.concatenate([values.reshape(-1, m), centres])
    counts = [len(np.unique(action)) for action in said.T]
    return 1 < max(counts) <= _FEW_VALUES


_LOST = 0.5  # share of a step that is rounding; with it, differences still agree to 0.8
_FEW_VALUES = 3  # a relay has two, with a dead zone three


def _no_answer(values: np.ndarray, radii: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return radii and shares without an answer of (rays, radii, 2, m) values."""
    shares = np.isnan(values).any(axis=3).mean(axis=(0, 2))
    return tuple(zip(radii.tolist(), shares.tolist(), strict=True)) if shares.any() else ()


def _answered(
    values: np.ndarray, centres: np.ndarray, expert: Expert
) -> tuple[np.ndarray, np.ndarray]:
    """Return values and centres of the rays that are answered throughout, as far as some are.

    Raises:
        ExpertError: If there are none even near the states.
    """
    centred = np.isfinite(centres).all(axis=1, keepdims=True)
    heard = np.asarray(np.isfinite(values).all(axis=(2, 3)) & centred)
    for farthest in range(values.shape[1], 1, -1):
        rays = heard[:, :farthest].all(axis=1)
        if rays.sum() >= _RAYS:
            return values[rays, :farthest], centres[rays]
    near = int((~heard[:, :2]).any(axis=1).sum())
    raise ExpertError(
        f"{expert.name} has no answer near {near} of {len(heard)} states; it said "
        f"{expert.silence.reason}",
        f"answers around {_RAYS} of them at least",
        "look at what it makes of a state that is moved a little, or pass probes=0",
    )


def _similarity(wide: np.ndarray, narrow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over moving rays of 2 <a, b> / (|a|^2 + |b|^2), and the share that moves.

    One number of each for each radius. Rays along which nothing changes say nothing: a law that
    is at a bound at most of its states has its derivative at the others. Where nearly all are
    still, as near the states of a tree, the similarity is 0.
    """
    both = (wide**2).sum(axis=-1) + (narrow**2).sum(axis=-1)
    product = 2 * (wide * narrow).sum(axis=-1)
    each, moving = product / np.where(both > 0, both, 1), (both > 0).sum(axis=0)
    similarity = np.where(moving >= _RAYS, each.sum(axis=0) / np.maximum(moving, 1), 0.0)
    return similarity, moving / len(both)


def _judge(
    similarity: np.ndarray, moving: np.ndarray, radii: np.ndarray, usual: float
) -> tuple[Literal["smooth", "noisy", "steps"], float, str]:
    """Return regime, radius and stencil from what `_similarity` says of all but the smallest."""
    coherent = np.flatnonzero(similarity >= _COHERENT)
    if not len(coherent) or radii[coherent[-1]] < 1e-3:
        return "steps", max(usual, _ROUGH_RADIUS), "central"
    # The kinks of a ReLU network end the band before the distance that teaches best, so only
    # its lower end, where the noise is, moves the radius.
    low = float(radii[coherent[0]])
    regime = "noisy" if coherent[0] > 0 and low > _NOISY_FROM else "smooth"
    radius = max(usual, low)
    coherence, share = (
        float(np.interp(np.log(radius), np.log(radii), values)) for values in (similarity, moving)
    )
    kinked = coherence < _ROUGH or share < _ALL_MOVE
    return regime, radius, "central" if regime == "noisy" or kinked else "forward"
