"""An environment of any known spaces as one of two flat boxes."""

from typing import Any

import gymnasium
import numpy as np

from fdtasil.rollouts.spaces import Layout, Spaces

__all__ = ["Flat", "bounds_of", "unbounded"]


class Flat(gymnasium.Wrapper):
    """Takes (m,) actions, of a choice the scores, and gives (n,) observations.

    Args:
        env: The environment.
        spaces: Its spaces.
    """

    def __init__(self, env: gymnasium.Env, spaces: Spaces) -> None:
        super().__init__(env)
        self.spaces = spaces
        self.observation_space = _box(env.observation_space, spaces.observations)
        self.action_space = _box(env.action_space, spaces.actions)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode; what is no (observation, info) is handed on, and refused later."""
        answer = self.env.reset(seed=seed, options=options)
        if not isinstance(answer, tuple) or len(answer) != 2:
            return answer
        return self.spaces.observations.row(answer[0]), answer[1]

    def step(self, action: Any) -> Any:
        """Take a step."""
        answer = self.env.step(self.spaces.actions.value(np.asarray(action)))
        if not isinstance(answer, tuple) or len(answer) != 5:
            return answer
        return self.spaces.observations.row(answer[0]), *answer[1:]


def bounds_of(space: gymnasium.Space, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) lower and upper bounds of a space's flat form; a choice's scores have none."""
    lows, highs = [], []
    for part in layout.parts:
        inner: Any = space
        for key in part.path:
            inner = inner[key]
        wide = np.full(part.size, np.inf)
        low, high = (inner.low, inner.high) if part.kind in ("number", "whole") else (-wide, wide)
        lows.append(np.asarray(low).ravel())
        highs.append(np.asarray(high).ravel())
    return np.concatenate(lows), np.concatenate(highs)


def unbounded(bound: np.ndarray) -> np.ndarray:
    """Return bounds in their own dtype; those as large as float32 itself are a way to say none."""
    wide = bound.astype(np.float64)
    return np.where(np.abs(wide) > 1e30, np.copysign(np.inf, wide), wide).astype(bound.dtype)


def _box(space: gymnasium.Space, layout: Layout) -> gymnasium.spaces.Box:
    low, high = bounds_of(space, layout)
    kind = np.result_type(low, np.float32)
    return gymnasium.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind.type)
