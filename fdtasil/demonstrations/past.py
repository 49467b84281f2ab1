"""Recorded states with another past behind them, for a student that sees more or less of it."""

from dataclasses import replace

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.rollouts.history import Window, past_size
from fdtasil.rollouts.spaces import Layout

__all__ = ["showing"]


def showing(dataset: Dataset, history: int, actions: Layout) -> Dataset:
    """Return a dataset whose observations show so many steps.

    The step before a state is the row before it, if it is of the same episode: where a state was
    left out, for its expert had no answer, stands the one before that.

    Args:
        dataset: Without NaN.
        history: H, how many observations are to be seen, the present one included.
        actions: Of the environment, whose choices are remembered as what was chosen.
    """
    if history == dataset.history:
        return dataset
    states, own, m = dataset.demonstrations, dataset.own_size, dataset.sizes[1]
    stop = states.observations.shape[1] - dataset.remembered
    keep = own + past_size(min(history, dataset.history), own, m)
    wanted = own + past_size(history, own, m)
    seen = states.observations[:, :keep]
    if wanted > keep:
        taken = np.clip(states.taken, dataset.low, dataset.high)
        seen = _with_past(seen[:, :own], taken, states.episode, history, actions)
    rows = np.concatenate([seen, states.observations[:, stop:]], axis=1)
    longer = replace(dataset, demonstrations=replace(states, observations=rows), history=history)
    if dataset.answers is None:
        return longer
    # Probes move nothing of the past.
    moved = dataset.answers.displacements
    still = np.zeros((len(moved), wanted - own), moved.dtype)
    moved = np.concatenate([moved[:, :own], still, moved[:, stop:]], axis=1)
    return replace(longer, answers=replace(dataset.answers, displacements=moved))


def _with_past(
    observations: np.ndarray,
    taken: np.ndarray,
    episode: np.ndarray,
    history: int,
    actions: Layout,
) -> np.ndarray:
    """Return (N, n + past) float32, each state with the steps before it in its episode."""
    window, before = Window(history, observations.shape[1], taken.shape[1]), None
    rows = []
    for seen, done, number in zip(observations, taken, episode, strict=True):
        if number != before:
            window.clear()
        rows.append(window.behind(seen))
        window.push(seen, actions.done(done))
        before = number
    return np.array(rows, np.float32)
