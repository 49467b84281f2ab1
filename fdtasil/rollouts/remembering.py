"""An environment that shows what somebody would remember, behind its own observation."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

__all__ = ["Remembering"]


class Remembering(gymnasium.Wrapper):
    """Carries a memory along each episode, whoever acts.

    Args:
        env: The environment; its observations are boxes (n,).
        after: Observation (n,) and memory (k,) -> the memory after it.
        size: k.
    """

    def __init__(
        self, env: gymnasium.Env, after: Callable[[np.ndarray, np.ndarray], np.ndarray], size: int
    ) -> None:
        super().__init__(env)
        box, wide = env.observation_space, np.full(size, np.inf)
        assert isinstance(box, gymnasium.spaces.Box), "the pool has looked at its spaces"
        low, high = np.append(box.low, -wide), np.append(box.high, wide)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        self._after, self._size = after, size
        self._seen, self._memory = np.zeros(0), np.zeros(size, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        """Begin with zeros."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._memory = np.zeros(self._size, np.float32)
        return self._joined(observation), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Any]:
        """Remember the observation that was acted on."""
        self._memory = np.asarray(self._after(self._seen, self._memory), np.float32)
        observation, *rest = self.env.step(action)
        return self._joined(observation), *rest  # pyright: ignore[reportReturnType]

    def _joined(self, observation: Any) -> np.ndarray:
        self._seen = np.array(observation, np.float32)
        return np.append(np.asarray(observation, np.float64), self._memory)
