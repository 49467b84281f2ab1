"""How well a student's derivatives are its expert's, beside how rough the expert is itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.probes.scales import Scales, all_but, least_steps
from fdtasil.rollouts.behaviours import Policy, has_none

__all__ = ["GOOD", "USUAL", "Fidelity", "fidelity_of"]

RADII = (0.03, 0.1, 0.3, 1.0)
USUAL = 0.3
"""Radius at which differences are compared in one number."""
GOOD = (
    "on nine walking and swimming robots, students at their expert's return had 27 to 85 %, "
    "below half of it 86 to 108 %; elsewhere it may be otherwise"
)
"""What 80 % of the students of nine experts had (benchmarks/figures/fidelity.md)."""
_DIRECTIONS = 8
_STILL = float(np.finfo(np.float32).eps)  # of an action's unit: what varies less is rounding
_ROUNDING = 1e-5  # of how actions vary: an expert that changes less does not react


@dataclass(frozen=True)
class Fidelity:
    """Errors of a student's differences along held-out directions, around its expert's states.

    Actions are taken as the environment takes them, each in units of how the expert's varies.

    Attributes:
        radii: In standard deviations of each coordinate.
        errors: At each radius the root mean square error of a difference of the student, as a
            share of the expert's own difference. 0 is the expert, 1 a student that does not
            react. NaN where the student reacts and the expert does not, or has no answers;
            infinite where the student has none.
        roughness: What the expert's roughness at 1e-4 deviations (noise, rounding, jumps) is, as
            the same share: of an expert that is random, no error is below it.
        action_error: Of the actions at the states, as a share of how the expert's vary.
        answered: Share of the moved states at which the expert has an answer.
    """

    radii: tuple[float, ...]
    errors: tuple[float, ...]
    roughness: tuple[float, ...]
    action_error: float
    answered: float = 1.0

    @property
    def error(self) -> float:
        """The error at 0.3 deviations."""
        return self.errors[self.radii.index(USUAL)]


def fidelity_of(
    student: Policy,
    expert: Policy,
    states: np.ndarray,
    units: np.ndarray,
    scales: Scales,
    random: np.random.Generator,
    held: Sequence[int] = (),
) -> Fidelity:
    """Compare differences of a student and its expert (TaSIL, appendix on finite differences).

    Args:
        student: (B, n) -> (B, m) actions as the environment takes them.
        expert: The same; rows of NaN are no answer.
        states: (S, n) of the expert's own episodes; it has an answer at some.
        units: (m,) of the actions that stand still, from `action_units`.
        scales: Of its states.
        random: Draws directions that nothing was trained on.
        held: Coordinates that nothing moves: choices, flags, whole numbers. Not all of them.
    """
    live = scales.probed("whitened") & all_but(held, states.shape[1])
    count, n = states.shape
    normal = random.standard_normal((count, _DIRECTIONS, n)) * live
    unit = normal / np.linalg.norm(normal, axis=2, keepdims=True) * live.sum() ** 0.5
    steps = scales.with_following(unit * np.where(live, scales.deviation, 0.0))
    answers = expert(states)
    heard = ~has_none(answers)
    states, steps, theirs = states[heard], steps[heard], answers[heard].astype(np.float64)
    ours, varies = student(states).astype(np.float64), theirs.std(axis=0)
    still = np.maximum(_STILL * units, least_steps(theirs))
    varies = np.where(varies > still, varies, units)
    pair = _Pair(student, expert, varies)
    noise = pair.noise(states, theirs, steps[:, 0])
    found = [pair.compared(states, theirs, ours, radius * steps) for radius in RADII]
    apart = _size((ours - theirs) / varies)
    spread = _size((theirs - theirs.mean(axis=0)) / varies)
    return Fidelity(
        RADII,
        tuple(_share(error, size) for error, size, _ in found),
        tuple(_share(2**0.5 * noise, size) for _, size, _ in found),
        _share(apart, spread),
        float(np.mean([heard for *_, heard in found])),
    )


@dataclass(frozen=True)
class _Pair:
    """A student and its expert, and the units of their actions."""

    student: Policy
    expert: Policy
    units: np.ndarray

    def compared(
        self, states: np.ndarray, theirs: np.ndarray, ours: np.ndarray, steps: np.ndarray
    ) -> tuple[float, float, float]:
        """Return the size of the differences' error, that of the expert's, the share it answers.

        Args:
            states: (S, n).
            theirs: (S, m) the expert's actions there.
            ours: (S, m) the student's.
            steps: (S, P, n) from them.
        """
        shape = steps.shape[:2]
        points = (states[:, None] + steps).astype(np.float32).reshape(-1, states.shape[1])
        said, mine = (ask(points).astype(np.float64) for ask in (self.expert, self.student))
        heard = ~has_none(said).reshape(shape)
        size = (said.reshape(*shape, -1) - theirs[:, None])[heard] / self.units
        error = (mine.reshape(*shape, -1) - ours[:, None])[heard] / self.units - size
        return _size(error), _size(size), float(heard.mean())

    def noise(self, states: np.ndarray, theirs: np.ndarray, steps: np.ndarray) -> float:
        """Return the root mean square error of an action, by second differences very near."""
        near = 1e-4 * steps
        sides = [self.expert((states + sign * near).astype(np.float32)) for sign in (1, -1)]
        second = (sides[0].astype(np.float64) + sides[1] - 2 * theirs) / self.units
        return _size(second[~has_none(second)]) / 6**0.5


def _size(actions: np.ndarray) -> float:
    """Return the root mean square; NaN of nothing, infinite where an action is missing."""
    if not actions.size:
        return float("nan")
    size = float(np.sqrt((actions**2).mean()))
    return float("inf") if np.isnan(size) else size


def _share(part: float, whole: float) -> float:
    """Return a part as a share; no number where the whole is rounding."""
    return part / whole if whole > _ROUNDING else 0.0 if part == 0 else float("nan")
