"""Demonstrations: visited states, each with the expert's action."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.experts.silence import check_answered
from fdtasil.rollouts.behaviours import has_none
from fdtasil.rollouts.episodes import Episodes

__all__ = ["Demonstrations", "label"]


@dataclass(frozen=True)
class Demonstrations:
    """Labelled states.

    Attributes:
        observations: (N, n) float32 raw observations.
        actions: (N, m) float32, always the expert's answer, never clipped.
        episode: (N,) int32, the episode that the state was visited in.
        round: (N,) int32, the round that the state was collected in.
        taken: (N, m) float32, the action of whoever acted, before clipping to the bounds.
        rewards: (N,) float64, what the environment gave for it.
        terminated: (N,) bool, whether the environment ended the episode there.
    """

    observations: np.ndarray
    actions: np.ndarray
    episode: np.ndarray
    round: np.ndarray
    taken: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def episodes(self) -> int:
        """How many episodes the states are of."""
        return len(np.unique(self.episode))

    def at(self, rows: np.ndarray) -> "Demonstrations":
        """Return some of the states, given by (N,) bool or by numbers."""
        return Demonstrations(*(part[rows] for part in vars(self).values()))

    @staticmethod
    def joined(parts: "Sequence[Demonstrations]") -> "Demonstrations":
        """Return the states of all parts, of which there is at least one."""
        fields = zip(*(vars(part).values() for part in parts), strict=True)
        return Demonstrations(*map(np.concatenate, fields))

    def __add__(self, other: "Demonstrations") -> "Demonstrations":
        return Demonstrations.joined([self, other])


def label(episodes: Episodes, expert: Expert, first_episode: int, round_: int) -> Demonstrations:
    """Label the visited states with the expert's actions; those without an answer are left out.

    The expert is asked only where the behaviour did not ask it already.

    Args:
        episodes: What was recorded.
        expert: Who labels.
        first_episode: Number of the first of these episodes in the run.
        round_: Number of the round.

    Raises:
        SettingError: If no state was visited.
        ExpertError: If the expert has no answer at most of them.
    """
    valid = episodes.valid
    observations = episodes.observations[valid]
    if not len(observations):
        raise SettingError("no state was recorded", "at least one episode", "raise episodes=")
    actions = episodes.expert_actions[valid]
    unknown = ~episodes.answered[valid] & ~episodes.refused[valid]
    if unknown.any():
        actions[unknown] = expert.ask(observations[unknown], "label")
    numbers = np.arange(first_episode, first_episode + len(valid), dtype=np.int32)
    episode = np.broadcast_to(numbers[:, None], valid.shape)[valid]
    rounds = np.full(len(episode), round_, np.int32)
    taken, rewards = episodes.actions[valid], episodes.rewards[valid]
    last = np.arange(valid.shape[1]) == episodes.lengths[:, None] - 1
    terminated = (last & episodes.terminated[:, None])[valid]
    whole = Demonstrations(observations, actions, episode, rounds, taken, rewards, terminated)
    none = has_none(actions)
    if not none.any():
        return whole
    check_answered(expert.name, expert.silence, int(none.sum()), len(none), "visited states")
    kept = whole.at(~none)
    # Where the last state is left out, the one before it is where the episode ended.
    ended = np.unique(whole.episode[whole.terminated])
    last = np.append(kept.episode[1:] != kept.episode[:-1], True)
    return replace(kept, terminated=last & np.isin(kept.episode, ended))
