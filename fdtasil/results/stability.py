"""How much an expert forgives: its closed loop under small disturbances of its actions, measured.

Incremental input-to-state stability (TaSIL, definition 2.1 and section 3): a loop whose actions
are disturbed by at most e stays within gamma(e) of its undisturbed path. A student is its expert
with the disturbance that is its own error, so its path stays within gamma(largest error on it).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.probes.scales import Scales
from fdtasil.rollouts.behaviours import Behaviour, Decision
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout

__all__ = ["Stability", "distances", "stability_of"]

SIZES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_FAR = 0.3  # deviations: farther apart two paths begin to have nothing to do with each other
_NEAR = 1e-5  # what float32 leaves of a path
_IMPULSE = 1e-2  # size of the disturbance of a single action
_RESAMPLES = 500
_HIGHEST = 9  # order beyond which nobody asks
_NEARLY = 0.05  # of an order: a measured exponent of 0.97 is one


@dataclass(frozen=True)
class Stability:
    """A power law gamma(e) = constant * e ** exponent, fitted to measured deviations.

    Attributes:
        sizes: Of the disturbances, in units of half the range of an action.
        deviations: Largest distance to the undisturbed path, averaged over episodes, in the
            expert's standard deviations (root mean square over coordinates).
        constant: C; None where too few deviations are between rounding and one deviation.
        exponent: nu; None with it. 1 is a loop that forgives in proportion.
        interval: 95 % bootstrap interval of the exponent over episodes.
        reach: Smallest and largest disturbance that the law was fitted to; None with it.
        rate: By what the deviation changes in each step after a single action was disturbed, by a
            fitted exponential; None where it is rounding, or as large as the states vary, at once,
            or where an episode ends.
    """

    sizes: tuple[float, ...]
    deviations: tuple[float, ...]
    constant: float | None
    exponent: float | None
    interval: tuple[float, float] | None
    reach: tuple[float, float] | None = None
    rate: float | None = None

    @property
    def order(self) -> int | None:
        """The least order of the Taylor loss that theorem 3.2 asks for: nu >= 1 / (p + 1)."""
        if self.exponent is None or self.exponent <= 0:
            return None
        needed = math.ceil(1 / min(self.exponent, 1.0) - 1 - _NEARLY)
        return needed if needed <= _HIGHEST else None

    def gamma(self, size: float) -> float | None:
        """Return how far a disturbance of a size leads, by the fitted law."""
        if self.constant is None or self.exponent is None:
            return None
        return self.constant * size**self.exponent


def stability_of(
    expert: Expert,
    own: Episodes,
    pool: EnvironmentPool,
    horizon: int,
    units: np.ndarray,
    scales: Scales,
    noise: Sequence[np.random.Generator],
    sizes: Sequence[float] = SIZES,
) -> Stability:
    """Disturb an expert's actions by a ladder of sizes, from the starts of its own episodes.

    Args:
        expert: Counts its rows under "evaluate".
        own: (E, T) its undisturbed episodes.
        pool: The environment.
        horizon: T.
        units: (m,) of actions, half their range.
        scales: Of its states.
        noise: (E,) draw a direction for each episode, which lasts.
        sizes: Of the disturbances.
    """
    m = len(units)
    normal = np.stack([random.standard_normal(m) for random in noise])
    directions = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    seeds = [int(seed) for seed in own.seeds]

    def followed(size: float, *, lasting: bool) -> np.ndarray:
        # Episodes are told apart by their generators, which are handed to whoever acts.
        marks = [np.random.default_rng(seed) for seed in seeds]
        offsets = dict(zip(map(id, marks), size * directions * units, strict=True))
        episodes = rollout(_disturbed(expert, offsets, lasting), pool, seeds, horizon, marks)
        return _apart(own, episodes, scales)

    measured = np.stack([_farthest(followed(size, lasting=True)) for size in sizes])
    impulse = followed(_IMPULSE, lasting=False)
    means = tuple(float(value) for value in measured.mean(axis=1))
    return Stability(tuple(sizes), means, *_fitted(np.asarray(sizes), measured), _rate(impulse))


def _disturbed(expert: Expert, offsets: Mapping[int, np.ndarray], lasting: bool) -> Behaviour:
    """Return the expert with an offset for each generator, by its id; lasting, or of one step."""
    left = dict(offsets)

    def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
        added = np.stack([left[id(random)] for random in noise])
        if not lasting:
            left.update((id(random), np.zeros_like(added[0])) for random in noise)
        answers = expert.ask(observations, "evaluate") + added
        return Decision(answers.astype(np.float32), None)

    return act


def distances(expert: Episodes, other: Episodes, scales: Scales) -> np.ndarray:
    """Return (E,) the largest distance of two paths while both last, in deviations."""
    return _farthest(_apart(expert, other, scales))


def _farthest(apart: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(apart), 0.0, apart).max(axis=1)


def _apart(expert: Episodes, other: Episodes, scales: Scales) -> np.ndarray:
    """Return (E, T) the distance of two paths, in deviations; NaN where one has ended."""
    both, live = expert.valid & other.valid, scales.live
    apart = (other.observations - expert.observations)[..., live] / scales.deviation[live]
    return np.where(both, np.sqrt((apart.astype(np.float64) ** 2).mean(axis=-1)), np.nan)


def _rate(apart: np.ndarray) -> float | None:
    """Return the factor of a step, from (E, T) distances after the first action was disturbed."""
    means = apart.mean(axis=0)[1:]
    outside = np.flatnonzero(~((means > _NEAR) & (means < _FAR)))
    means = means[: outside[0]] if outside.size else means
    if len(means) < 3:
        return None
    slope, _ = np.polyfit(np.arange(len(means)), np.log(means), 1)
    return float(np.exp(slope))


def _fitted(
    sizes: np.ndarray, measured: np.ndarray
) -> tuple[float | None, float | None, tuple[float, float] | None, tuple[float, float] | None]:
    """Fit a power law to the sizes whose deviations are neither rounding nor chaos."""
    means = measured.mean(axis=1)
    kept = (means > _NEAR) & (means < _FAR)
    if kept.sum() < 3:
        return None, None, None, None
    constant, exponent = _law(sizes[kept], means[kept])
    random, episodes = np.random.default_rng(0), measured.shape[1]
    drawn = [
        _law(sizes[kept], measured[kept][:, random.integers(episodes, size=episodes)].mean(axis=1))
        for _ in range(_RESAMPLES)
    ]
    low, high = np.percentile([law[1] for law in drawn], [2.5, 97.5])
    return (
        constant,
        exponent,
        (float(low), float(high)),
        (float(sizes[kept].min()), float(sizes[kept].max())),
    )


def _law(sizes: np.ndarray, deviations: np.ndarray) -> tuple[float, float]:
    slope, offset = np.polyfit(np.log(sizes), np.log(np.maximum(deviations, 1e-12)), 1)
    return float(np.exp(offset)), float(slope)
