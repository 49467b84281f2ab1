"""How well a student's derivatives are its expert's, beside what the expert's own noise allows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.probes.scales import Scales
from fdtasil.rollouts.behaviours import Policy, has_none

__all__ = ["GOOD", "USUAL", "Fidelity", "fidelity_of"]

RADII = (0.03, 0.1, 0.3, 1.0)
USUAL = 0.3
"""Radius at which differences are compared in one number."""
GOOD = "students at their expert's return have 20 to 60 %, plain copies that fail 95 to 110 %"
"""What that number was on eight experts (benchmarks/figures/fidelity.md)."""
_DIRECTIONS = 8


@dataclass(frozen=True)
class Fidelity:
    """Errors of a student's differences along held-out directions, around its expert's states.

    Attributes:
        radii: In standard deviations of each coordinate.
        errors: At each radius the root mean square error of a difference of the student, as a
            share of the expert's own difference. 0 is the expert, 1 a student that does not react.
        floors: What the expert's own noise makes of that at least.
        action_error: Of the actions at the states, as a share of how the expert's vary.
    """

    radii: tuple[float, ...]
    errors: tuple[float, ...]
    floors: tuple[float, ...]
    action_error: float

    @property
    def error(self) -> float:
        """The error at 0.3 deviations."""
        return self.errors[self.radii.index(USUAL)]


def fidelity_of(
    student: Policy,
    expert: Expert,
    states: np.ndarray,
    scales: Scales,
    random: np.random.Generator,
    held: Sequence[int] = (),
) -> Fidelity:
    """Compare differences of a student and its expert (TaSIL, appendix on finite differences).

    Args:
        student: (B, n) -> (B, m).
        expert: Counts its rows under "check".
        states: (S, n) of the expert's own episodes.
        scales: Of its states.
        random: Draws directions that nothing was trained on.
        held: Coordinates that nothing moves: choices, flags, whole numbers.
    """
    live = scales.probed("whitened") & ~np.isin(np.arange(states.shape[1]), list(held))
    count, n = states.shape
    normal = random.standard_normal((count, _DIRECTIONS, n)) * live
    unit = normal / np.linalg.norm(normal, axis=2, keepdims=True) * live.sum() ** 0.5
    steps = unit * np.where(live, scales.deviation, 0.0)
    theirs, ours = expert.ask(states, "check"), student(states)
    errors, floors = [], []
    noise = _noise(expert, states, theirs, steps[:, 0])
    for radius in RADII:
        points = (states[:, None] + radius * steps).astype(np.float32).reshape(-1, n)
        said = expert.ask(points, "check").reshape(count, _DIRECTIONS, -1)
        mine = student(points).reshape(count, _DIRECTIONS, -1)
        heard = ~has_none(said.reshape(len(points), -1)).reshape(count, _DIRECTIONS)
        difference = (said - theirs[:, None])[heard]
        error = (mine - ours[:, None])[heard] - difference
        size = float(np.sqrt(np.nanmean(difference**2)))
        apart = float(np.sqrt(np.nanmean(error**2)))
        errors.append(_share(apart, size))
        floors.append(_share(2**0.5 * noise, size))
    spread = float(np.sqrt(np.nanmean((theirs - np.nanmean(theirs, axis=0)) ** 2)))
    apart = float(np.sqrt(np.nanmean((ours - theirs) ** 2)))
    return Fidelity(RADII, tuple(errors), tuple(floors), _share(apart, spread))


def _share(part: float, whole: float) -> float:
    """Return a part as a share; nothing of nothing is none."""
    return part / whole if whole > 0 else 0.0 if part == 0 else float("inf")


def _noise(expert: Expert, states: np.ndarray, theirs: np.ndarray, steps: np.ndarray) -> float:
    """Return the root mean square error of an action, by second differences very near."""
    near = 1e-4 * steps
    sides = [expert.ask((states + sign * near).astype(np.float32), "check") for sign in (1, -1)]
    second = sides[0].astype(np.float64) + sides[1] - 2 * theirs
    return float(np.sqrt(np.nanmean(second**2) / 6))
