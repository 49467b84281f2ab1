"""How much an expert forgives: its closed loop under small disturbances of its actions, measured.

Incremental input-to-state stability (TaSIL, definition 2.1 and section 3): a loop whose actions
are disturbed by at most e stays within gamma(e) of its undisturbed path. A student is its expert
with the disturbance that is its own error, so its path stays within gamma(largest error on it).

gamma is about every disturbance from every start. What is measured is a few of them: it is a lower
estimate of gamma, and no bound.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.probes.scales import Scales
from fdtasil.rollouts.behaviours import Decision, silent_rows
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout

__all__ = ["NEARLY", "Law", "Stability", "distances", "stability_of"]

SIZES = tuple(float(f"{size:.1g}") for size in np.geomspace(1e-6, 10**0.5, 14))
_FAR = 0.3  # deviations: farther apart two paths begin to have nothing to do with each other
_NEAR = 1e-5  # what float32 leaves of a path, at least
_ROUNDINGS = 8  # of the observations: what is as small is not measured
_IMPULSE = 1e-2  # size of the disturbance of a single action
_FEWEST = 4  # sizes that a law is fitted to
_ABOVE = 2.0  # times as much as was measured, a law may say
_SETTLED = 0.9  # of the largest distance is reached in the first half of the steps
_EPISODES = 5  # fewer say nothing of an interval
_HIGHEST = 9  # order beyond which nobody asks
NEARLY = 0.05
"""Of an exponent: a measured 0.97 is 1."""


@dataclass(frozen=True)
class Law:
    """A power law gamma(e) = constant * e ** exponent that covers all measured deviations.

    Attributes:
        constant: C, the least that covers them.
        exponent: nu, mean over episodes. 1 is a loop that forgives in proportion.
        reach: Smallest and largest disturbance that it was fitted to.
        constants: The least and the largest C that single episodes ask for.
        interval: 95 % interval of the exponent, by Student's t over episodes; None of fewer than
            five.
        settled: Whether paths had stopped to move apart: at least 90 % of their largest distance
            was reached in the first half of the steps. If not, the law is of these steps alone:
            while a small deviation still grows, every smooth loop forgives in proportion.
    """

    constant: float
    exponent: float
    reach: tuple[float, float]
    constants: tuple[float, float]
    interval: tuple[float, float] | None
    settled: bool

    @property
    def order(self) -> int | None:
        """The least order of the Taylor loss that has a theorem for this exponent.

        Theorem 3.1 is for nu > 1 and order 0, theorem 3.2 for order p >= 1 and nu > 1 / (p + 1).
        None beyond 9, and for a law that has not settled.
        """
        return _order_of(self.exponent) if self.settled else None

    def gamma(self, size: float) -> float:
        """Return how far a disturbance of a size leads: beyond `reach`, an extrapolation.

        What one smaller than was measured leads to is what the smallest does, at most.
        """
        return self.constant * max(size, self.reach[0]) ** self.exponent

    def __str__(self) -> str:
        low, high = self.constants
        text = f"gamma(e) = {self.constant:.2g} * e^{self.exponent:.2f}"
        if self.interval is not None:
            text += f" [{self.interval[0]:.2f}, {self.interval[1]:.2f}]"
        text += f", e from {self.reach[0]:.1g} to {self.reach[1]:.1g}"
        text += f" (single episodes: {low:.2g} to {high:.2g})"
        if not self.settled:
            return f"{text}; deviations still grow: a law of these steps, that asks for no order"
        ends = [_order_of(nu) for nu in sorted({self.exponent, *(self.interval or ())})]
        named = ["above 9" if order is None else str(order) for order in (ends[-1], ends[0])]
        return f"{text}; order that the theorems ask for: {' to '.join(dict.fromkeys(named))}"


def _order_of(exponent: float) -> int | None:
    if exponent > 1 + NEARLY:
        return 0
    if exponent <= 1 / (_HIGHEST + 1):
        return None
    return max(1, math.floor(1 / exponent - 1) + 1)


@dataclass(frozen=True)
class Stability:
    """What became of disturbances of an expert's actions.

    Attributes:
        sizes: Of the disturbances, the largest that the environment took, in units of half the
            range of an action, or of the expert's deviation where it has none.
        deviations: Largest distance to the undisturbed path, over episodes and disturbances, in
            the expert's standard deviations (root mean square over the coordinates that move),
            while both paths last.
        ended: How many of the disturbed episodes ended before the undisturbed: what would have
            become of them is not known, and no law is fitted there.
        law: Fitted to the most sizes in a row that one holds for; None where fewer than four are
            between rounding and 0.3 deviations, or follow no power law.
        rate: By what the deviation changes in each step after a single action was disturbed, by
            fitted exponentials, mean over episodes; None where it is rounding, or as large as the
            states vary, at once, or where an episode ends.
        rate_interval: 95 % interval of the rate, as the law's; None with it, or of fewer than
            five episodes.
    """

    sizes: tuple[float, ...]
    deviations: tuple[float, ...]
    ended: tuple[int, ...]
    law: Law | None
    rate: float | None = None
    rate_interval: tuple[float, float] | None = None

    def reached(self, size: float) -> float | None:
        """Return how far disturbances led that were as large, the next larger size included.

        None where no larger one was tried.
        """
        larger = np.flatnonzero(np.asarray(self.sizes) >= size)
        return max(self.deviations[: larger[0] + 1]) if larger.size else None


def stability_of(
    expert: Expert,
    own: Episodes,
    pool: EnvironmentPool,
    horizon: int,
    units: np.ndarray,
    scales: Scales,
    seeds: Sequence[int],
    sizes: Sequence[float] = SIZES,
) -> Stability:
    """Disturb an expert's actions by a ladder of sizes, from the starts of its own episodes.

    Each size twice: in a direction that lasts, and in a new one at each step. Where a bound is in
    the way of a component, it goes to the other side.

    Args:
        expert: Counts its rows under "evaluate".
        own: (E, T) its undisturbed episodes.
        pool: The environment.
        horizon: T.
        units: (m,) of actions, from `action_units`.
        scales: Of its states.
        seeds: (E,) of the directions of each episode, the same for every size.
        sizes: Of the disturbances.
    """

    def followed(size: float, kind: _Kind) -> tuple[float, np.ndarray, np.ndarray]:
        behaviour = _Disturbed(expert, pool, units, size, kind)
        noise = [np.random.default_rng(seed) for seed in seeds]
        starts = [int(seed) for seed in own.seeds]
        episodes = rollout(behaviour, pool, starts, horizon, noise)
        ended = episodes.lengths < own.lengths
        return behaviour.taken, _apart(own, episodes, scales), ended

    first_half = np.arange(horizon) < (own.lengths[:, None] + 1) // 2
    taken, measured, early, ended = [], [], [], []
    for size in sizes:
        found = [followed(size, kind) for kind in ("lasting", "changing")]
        taken.append(max(most for most, *_ in found))
        apart = np.stack([paths for _, paths, _ in found])
        ended.append(sum(int(over.sum()) for *_, over in found))
        measured.append(_farthest(apart).max(axis=0))
        early.append(_farthest(np.where(first_half, apart, np.nan)).max(axis=0))
    reached, least = np.stack(measured), _least(own, scales)
    whole = np.asarray(ended) == 0
    law = _law_of(np.asarray(taken), reached, np.stack(early), whole, least)
    rate = _rate(followed(_IMPULSE, "single")[1], least)
    largest = tuple(map(float, reached.max(axis=1)))
    return Stability(tuple(taken), largest, tuple(ended), law, *rate)


_Kind = Literal["lasting", "changing", "single"]


class _Disturbed:
    """An expert whose actions are disturbed.

    In a direction that lasts, in a new one at each step, or at the first step alone.

    Attributes:
        taken: The largest disturbance so far, as the environment took it, in units of actions.
    """

    def __init__(
        self,
        expert: Expert,
        pool: EnvironmentPool,
        units: np.ndarray,
        size: float,
        kind: _Kind,
    ) -> None:
        self.taken = 0.0
        self._expert, self._inside, self._kind = expert, pool.bounds.put_inside, kind
        self._units, self._size = units, size
        self._first: dict[np.random.Generator, np.ndarray] = {}  # one generator, one episode

    def __call__(self, observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
        answers = self._expert.ask(observations, "evaluate")
        undisturbed = np.asarray(self._inside(answers)[0], np.float64)
        added = self._size * self._units * np.stack([self._direction(random) for random in noise])
        ends = [(undisturbed + side * added).astype(np.float32) for side in (1, -1)]
        clipped = [self._inside(end)[0] != end for end in ends]
        moved = np.where(clipped[0] & ~clipped[1], ends[1], ends[0])
        taken = (self._inside(moved)[0] - undisturbed) / self._units
        sizes = np.linalg.norm(taken, axis=1)
        self.taken = max(self.taken, float(np.max(sizes, where=~np.isnan(sizes), initial=0.0)))
        return Decision(moved, None, silent_rows(moved))

    def _direction(self, random: np.random.Generator) -> np.ndarray:
        if self._kind != "changing" and random in self._first:
            return self._first[random] * (self._kind == "lasting")
        normal = random.standard_normal(len(self._units))
        self._first[random] = normal / np.linalg.norm(normal)
        return self._first[random]


def distances(expert: Episodes, other: Episodes, scales: Scales) -> np.ndarray:
    """Return (E,) the largest distance of two paths while both last, in deviations."""
    return _farthest(_apart(expert, other, scales))


def _apart(expert: Episodes, other: Episodes, scales: Scales) -> np.ndarray:
    """Return (E, T) the distance of two paths, in deviations; NaN where one has ended."""
    both, live = expert.valid & other.valid, scales.live
    until = int(both.sum(axis=1).max(initial=0))  # a horizon may be far beyond what was played
    theirs, ours = (one.observations[:, :until][..., live] for one in (expert, other))
    apart = ((ours - theirs) / scales.deviation[live]).astype(np.float64)
    found = np.full(both.shape, np.nan)
    found[:, :until] = np.sqrt((apart**2).mean(axis=-1))
    return np.where(both, found, np.nan)


def _farthest(apart: np.ndarray) -> np.ndarray:
    """(..., T) distances -> the largest over time, while there are any."""
    return np.max(apart, axis=-1, where=~np.isnan(apart), initial=0.0)


def _least(own: Episodes, scales: Scales) -> float:
    """Return the least distance that is no rounding of the observations, in deviations."""
    live = scales.live
    largest = np.abs(own.observations[own.valid][:, live]).max(axis=0)
    rounding = np.finfo(np.float32).eps / 2 * largest / scales.deviation[live]
    return max(_NEAR, _ROUNDINGS * float(np.sqrt((rounding**2).mean())))


def _rate(apart: np.ndarray, least: float) -> tuple[float | None, tuple[float, float] | None]:
    """Return the factor of a step and its interval, from (E, T) distances after a single one."""
    means = apart.mean(axis=0)[1:]
    outside = np.flatnonzero(~((means > least) & (means < _FAR)))
    count = outside[0] if outside.size else len(means)
    if count < 3:
        return None, None
    steps = np.arange(count)
    each = np.log(np.maximum(apart[:, 1 : count + 1], least))
    slopes = np.polyfit(steps, each.T, 1)[0]
    between = _interval(slopes)
    return math.exp(slopes.mean()), between and (math.exp(between[0]), math.exp(between[1]))


def _interval(values: np.ndarray) -> tuple[float, float] | None:
    """Return the 95 % interval of a mean over episodes; None of too few."""
    if len(values) < _EPISODES:
        return None
    from scipy import stats  # loads for most of a second

    reach = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return float(values.mean() - reach), float(values.mean() + reach)


def _law_of(
    sizes: np.ndarray, measured: np.ndarray, early: np.ndarray, whole: np.ndarray, least: float
) -> Law | None:
    """Return the law of the most sizes in a row that follow one; of as many, the largest.

    Args:
        sizes: (K,) of the disturbances.
        measured: (K, E) largest distances.
        early: (K, E) the same in the first half of the steps.
        whole: (K,) whether no episode ended early.
        least: Distance that is no rounding.
    """
    largest = measured.max(axis=1)
    inside = (largest > least) & (largest < _FAR) & whole
    for count in range(len(sizes), _FEWEST - 1, -1):
        for start in range(len(sizes) - count, -1, -1):
            chosen = slice(start, start + count)
            if inside[chosen].all() and (np.diff(sizes[chosen]) > 0).all():
                found = _fitted(sizes[chosen], np.maximum(measured[chosen], least))
                if found is not None:
                    reached = early[chosen].max(axis=1) / largest[chosen]
                    return replace(found, settled=bool(reached.min() >= _SETTLED))
    return None


def _fitted(sizes: np.ndarray, measured: np.ndarray) -> Law | None:
    """Fit a law to all of some sizes; None where they follow none."""
    slopes = np.polyfit(np.log(sizes), np.log(measured), 1)[0]
    exponent = float(slopes.mean())
    asked = (measured / sizes[:, None] ** exponent).max(axis=0)
    constant = float(asked.max())
    above = constant * sizes**exponent / measured.max(axis=1)
    if exponent <= 0 or above.max() > _ABOVE:
        return None
    return Law(
        constant,
        exponent,
        (float(sizes[0]), float(sizes[-1])),
        (float(asked.min()), constant),
        _interval(slopes),
        settled=False,
    )
