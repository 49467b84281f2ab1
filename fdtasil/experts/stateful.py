"""Objects whose `predict` takes a state and returns the next one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.experts.memory import Memory, begins_elsewhere, other_beginning, stateless
from fdtasil.rollouts.spaces import Layout

__all__ = ["with_state"]


def with_state(
    source: Any,
    name: str,
    options: Mapping[str, bool],
    statistics: Any,
    observation_size: int,
    layout: Layout | None = None,
) -> Expert | None:
    """Return an object with a memory as an expert, or None where it has none.

    Args:
        source: Has `predict(observation, state, episode_start)`.
        name: What to call it.
        options: What `predict` is called with besides.
        statistics: The VecNormalize that it was trained in, or None.
        observation_size: n.
        layout: Of observations that it takes in parts; None where they are flat rows.

    Raises:
        ExpertError: If its memory does not begin with zeros.
    """
    try:
        nothing = [np.zeros((rows, observation_size), np.float32) for rows in (2, 3)]
        asked = ((_in_parts(rows, layout), len(rows)) for rows in nothing)
        states = [_ask_first(source, *rows, options) for rows in asked]
    except Exception:  # of the user's; the gate will show it
        return None
    if any(state is None for state in states) or len({len(_leaves(one)) for one in states}) > 1:
        return None
    axes = [_axis(*parts) for parts in zip(*map(_leaves, states), strict=True)]
    if None in axes:  # no memory of rows
        return None
    places = tuple(axis or 0 for axis in axes)
    step = _Carries(source, statistics, options, layout, states[0], places)
    n, size = observation_size, _flat(_leaves(states[0]), step.axes).shape[1]
    memory = Memory(size, step, step.begin)
    some = np.random.default_rng(0).standard_normal((2, n)).astype(np.float32)
    try:
        elsewhere = begins_elsewhere(memory, some)  # and where episodes begin, again
    except Exception:  # of the user's: these are no observations of anything
        elsewhere = False
    if elsewhere:
        raise other_beginning(name)
    return Expert(stateless(step, n), name, n + size, memory=memory)


def _in_parts(rows: np.ndarray, layout: Layout | None) -> Any:
    return rows if layout is None else layout.values(rows)


def _ask_first(source: Any, observations: Any, rows: int, options: Mapping[str, bool]) -> Any:
    answer = source.predict(observations, episode_start=np.ones(rows, bool), **options)
    return answer[1] if isinstance(answer, tuple) and len(answer) == 2 else None


def _leaves(state: Any) -> list[np.ndarray]:
    """Return the arrays of a state: one, or a tuple or dictionary of them."""
    if isinstance(state, Mapping):  # by name: in which order they come says nothing
        state = tuple(state[name] for name in sorted(state))
    return [np.asarray(part) for part in (state if isinstance(state, tuple | list) else (state,))]


def _state_of(parts: list[np.ndarray], like: Any) -> Any:
    """Return arrays as a state of the same kind, from which `_leaves` returns them."""
    if isinstance(like, Mapping):
        return dict(zip(sorted(like), parts, strict=True))
    return tuple(parts) if isinstance(like, tuple | list) else parts[0]


def _axis(two: np.ndarray, three: np.ndarray) -> int | None:
    """Return which axis of a part is that of rows, from parts for two rows and for three."""
    if two.ndim != three.ndim:
        return None
    axes = (axis for axis in range(two.ndim) if (two.shape[axis], three.shape[axis]) == (2, 3))
    return next(axes, None)


def _flat(parts: list[np.ndarray], axes: tuple[int, ...]) -> np.ndarray:
    """Return (B, k) of the parts of a state."""
    moved = [np.moveaxis(part, axis, 0) for part, axis in zip(parts, axes, strict=True)]
    return np.concatenate([part.reshape(len(part), -1) for part in moved], 1).astype(np.float32)


@dataclass(frozen=True)
class _Carries:
    """An object's `predict`, with its state as one vector a row.

    Attributes:
        source: Has `predict(observation, state, episode_start)`.
        statistics: The VecNormalize that it was trained in, or None.
        options: What `predict` is called with besides.
        layout: Of observations that it takes in parts, or None.
        like: A state, for the kinds and shapes of its parts.
        axes: Of rows, in each part of a state.
    """

    source: Any
    statistics: Any
    options: Mapping[str, bool]
    layout: Layout | None
    like: Any
    axes: tuple[int, ...]

    def __call__(
        self, observations: np.ndarray, memories: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        rows, parts, start = len(observations), [], 0
        for part, axis in zip(_leaves(self.like), self.axes, strict=True):
            shape = np.moveaxis(part, axis, 0).shape[1:]
            stop = start + int(np.prod(shape))
            moved = memories[:, start:stop].reshape(rows, *shape).astype(part.dtype)
            parts.append(np.ascontiguousarray(np.moveaxis(moved, 0, axis)))
            start = stop
        begun, state = np.zeros(rows, bool), _state_of(parts, self.like)
        actions, after = self.source.predict(
            self._given(observations), state=state, episode_start=begun, **self.options
        )
        return actions, _flat(_leaves(after), self.axes)

    def begin(self, observations: np.ndarray) -> np.ndarray:
        """(B, n) -> (B, m), its first answers of episodes."""
        begun = np.ones(len(observations), bool)
        return self.source.predict(self._given(observations), episode_start=begun, **self.options)[
            0
        ]

    def _given(self, observations: np.ndarray) -> Any:
        given = _in_parts(observations, self.layout)
        return given if self.statistics is None else self.statistics.normalize_obs(given)
