"""TaSIL's conditions with measured constants: what they ask of a student, and what it has.

Norms: a deviation is the root mean square over the coordinates that move, in the expert's standard
deviations; an action is the Euclidean norm, in halves of the actions' ranges (where an action has
no bounds, in the deviation of the expert's). Delta is student - expert, as the environment takes
their actions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.probes.scales import Scales, all_but
from fdtasil.results.stability import NEARLY, Law
from fdtasil.rollouts.behaviours import Policy

__all__ = ["Condition", "Errors", "conditions_of", "errors_of", "sphere_factor"]

_NEAR = 0.01  # deviations of a coordinate: of the derivative's differences
_BENT = 0.1  # of second differences, which rounding reaches sooner
_DIRECTIONS = 8
_CHANCE = 0.05
_AT_ONCE = 64  # directions that are asked along in one batch
_MOST = 1_000  # coordinates, along each of which both are asked
_LEAST = 1e-12  # that is divided by
_STARTS = np.geomspace(1e-6, 1.0, 241)  # deviations, in which a path bound is looked for


@dataclass(frozen=True)
class Errors:
    """What was measured of a student at states of its expert's path.

    Attributes:
        action: Largest |Delta|.
        derivative: Largest operator norm of the derivative of Delta, by central differences along
            every coordinate that is probed: these directions are independent.
        uncertainty: Estimate of that derivative's own error: how far differences of twice the
            step are from it, at most.
        sphere: What a few fresh directions bound the same norm by, with probability 0.95 at all
            of the states together, if Delta bends no more than `bend` (TaSIL, appendix on finite
            differences, after Woolfe et al. 2008, theorem 3.15).
        lipschitz: Largest derivative of either policy: a lower bound of its Lipschitz constant.
        curvature: Largest second difference of either policy over the squared step, along
            coordinates and random directions: a lower bound of the Lipschitz constant of its
            derivative, which a network of ReLUs does not have.
        bend: The same of Delta itself; at most twice `curvature`.
        states: At how many states.
    """

    action: float
    derivative: float
    uncertainty: float
    sphere: float
    lipschitz: float
    curvature: float
    bend: float
    states: int

    def __str__(self) -> str:
        return (
            f"|Delta| {self.action:.2g}, |dDelta| {self.derivative:.2g} +- {self.uncertainty:.2g} "
            f"({_DIRECTIONS} fresh directions bound it by {self.sphere:.2g}), "
            f"L {self.curvature:.2g}, at {self.states} states"
        )


@dataclass(frozen=True)
class Condition:
    """What one statement asks for, and what it then promises.

    Attributes:
        source: Of the statement.
        asked: What is compared, the measured value, and the largest that is allowed.
        promised: Bound on the largest distance of the student's path from the expert's, in
            deviations, where the condition is met and the law holds.
    """

    source: str
    asked: tuple[tuple[str, float, float], ...]
    promised: float

    @property
    def met(self) -> bool:
        """Whether every measured value is allowed."""
        return all(measured <= allowed for _, measured, allowed in self.asked)

    def __str__(self) -> str:
        said = (f"{name} is {here:.2g} (allowed {most:.2g})" for name, here, most in self.asked)
        end = f"met, and distance {self.promised:.2g} if the law holds" if self.met else "not met"
        return f"{self.source}: {', '.join(said)}; {end}"


def sphere_factor(size: int, directions: int, chance: float = _CHANCE, states: int = 1) -> float:
    """Return by what the largest of some directional derivatives bounds an operator norm.

    For directions drawn anew, uniformly from a sphere, the norm is at most this many times the
    largest derivative along one of them, except with a small probability. Nothing trained on these
    directions may be looked at with it.

    Args:
        size: d, dimension of the sphere's space.
        directions: Drawn for each state.
        chance: Probability that it fails at any of the states.
        states: How many they are.

    Example:
        >>> round(sphere_factor(17, 10, 0.05), 1), round(sphere_factor(17, 10, 0.05, 300), 1)
        (4.4, 7.9)
    """
    return max(1.0, math.sqrt(2 * size / math.pi) * (states / chance) ** (1 / directions))


def errors_of(
    student: Policy,
    expert: Policy,
    states: np.ndarray,
    units: np.ndarray,
    scales: Scales,
    random: np.random.Generator,
    held: Sequence[int] = (),
) -> Errors | None:
    """Measure a student's errors at states of its expert's path.

    Both are asked 6 d + 17 times at each state, for d coordinates.

    Args:
        student: (B, n) -> (B, m) actions as the environment takes them.
        expert: The same.
        states: (S, n).
        units: (m,) of actions, from `action_units`.
        scales: Of the expert's states.
        random: Draws directions that nothing was trained on.
        held: Coordinates that nothing moves.

    Returns:
        None where the expert has no answer in the neighbourhood of any of the states, and where
        no coordinate can be probed, or more than 1,000. Infinite errors where the student has no
        answer.
    """
    probed = scales.probed("whitened") & all_but(held, states.shape[1])
    if not 0 < probed.sum() <= _MOST:
        return None
    axes = np.eye(len(probed))[probed][:, None]
    drawn = random.standard_normal((_DIRECTIONS, len(states), len(probed))) * probed
    drawn /= np.linalg.norm(drawn, axis=2, keepdims=True)

    def on_both_sides(directions: np.ndarray, step: float) -> np.ndarray:
        moves = step * scales.with_following(scales.units * np.stack([directions, -directions]))
        return np.stack([_answers(student, expert, units, states, side) for side in moves])

    around = _Around(
        here=_answers(student, expert, units, states, np.zeros((1, 1, len(probed))))[0],
        near=on_both_sides(axes, _NEAR),
        wide=on_both_sides(axes, 2 * _NEAR),
        bent=on_both_sides(axes, _BENT),
        away=on_both_sides(drawn, _BENT),
    )
    answered = around.answered
    heard = answered[:, 1]  # the expert's
    if not heard.any():
        return None
    if not answered[heard].all():
        return Errors(*[math.inf] * 7, states=int(heard.sum()))
    return around.at(heard).errors(int(scales.live.sum()))


@dataclass(frozen=True)
class _Around:
    """What student and expert answer around S states.

    Attributes:
        here: (S, 2, m) at the states, the student's first.
        near: (2, K, S, 2, m) on both sides of them, along each of K coordinates that are probed.
        wide: The same, twice as far.
        bent: The same, farther still.
        away: (2, _DIRECTIONS, S, 2, m) as far, along directions that were drawn.
    """

    here: np.ndarray
    near: np.ndarray
    wide: np.ndarray
    bent: np.ndarray
    away: np.ndarray

    @property
    def _sides(self) -> tuple[np.ndarray, ...]:
        return self.near, self.wide, self.bent, self.away

    @property
    def answered(self) -> np.ndarray:
        """(S, 2) whether each answers throughout."""
        every = [np.isfinite(side).all(axis=(0, 1, 4)) for side in self._sides]
        return np.isfinite(self.here).all(axis=2) & np.all(every, axis=0)

    def at(self, chosen: np.ndarray) -> "_Around":
        """Return what they answer around some of the states, by (S,) booleans."""
        return _Around(self.here[chosen], *(side[:, :, chosen] for side in self._sides))

    def errors(self, d: int) -> Errors:
        """Return the errors, where d coordinates move.

        A step of length 1 along one direction has the root mean square 1 / sqrt(d).
        """
        first, second = (
            (sides[0] - sides[1]) * (d**0.5 / (2 * step))
            for sides, step in ((self.near, _NEAR), (self.wide, 2 * _NEAR))
        )
        bends = [sides.sum(axis=0) - 2 * self.here for sides in (self.bent, self.away)]
        curvature, bend = (
            d * max(map(_most, found)) / _BENT**2 for found in (bends, map(_apart, bends))
        )
        along = d**0.5 * _most(_apart(self.away[0] - self.away[1])) / (2 * _BENT)
        factor = sphere_factor(self.near.shape[1], _DIRECTIONS, states=len(self.here))
        return Errors(
            action=_most(_apart(self.here)),
            derivative=_norm(_apart(first)),
            uncertainty=_norm(_apart(second - first)),
            sphere=factor * (along + _BENT / d**0.5 * bend / 2),
            lipschitz=max(_norm(first[..., 0, :]), _norm(first[..., 1, :])),
            curvature=curvature,
            bend=bend,
            states=len(self.here),
        )


def _answers(
    student: Policy,
    expert: Policy,
    units: np.ndarray,
    states: np.ndarray,
    moves: np.ndarray,
) -> np.ndarray:
    """Return (K, S, 2, m) actions, the student's first, at states moved by (K, S or 1, n)."""
    found = []
    for start in range(0, len(moves), _AT_ONCE):
        points = states + moves[start : start + _AT_ONCE]
        rows = points.astype(np.float32).reshape(-1, states.shape[1])
        both = np.stack([student(rows), expert(rows)], axis=1, dtype=np.float64) / units
        found.append(both.reshape(*points.shape[:2], *both.shape[1:]))
    return np.concatenate(found)


def _apart(both: np.ndarray) -> np.ndarray:
    return both[..., 0, :] - both[..., 1, :]


def _most(actions: np.ndarray) -> float:
    return float(np.linalg.norm(actions, axis=-1).max())


def _norm(derivatives: np.ndarray) -> float:
    """(d, S, m) derivatives along coordinates -> the largest operator norm over the states."""
    return float(np.linalg.norm(np.moveaxis(derivatives, 0, 2), ord=2, axis=(1, 2)).max())


def conditions_of(errors: Errors, law: Law) -> tuple[Condition, ...]:
    """Return those of TaSIL's statements that are about such a loop.

    The derivative's error is taken with the error of its differences added, which is what the
    appendix's alpha-hat and eta-hat are for. The constants are estimates and lower bounds, from a
    few states and disturbances: a condition that is met here need not be met everywhere, and what
    it then promises holds if the law does.

    Args:
        errors: Of the student on the expert's path.
        law: Of the expert's loop: gamma(e) = C e^nu, within the reach of its measurement.
    """
    of, found = _Statements(law.constant, law.exponent, *law.reach, errors), []
    if law.exponent > 1 + NEARLY:
        found.append(of.order_zero())
    if law.exponent > 0.5:
        found.append(of.order_one())
    if abs(law.exponent - 1) <= NEARLY:
        found += [of.equal_orders(), of.corollary()]
    return (*found, of.solved())


@dataclass(frozen=True)
class _Statements:
    """The statements for one law and one student. Names are the paper's."""

    constant: float
    nu: float
    least: float
    eta: float
    errors: Errors

    @property
    def _derivative(self) -> float:
        return self.errors.derivative + self.errors.uncertainty

    @property
    def _linear(self) -> float:
        """C of gamma(e) <= C e, for the disturbances that were measured."""
        return self.constant * max(self.least ** (self.nu - 1), self.eta ** (self.nu - 1))

    def _promise(self, bound: float) -> float:
        # What a smaller disturbance leads to was not measured.
        return max(bound, self.constant * self.least**self.nu)

    def order_zero(self) -> Condition:
        """Theorem 3.1: gamma(x) <= C x^(1 + r), r > 0."""
        r, lipschitz, action = self.nu - 1, self.errors.lipschitz, self.errors.action
        bound = 2**self.nu * self.constant * action**self.nu
        # In logarithms: of r near 0 the power itself is no float.
        steep = self.nu * math.log(4 * max(lipschitz, _LEAST)) + math.log(self.constant)
        alpha = math.exp(min(-steep / r, math.log(self.constant)))
        asked = (
            ("distance", bound, alpha),
            ("disturbance", 2 * lipschitz * bound + action, self.eta),
        )
        return Condition("theorem 3.1, p = 0", asked, self._promise(bound))

    def order_one(self) -> Condition:
        """Theorem 3.2 with p = 1: gamma(x) <= C x^(1/r), 1 <= r < 2."""
        terms = 2 * self.errors.action, 2 * self._derivative
        if self.nu <= 1:
            return self._of_order_one("theorem 3.2, p = 1", self.constant, self.nu, terms)
        return self._of_order_one("theorem 3.2, p = 1", self._linear, 1.0, terms)

    def equal_orders(self) -> Condition:
        """Theorem A with p = r = 1, where the derivative is asked for, and not in the bound."""
        most = ("|dDelta|", self._derivative, 1 / (4 * self._linear))
        source, terms = "theorem A, p = r = 1", (4 * self.errors.action,)
        rest = self._of_order_one(source, self._linear, 1.0, terms)
        return Condition(source, (most, *rest.asked), rest.promised)

    def _of_order_one(
        self, source: str, constant: float, power: float, terms: Sequence[float]
    ) -> Condition:
        """Return both conditions of theorem 3.2 on the terms (2 / j!) |d^j Delta|."""
        mu, curvature, r = 2**power * constant, max(self.errors.curvature, _LEAST), 1 / power
        # In logarithms: of r near 2 the power itself is no float.
        steep = math.log(0.5) - math.log(curvature) - r * math.log(constant)
        alpha = min(0.5, constant, math.exp(min(0.0, steep / (2 - r))))
        bound = max(mu * term**power for term in terms)
        largest = max(curvature * (mu * term**power) ** 2 + term for term in terms)
        asked = (("distance", bound, alpha), ("disturbance", largest, self.eta))
        return Condition(source, asked, self._promise(bound))

    def corollary(self) -> Condition:
        """The corollary for gamma(x) = C x and p = 1, with C L >= 1."""
        constant, action = self._linear, self.errors.action
        curvature = max(self.errors.curvature, 1 / constant)
        asked = (
            ("|dDelta|", self._derivative, 1 / (4 * constant)),
            ("|Delta|", action, 1 / (16 * constant**2 * curvature)),
            ("disturbance", 8 * action, self.eta),
        )
        return Condition("corollary, r = 1", asked, self._promise(8 * constant * action))

    def solved(self) -> Condition:
        """Proposition 3.1 itself, with Delta bounded by its Taylor polynomial and a remainder."""
        forgiven = np.minimum((_STARTS / self.constant) ** (1 / self.nu), self.eta)
        error = self.errors.action + self._derivative * _STARTS
        error += self.errors.bend / 2 * _STARTS**2
        enough = np.flatnonzero(error <= forgiven)
        place = enough[0] if enough.size else int(np.argmin(error / forgiven))
        distance = float(_STARTS[place])
        asked = ((f"error within {distance:.2g}", float(error[place]), float(forgiven[place])),)
        return Condition("proposition 3.1, solved", asked, self._promise(distance))
