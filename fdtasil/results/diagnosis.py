"""What a diagnosis found, and how it is told."""

import html
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.files.plain import to_plain, without_infinities
from fdtasil.results.conditions import Condition, Errors
from fdtasil.results.fidelity import GOOD, USUAL, Fidelity
from fdtasil.results.linearisation import Linearisation
from fdtasil.results.stability import Stability

__all__ = ["Diagnosis"]

_STEPS = (
    "the expert answers in steps, or is nearly always at a bound: no derivatives were found near "
    "its states, and differences are of its jumps"
)


@dataclass(frozen=True)
class Diagnosis:
    """What was measured of a student and its expert.

    Attributes:
        fidelity: Errors of the student's differences, by radius, beside the expert's roughness.
        stability: What the expert's closed loop makes of small disturbances of its actions.
        largest_error: Largest error of the student on its own paths, in units of half an action's
            range (the expert's deviation where it has none), where the expert has an answer.
        disturbed: How far disturbances of the expert led that were as large, in deviations; None
            where none were, or the student makes no error.
        by_law: gamma(largest_error): how far that leads by the measured law; None where no law was
            found, or the student makes no error. Both are lower estimates of what can happen, and
            no bounds.
        gap: How far it did lead: largest distance of the two paths of any episode.
        ended: Of how many episodes the student's path ended before the expert's: their distance
            is at least what was seen.
        unanswered: Share of the student's states at which the expert has no answer.
        queries: Rows that the expert answered.
        linearisation: Eigenvalues of both closed loops along the expert's path; None where the
            environment is no MuJoCo environment of gymnasium, its actions are no controls, or the
            student sees a past.
        errors: Of the student's action and derivative at states of the expert's first steps, as
            the theorems ask for; None where no law was found, the student sees a past, the expert
            answers in steps or has no answer around them, or not one coordinate moves, or more
            than 1,000.
        conditions: TaSIL's statements that are about such a loop, with these constants; none where
            no law was found, the student sees a past, or the expert answers in steps.
        regime: How the expert answers: "smooth", "noisy" or "steps", as in `Calibration`; None
            where it has no answers around its states, or always the same.
    """

    fidelity: Fidelity
    stability: Stability
    largest_error: float
    disturbed: float | None
    by_law: float | None
    gap: float
    ended: int
    unanswered: float
    queries: int
    linearisation: Linearisation | None = None
    errors: Errors | None = None
    conditions: tuple[Condition, ...] = ()
    regime: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis as plain JSON values; null for what is no number, or infinite."""
        return without_infinities(to_plain(self))[0]

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"

    def __str__(self) -> str:
        lines = _of_fidelity(self.fidelity)
        if self.regime == "steps":
            lines.insert(1, _STEPS)
        lines += _of_stability(self.stability)
        silent = f", not known at {self.unanswered:.0%} of it" if self.unanswered else ""
        lines.append(
            f"the student's largest error on its own path: {self.largest_error:.2g}{silent}"
        )
        least = f", at least: {self.ended} ended before the expert's" if self.ended else ""
        lines.append(f"its distance to the expert's path: {self.gap:.2g} deviations{least}")
        if self.disturbed is not None:
            lines.append(f"  disturbances of the expert as large led {self.disturbed:.2g} away")
        if self.by_law is not None and self.stability.law is not None:
            most = self.stability.law.reach[1]
            beyond = f"; it was measured up to {most:.1g}" if self.largest_error > most else ""
            lines.append(f"  by the measured law: {self.by_law:.2g}{beyond}")
        if self.linearisation is not None:
            lines.append(f"linearised loops: {self.linearisation}")
        if self.errors is not None:
            lines.append(f"on the expert's path: {self.errors}")
        if self.conditions:
            lines.append("TaSIL's conditions, were these constants true everywhere")
            lines += [f"  {condition}" for condition in self.conditions]
        return "\n".join(lines)


def _of_fidelity(found: Fidelity) -> list[str]:
    if np.isnan(found.error):
        first = f"its expert does not react at a radius of {USUAL}, or has no answers there"
    elif np.isinf(found.error):
        first = f"it has no answer at some states, at a radius of {USUAL} from its expert's"
    else:
        first = (
            f"its reactions are off by {found.error:.0%} of its expert's at a radius of {USUAL}"
        )
        first += f"; {GOOD}"
    lines = [first, "derivatives, error relative to the expert's own differences (its roughness)"]
    for radius, error, rough in zip(found.radii, found.errors, found.roughness, strict=True):
        lines.append(f"  radius {radius:<5g} {_percent(error):>8}   ({_percent(rough)})")
    lines.append(f"  actions      {_percent(found.action_error):>8}   of how the expert's vary")
    if found.answered < 1:
        lines.append(f"  the expert has answers at {found.answered:.0%} of the moved states")
    return lines


def _percent(share: float) -> str:
    return f"{share:.1%}" if np.isfinite(share) else "-" if np.isnan(share) else "infinite"


def _of_stability(loop: Stability) -> list[str]:
    lines = ["the expert's closed loop, disturbance -> largest deviation"]
    for size, deviation, ended in zip(loop.sizes, loop.deviations, loop.ended, strict=True):
        early = f"   ({ended} ended early, of two from each start)" if ended else ""
        lines.append(f"  {size:<8.2g} {deviation:10.2g}{early}")
    law = "no power law: rounding, as large as the states vary, or another shape"
    lines.append(f"  {loop.law or law}")
    if loop.rate is not None:
        between = loop.rate_interval
        interval = f" [{between[0]:.3g}, {between[1]:.3g}]" if between else ""
        lines.append(f"  after one disturbed action: times {loop.rate:.3g}{interval} in each step")
    return lines
