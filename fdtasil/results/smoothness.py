"""How rough the actions of an episode are: what wears a machine out, and returns do not show."""

from typing import NamedTuple

import numpy as np

from fdtasil.probes.scales import action_units
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes

__all__ = ["Smoothness", "smoothness_of"]

_LEAST = 16  # steps of an episode whose spectrum is looked at
_ROUNDING = 1e-20  # of the actions' squares: less about their mean is its rounding


class Smoothness(NamedTuple):
    """How rough actions are.

    Attributes:
        roughness: Mean change of an action from one step to the next: of bounded actions in units
            of half their range, of others of the expert's deviation, of a choice 1 where it
            changes. None where no episode has two steps.
        high_frequency: Share of the power of the actions' changes about their mean that is faster
            than half of the fastest that the time step allows (a period of four steps); None where
            all actions are choices or constant, and for episodes of fewer than 16 steps.
    """

    roughness: float | None
    high_frequency: float | None


def smoothness_of(episodes: Episodes, pool: EnvironmentPool, expert: Episodes) -> Smoothness:
    """Measure the actions of some episodes, as the environment took them.

    Args:
        episodes: Whose actions are measured.
        pool: The environment.
        expert: Whose actions the units are of, where they have no bounds.
    """
    chosen, m = pool.spaces.actions, pool.boxes.action_size
    until = int(episodes.lengths.max(initial=0))  # a horizon may be far beyond what was played
    actions, valid = episodes.actions[:, :until], episodes.valid[:, :until]
    flat, _ = pool.bounds.put_inside(actions.reshape(-1, m))
    acted = flat.reshape(actions.shape).astype(np.float64)
    both = valid[:, 1:] & valid[:, :-1]
    if not both.any():
        return Smoothness(None, None)
    scores = [column for start, end in chosen.choices for column in range(start, end)]
    numbers = np.setdiff1d(np.arange(m), scores)
    taken, _ = pool.bounds.put_inside(expert.actions[expert.valid])
    units = action_units(pool.boxes.low, pool.boxes.high, taken)
    scaled = (acted / units)[:, :, numbers]
    changes = np.abs(np.diff(scaled, axis=1))[both]
    if chosen.choices:
        best = chosen.best(acted.reshape(-1, m)).reshape(*valid.shape, -1)
        other = (best[:, 1:] != best[:, :-1])[both]
        changes = np.concatenate([changes, other], axis=1)
    fast = _high_frequency(scaled, episodes.lengths) if len(numbers) else None
    return Smoothness(float(changes.mean()), fast)


def _high_frequency(actions: np.ndarray, lengths: np.ndarray) -> float | None:
    fast = total = squares = 0.0
    for episode, length in zip(actions, lengths, strict=True):
        if length < _LEAST:
            continue
        mine = episode[:length]
        frequencies = np.fft.rfftfreq(length)
        power = np.abs(np.fft.rfft(mine - mine.mean(axis=0), axis=0)) ** 2
        power[(frequencies > 0) & (frequencies < 0.5)] *= 2  # each stands for its negative too
        power /= length  # its sum is that of the squares: every step counts the same
        fast += float(power[frequencies > 0.25].sum())
        total += float(power.sum())
        squares += float(np.square(mine).sum())
    return fast / total if total > _ROUNDING * squares else None
