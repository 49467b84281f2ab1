"""Means that one bad seed does not rule, and how sure they are."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from scipy import stats

__all__ = [
    "difference_text",
    "interquartile_mean",
    "interval",
    "interval_text",
    "paired_difference",
]

_RESAMPLES = 2000
_trimmed_mean = partial(stats.trim_mean, proportiontocut=0.25)


def interquartile_mean(values: Sequence[float]) -> float:
    """Return the mean of the middle half of the values."""
    return float(_trimmed_mean(values))


def interval(
    values: Sequence[float], statistic: Callable[..., np.ndarray] = _trimmed_mean
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a statistic over seeds.

    It is a little narrow: of five normal seeds' interquartile mean it covers 90 %.

    A single value, or equal ones, give an interval of no width: they say nothing of the spread.

    Args:
        values: One for each seed.
        statistic: Takes an array and `axis`; the interquartile mean if none is given.
    """
    sample = np.asarray(values, float)  # None becomes NaN
    if not np.isfinite(sample).all():
        raise ValueError(f"{sample}: a mean of what is no number says nothing")
    if len(sample) < 2 or np.ptp(sample) == 0:
        return float(sample[0]), float(sample[0])
    found = stats.bootstrap(
        (sample,),
        statistic,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    low, high = found.confidence_interval
    return float(low), float(high)


def interval_text(values: Sequence[float], digits: int = 2) -> str:
    """Return the interquartile mean and its interval, as tables show them."""
    low, high = interval(values)
    return f"{interquartile_mean(values):.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def paired_difference(
    ours: Mapping[int, float], theirs: Mapping[int, float]
) -> tuple[float, tuple[float, float]]:
    """Return the mean of ours - theirs over the seeds that both have, and its 95 % interval."""
    seeds = sorted(ours.keys() & theirs.keys())
    differences = np.array([ours[seed] - theirs[seed] for seed in seeds])
    if len(differences) < 2:
        raise ValueError(f"{len(differences)} seeds in common, a difference needs two")
    error = differences.std(ddof=1) / len(differences) ** 0.5
    reach = float(stats.t.ppf(0.975, len(differences) - 1) * error)
    mean = float(differences.mean())
    return mean, (mean - reach, mean + reach)


def difference_text(mean: float, interval: tuple[float, float], digits: int = 2) -> str:
    """Return a difference and its interval, as tables show them."""
    low, high = interval
    return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
