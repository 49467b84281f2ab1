"""TaSIL's conditions with measured constants: what they ask of a student, and what it has.

Norms: a deviation is the root mean square over coordinates, in the expert's standard deviations;
an action is the Euclidean norm, in halves of the actions' ranges. Delta is student - expert.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.probes.scales import Scales
from fdtasil.results.stability import Stability
from fdtasil.rollouts.behaviours import Policy

__all__ = ["Condition", "Errors", "conditions_of", "errors_of", "sphere_factor"]

_STEP = 0.1  # deviations: of the differences; half of it says how far they can be trusted
_DIRECTIONS = 8
_CHANCE = 0.05
_NEARLY = 0.05  # of an exponent: a measured 0.97 is 1
_MOST = 1_000  # coordinates, along each of which the expert is asked
_LEAST = 1e-12  # that is divided by
_STARTS = np.geomspace(1e-6, 1.0, 241)  # deviations, in which a path bound is looked for


@dataclass(frozen=True)
class Errors:
    """What was measured of a student on its expert's path.

    Attributes:
        action: Largest |Delta|.
        derivative: Largest operator norm of the derivative of Delta, by central differences along
            all coordinates, which are independent.
        difference: b, how far differences of half the step are from these, at most.
        sphere: What a few fresh directions bound the same norm by, with probability 0.95 at all
            of the states together (TaSIL, appendix on finite differences, after Woolfe et al.
            2008, theorem 3.15).
        lipschitz: Largest derivative of either policy: a lower bound of its Lipschitz constant.
        curvature: Largest second difference of either policy over the squared step: a lower bound
            of the Lipschitz constant of its derivative, which a network of ReLUs does not have.
    """

    action: float
    derivative: float
    difference: float
    sphere: float
    lipschitz: float
    curvature: float

    def __str__(self) -> str:
        return (
            f"|Delta| {self.action:.2g}, |dDelta| {self.derivative:.2g} +- {self.difference:.2g} "
            f"(8 fresh directions bound it by {self.sphere:.2g}), L {self.curvature:.2g}"
        )


@dataclass(frozen=True)
class Condition:
    """What one statement asks for, and what it then promises.

    Attributes:
        source: Of the statement.
        asked: What is compared, the measured value, and the largest that is allowed.
        bound: On the largest distance of the student's path from the expert's, in deviations; None
            where the condition is not met.
    """

    source: str
    asked: tuple[tuple[str, float, float], ...]
    bound: float | None

    @property
    def met(self) -> bool:
        """Whether every measured value is allowed."""
        return all(measured <= allowed for _, measured, allowed in self.asked)

    def __str__(self) -> str:
        said = ", ".join(
            f"{name} {here:.2g} (allowed {most:.2g})" for name, here, most in self.asked
        )
        return f"{self.source}: {said}; " + (
            "not met" if self.bound is None else f"distance at most {self.bound:.2g}"
        )


def sphere_factor(size: int, directions: int, chance: float = _CHANCE, states: int = 1) -> float:
    """Return by what the largest of some differences bounds an operator norm.

    For directions drawn anew, uniformly from a sphere, the norm is at most this many times the
    largest difference over the step, except with a small probability. Nothing trained on these
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
    return math.sqrt(2 * size / math.pi) * (states / chance) ** (1 / directions)


def errors_of(
    student: Policy,
    expert: Expert,
    states: np.ndarray,
    units: np.ndarray,
    scales: Scales,
    random: np.random.Generator,
    held: Sequence[int] = (),
) -> Errors | None:
    """Measure a student's errors at states of its expert's path.

    Args:
        student: (B, n) -> (B, m).
        expert: Counts its rows under "check": four for each coordinate of each state, and more.
        states: (S, n).
        units: (m,) of actions, half their range.
        scales: Of the expert's states.
        random: Draws directions that nothing was trained on.
        held: Coordinates that nothing moves.

    Returns:
        None where the expert has no answer in the neighbourhood of any of the states, and where
        more than 1,000 coordinates move.
    """
    live = scales.probed("whitened") & ~np.isin(np.arange(states.shape[1]), list(held))
    if live.sum() > _MOST or not live.any():
        return None
    axes = np.eye(len(live))[live]
    drawn = random.standard_normal((len(states), _DIRECTIONS, len(live))) * live
    drawn /= np.linalg.norm(drawn, axis=2, keepdims=True)
    # A step of length h along one axis has the root mean square h / sqrt(d).
    root = math.sqrt(len(axes))
    ask = _asked_of_both(student, expert, units)
    here, away, *sides = (
        ask(states + step * root * directions * scales.deviation)
        for step, directions in (
            (0.0, axes[:1, None]),
            (_STEP, np.swapaxes(drawn, 0, 1)),
            *((step, axes[:, None]) for step in (_STEP, -_STEP, _STEP / 2, -_STEP / 2)),
        )
    )
    heard = np.isfinite(np.concatenate([here, away, *sides])).all(axis=(0, 2, 3))
    if not heard.any():
        return None
    here, away, *sides = (answers[:, heard] for answers in (here, away, *sides))
    whole, half = (sides[0] - sides[1]) / (2 * _STEP), (sides[2] - sides[3]) / _STEP
    second = np.linalg.norm(sides[0] + sides[1] - 2 * here, axis=-1).max() / _STEP**2
    spherical = np.linalg.norm(_apart(away) - _apart(here), axis=-1).max() / _STEP
    factor = sphere_factor(len(axes), _DIRECTIONS, states=int(heard.sum()))
    return Errors(
        action=float(np.linalg.norm(_apart(here), axis=-1).max()),
        derivative=_norm(_apart(half)),
        difference=_norm(_apart(half) - _apart(whole)),
        sphere=float(factor * (spherical + _STEP * second)),
        lipschitz=max(_norm(half[..., 0, :]), _norm(half[..., 1, :])),
        curvature=float(second),
    )


def _asked_of_both(
    student: Policy, expert: Expert, units: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of (..., n) observations: (..., 2, m) actions, the student's first."""

    def ask(observations: np.ndarray) -> np.ndarray:
        rows = observations.astype(np.float32).reshape(-1, observations.shape[-1])
        both = np.stack([student(rows), expert.ask(rows, "check")], axis=1) / units
        return both.reshape(*observations.shape[:-1], *both.shape[1:])

    return ask


def _apart(both: np.ndarray) -> np.ndarray:
    return both[..., 0, :] - both[..., 1, :]


def _norm(derivatives: np.ndarray) -> float:
    """(d, S, m) derivatives along coordinates -> the largest operator norm over the states."""
    return float(np.linalg.norm(np.moveaxis(derivatives, 0, 2), ord=2, axis=(1, 2)).max())


def conditions_of(errors: Errors, stability: Stability) -> tuple[Condition, ...]:
    """Return those of TaSIL's statements that are about such a loop; none where no law was found.

    The derivative's error is taken with the error of its differences added, which is what the
    appendix's alpha-hat and eta-hat are for. The constants are lower bounds, measured at a few
    states: a condition that is met here need not be met everywhere.

    Args:
        errors: Of the student on the expert's path.
        stability: Of the expert's loop: gamma(e) = C e^nu, up to the reach of its measurement.
    """
    constant, exponent, reach = stability.constant, stability.exponent, stability.reach
    if constant is None or exponent is None or reach is None:
        return ()
    law = _Law(constant, exponent, reach, errors)
    found = []
    if exponent > 1 + _NEARLY:
        found.append(law.order_zero())
    if exponent > 0.5 + _NEARLY:
        found.append(law.order_one())
    if abs(exponent - 1) <= _NEARLY:
        found += [law.equal_orders(), law.corollary()]
    return (*found, law.solved())


@dataclass(frozen=True)
class _Law:
    """The statements for one law and one student. Names are the paper's."""

    constant: float
    nu: float
    eta: float
    errors: Errors

    @property
    def _derivative(self) -> float:
        return self.errors.derivative + self.errors.difference

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
        return _condition("theorem 3.1, p = 0", asked, bound)

    def order_one(self) -> Condition:
        """Theorem 3.2 with p = 1: gamma(x) <= C x^(1/r), 1 <= r < 2."""
        power = min(self.nu, 1.0)
        mu = 2**power * self.constant
        terms = {"|Delta|": 2 * self.errors.action, "|dDelta|": 2 * self._derivative}
        return self._of_order_one("theorem 3.2, p = 1", mu, power, terms)

    def equal_orders(self) -> Condition:
        """Theorem A with p = r = 1, where a small derivative is asked for and not paid for."""
        mu = 2 * self.constant
        most = ("|dDelta|", self._derivative, 1 / (2 * mu))
        rest = self._of_order_one(
            "theorem A, p = r = 1", mu, 1.0, {"|Delta|": 4 * self.errors.action}
        )
        return _condition(rest.source, (most, *rest.asked), mu * 4 * self.errors.action)

    def _of_order_one(
        self, source: str, mu: float, power: float, terms: dict[str, float]
    ) -> Condition:
        """Return both conditions of theorem 3.2 on the terms (2 / j!) |d^j Delta|."""
        curvature, r = self.errors.curvature, 1 / power
        least = max(curvature * self.constant**r, _LEAST)
        alpha = min(0.5, self.constant, (0.5 / least) ** (1 / (2 - r)))
        bound = max(mu * term**power for term in terms.values())
        largest = max(curvature * (mu * term**power) ** 2 + term for term in terms.values())
        asked = (("distance", bound, alpha), ("disturbance", largest, self.eta))
        return _condition(source, asked, bound)

    def corollary(self) -> Condition:
        """The corollary for gamma(x) = C x and p = 1, with C L >= 1."""
        curvature = max(self.errors.curvature, 1 / self.constant)
        asked = (
            ("|dDelta|", self._derivative, 1 / (4 * self.constant)),
            ("|Delta|", self.errors.action, 1 / (16 * self.constant**2 * curvature)),
            ("disturbance", 8 * self.errors.action, self.eta),
        )
        return _condition("corollary, r = 1", asked, 8 * self.constant * self.errors.action)

    def solved(self) -> Condition:
        """Proposition 3.1 itself, with Delta bounded by its Taylor polynomial and a remainder."""
        most = np.minimum((_STARTS / self.constant) ** (1 / self.nu), self.eta)
        error = self.errors.action + self._derivative * _STARTS
        error += self.errors.curvature * _STARTS**2
        enough = np.flatnonzero(error <= most)
        place = enough[0] if enough.size else int(np.argmin(error / most))
        asked = ((f"error within {_STARTS[place]:.2g}", float(error[place]), float(most[place])),)
        return _condition("proposition 3.1, solved", asked, float(_STARTS[place]))


def _condition(
    source: str, asked: tuple[tuple[str, float, float], ...], bound: float
) -> Condition:
    met = all(measured <= allowed for _, measured, allowed in asked)
    return Condition(source, asked, bound if met else None)
