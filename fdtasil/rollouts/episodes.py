"""Recorded episodes, and what nothing can be learnt from."""

from dataclasses import dataclass

import numpy as np

from fdtasil.errors import EnvironmentFault

__all__ = ["Episodes", "check_episodes"]


@dataclass(frozen=True)
class Episodes:
    """Recorded episodes: one slot of each array is one episode, padded with zeros.

    Attributes:
        observations: (E, T, n) float32, what the policy saw.
        actions: (E, T, m) float32, what it said, before clipping to the bounds.
        expert_actions: (E, T, m) float32, the expert's answers that the behaviour had.
        answered: (E, T) bool, where it had one.
        rewards: (E, T) float64.
        valid: (E, T) bool, true up to and including the step that ended the episode.
        seeds: (E,) reset seeds.
        terminated: (E,) bool, true where the environment ended the episode (a fall), false where
            time did.
        clipped_actions: Steps at which an action had to be clipped.
        physics_resets: (E,) number of steps of each episode at which the simulator silently put
            itself back to its start.
        refused: (E, T) bool, where the expert was asked and had no answer.
        given_up: (E,) bool, whether the episode was ended because who acts had none for long.
    """

    observations: np.ndarray
    actions: np.ndarray
    expert_actions: np.ndarray
    answered: np.ndarray
    rewards: np.ndarray
    valid: np.ndarray
    seeds: np.ndarray
    terminated: np.ndarray
    clipped_actions: int
    physics_resets: np.ndarray
    refused: np.ndarray
    given_up: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """(E,) number of steps of each episode."""
        return self.valid.sum(axis=1)

    @property
    def returns(self) -> np.ndarray:
        """(E,) undiscounted sum of rewards of each episode."""
        return self.rewards.sum(axis=1)

    def spread(self, count: int) -> np.ndarray:
        """Return (count, n) of the visited states, evenly spread over all of them in order.

        Where fewer were visited, some are returned several times.
        """
        visited = self.observations[self.valid]
        return visited[np.linspace(0, len(visited) - 1, count).astype(int)]


def check_episodes(episodes: Episodes, name: str) -> None:
    """Refuse an expert's episodes that nothing can be learnt from or judged by.

    Args:
        episodes: (E, T) the expert's.
        name: Of the environment.

    Raises:
        EnvironmentFault: If all end at their first step though T is longer (a single one may
            fall by chance), or the simulator put itself back in more than half of them.
    """
    count, horizon = episodes.valid.shape
    if count > 1 and horizon > 1 and episodes.lengths.max() == 1:
        raise EnvironmentFault(
            f"{name}: all {count} episodes of the expert ended at their first step",
            f"episodes of up to {horizon} steps",
            "check the environment's end, or pass horizon=1 if one step is all there is",
        )
    unstable = int((episodes.physics_resets > 0).sum())
    if unstable > count / 2:
        raise EnvironmentFault(
            f"{name}: the simulation became unstable and reset itself in {unstable} of "
            f"{count} episodes of the expert",
            "physics that last, in at least half of them",
            "check the model's time step and the expert's actions",
        )
