"""The last observations and actions, behind an observation: what a student may be shown."""

from typing import Any

import gymnasium
import numpy as np

from fdtasil.rollouts.spaces import Layout

__all__ = ["Window", "WithHistory", "past_size", "present_size"]


def past_size(history: int, observation_size: int, action_size: int) -> int:
    """Return how many numbers stand behind an observation: those of the steps before it."""
    return (history - 1) * (observation_size + action_size)


def present_size(seen: int, history: int, action_size: int) -> tuple[int, int]:
    """Return how many of the numbers seen are the present observation, and what is left over.

    Of a whole history, n + past_size(history, n, m) numbers, nothing is.
    """
    return divmod(seen - (history - 1) * action_size, history)


class Window:
    """The steps before the present one, the latest first.

    Before the start of an episode there stand its first observation and actions of zeros: zeros
    for observations would be another place than any of 300 kelvin.

    Args:
        history: H, how many observations are seen, the present one included.
        observation_size: n.
        action_size: m.
    """

    def __init__(self, history: int, observation_size: int, action_size: int) -> None:
        self._past = np.zeros((history - 1, observation_size + action_size), np.float64)
        self._size, self._empty = observation_size, True

    def clear(self) -> None:
        """Begin an episode, with the next observation."""
        self._empty = True

    def push(self, observation: np.ndarray, action: np.ndarray) -> None:
        """Remember a step: what was observed, and what was done.

        A number that is none is remembered as the one before it, or it would never be forgotten:
        the answer to it is none either, and is remembered in its turn.
        """
        step = np.concatenate([np.ravel(observation), np.ravel(action)])
        step = np.where(np.isfinite(step), step, self._past[0]) if len(self._past) else step
        self._past[1:] = self._past[:-1].copy()
        self._past[:1] = step

    def behind(self, observation: np.ndarray) -> np.ndarray:
        """Return an observation (n,) with the past behind it."""
        seen = np.asarray(observation, np.float64)
        if self._empty:
            self._past[:, : self._size], self._past[:, self._size :] = seen, 0
            self._empty = not np.isfinite(seen).all()
        return np.append(seen, self._past)


class WithHistory(gymnasium.Wrapper):
    """An environment whose observations have the last observations and actions behind them.

    Args:
        env: The environment; its observations and actions are boxes (n,) and (m,).
        history: H, how many observations are seen.
        layout: Of the actions, whose choices are remembered as what was chosen.
    """

    def __init__(self, env: gymnasium.Env, history: int, layout: Layout) -> None:
        super().__init__(env)
        self._layout = layout
        box, actions = env.observation_space, env.action_space
        assert isinstance(box, gymnasium.spaces.Box), "the pool has looked at its spaces"
        assert isinstance(actions, gymnasium.spaces.Box)
        n, m = box.shape[0], actions.shape[0]
        wide = np.full(past_size(history, n, m), np.inf)
        low, high = np.append(box.low, -wide), np.append(box.high, wide)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        self._window, self._seen = Window(history, n, m), np.zeros(n)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        """Begin with the first observation behind itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._window.clear()
        self._seen = np.array(observation)
        return self._window.behind(self._seen), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Any]:
        """Remember what was observed and done."""
        self._window.push(self._seen, self._layout.done(np.asarray(action)))
        observation, *rest = self.env.step(action)
        self._seen = np.array(observation)
        return self._window.behind(self._seen), *rest  # pyright: ignore[reportReturnType]
