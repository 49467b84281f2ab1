"""Where episodes are played: in environments in turn, or in some that step together."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import gymnasium
import numpy as np

from fdtasil.rollouts.recording import Recording
from fdtasil.rollouts.spaces import Spaces
from fdtasil.rollouts.vector import Together

__all__ = ["InTurn", "Playing", "SideBySide"]


class Playing(Protocol):
    """Some episodes while they are played.

    Attributes:
        episodes: Their numbers.
    """

    @property
    def episodes(self) -> list[int]: ...  # noqa: D102

    def begin(self) -> np.ndarray:
        """Return the (E, n) first observations."""
        ...

    def step(
        self, alive: Sequence[int], actions: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take a step in the episodes that are alive.

        Args:
            alive: Numbers of the episodes.
            actions: (B, m) as the environment takes them.
            step: Its number.

        Returns:
            (B, n) observations, and (B,) bool, which go on.
        """
        ...


class InTurn:
    """Each episode in an environment of its own.

    Args:
        record: Where they are recorded.
        environments: Number of an episode -> the environment that it is played in.
    """

    def __init__(self, record: Recording, environments: Mapping[int, gymnasium.Env]) -> None:
        self._record, self._environments = record, environments

    @property
    def episodes(self) -> list[int]:
        """Their numbers."""
        return list(self._environments)

    def begin(self) -> np.ndarray:
        """Reset each; see `Playing`."""
        first = [self._record.reset(env, e) for e, env in self._environments.items()]
        return self._record.observed(first, self.episodes, None)

    def step(
        self, alive: Sequence[int], actions: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Step each; see `Playing`."""
        record, after, going = self._record, [], np.ones(len(alive), bool)
        for row, episode in enumerate(alive):
            observation, going[row] = record.step(
                self._environments[episode], actions[row], episode, step
            )
            after.append(observation)
        record.check_rewards(alive, step)
        return record.observed(after, alive, step), going


class SideBySide:
    """Each episode in one of some environments that step together; what is left over idles.

    Args:
        record: Where they are recorded.
        together: The environments.
        spaces: Of one of them.
        episodes: Numbers of the episodes, at most as many as there are environments.
    """

    def __init__(
        self, record: Recording, together: Together, spaces: Spaces, episodes: Sequence[int]
    ) -> None:
        self._record, self._together, self._spaces = record, together, spaces
        self._slots = {episode: slot for slot, episode in enumerate(episodes)}
        space, idle = together.action_space, np.zeros(spaces.actions.size)
        if spaces.actions.plain and isinstance(space, gymnasium.spaces.Box):
            idle = np.clip(idle, space.low, space.high)
        self._idle = idle

    @property
    def episodes(self) -> list[int]:
        """Their numbers."""
        return list(self._slots)

    def begin(self) -> np.ndarray:
        """Reset all at once; see `Playing`."""
        record, first = self._record, self.episodes[0]
        seeds = [record.seed(episode) for episode in self.episodes]
        # Those left over need seeds as well.
        seeds += [seeds[-1] + 1 + extra for extra in range(self._together.count - len(seeds))]
        with record.blames(first, None, "reset()"):
            observations = self._together.reset(seeds, record.options)
        return self._observed(observations, self.episodes, None)

    def step(
        self, alive: Sequence[int], actions: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Step all at once; see `Playing`."""
        record, slots = self._record, [self._slots[episode] for episode in alive]
        rows = np.tile(self._idle, (self._together.count, 1)).astype(actions.dtype)
        rows[slots] = actions
        layout = self._spaces.actions
        with record.blames(alive[0], step, "step()"):
            found = self._together.step(rows if layout.plain else layout.values(rows))
        over = found.terminated | found.truncated
        now = (part[slots] for part in (found.rewards, found.terminated, found.reset))
        record.note(alive, step, *now)
        record.check_rewards(alive, step)
        return self._observed(found.observations, alive, step), ~over[slots]

    def _observed(self, observations: Any, alive: Sequence[int], step: int | None) -> np.ndarray:
        with self._record.blames(alive[0], step, "the vector environment"):
            rows = self._spaces.observations.rows(observations)
        return self._record.observed(rows[[self._slots[e] for e in alive]], alive, step)
