"""The toy environment with other spaces: the same numbers in other forms."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from toy_environments import Integrator


@dataclass(frozen=True)
class Form:
    """A form of observations or actions.

    Attributes:
        space: The space.
        of: Plain numbers (..., n) -> the form, one value or a batch of them.
        back: The form -> plain numbers, where every number is in it.
        held: Names of the parts that no probe moves.
    """

    space: gymnasium.Space
    of: Callable[[np.ndarray], Any]
    back: Callable[[Any], np.ndarray]
    held: tuple[str, ...] = ()


def _box(*shape, dtype=np.float64):
    return Box(-np.inf, np.inf, shape, dtype)


def _join(*parts):
    return np.concatenate(parts, axis=-1)


OBSERVATIONS = {
    "box": Form(_box(5), lambda x: x, lambda x: x),
    "row": Form(
        _box(1, 5), lambda x: x.reshape(*x.shape[:-1], 1, 5), lambda x: x.reshape(*x.shape[:-2], 5)
    ),
    "dictionary": Form(
        Dict(place=_box(2), speed=_box(2), rest=_box(1)),
        lambda x: {"place": x[..., :2], "speed": x[..., 2:4], "rest": x[..., 4:]},
        lambda x: _join(x["place"], x["speed"], x["rest"]),
    ),
    "tuple": Form(
        Tuple((_box(2), _box(3))),
        lambda x: (x[..., :2], x[..., 2:]),
        lambda x: _join(*x),
    ),
    "nested": Form(
        Dict(robot=Dict(a=_box(2), b=Tuple((_box(2),))), goal=_box(1)),
        lambda x: {"robot": {"a": x[..., :2], "b": (x[..., 2:4],)}, "goal": x[..., 4:]},
        lambda x: _join(x["robot"]["a"], x["robot"]["b"][0], x["goal"]),
    ),
    "mixed": Form(
        Dict(
            numbers=_box(5),
            count=Box(0, 9, (2,), np.int32),
            flags=MultiBinary(2),
            gear=Discrete(3, start=1),
        ),
        lambda x: {
            "numbers": x,
            "count": np.clip(np.abs(x[..., :2] * 3), 0, 9).astype(np.int32),
            "flags": (x[..., :2] > 0).astype(np.int8),
            "gear": np.int64(1) + (x[..., 0] > 0),
        },
        lambda x: x["numbers"],
        ("count", "flags", "gear"),
    ),
}

ACTIONS = {
    "box": Form(Box(-1, 1, (2,)), lambda u: u, lambda u: u),
    "column": Form(Box(-1, 1, (2, 1)), lambda u: u[..., None], lambda u: u[..., 0]),
    "dictionary": Form(
        Dict(left=Box(-1, 1, (1,)), right=Box(-1, 1, (1,))),
        lambda u: {"left": u[..., :1], "right": u[..., 1:]},
        lambda u: _join(u["left"], u["right"]),
    ),
    "choice": Form(
        Discrete(4, start=1),
        lambda u: 1 + (u[..., 0] > 0) + 2 * (u[..., 1] > 0),
        lambda u: np.stack([np.where((u - 1) % 2, 1, -1), np.where((u - 1) // 2, 1, -1)], -1),
    ),
    "choices": Form(
        MultiDiscrete([2, 2]), lambda u: (u > 0).astype(int), lambda u: 2.0 * np.asarray(u) - 1
    ),
    "flags": Form(
        MultiBinary(2), lambda u: (u > 0).astype(np.int8), lambda u: 2.0 * np.asarray(u) - 1
    ),
    "shifted": Form(
        MultiDiscrete([2, 2], start=[3, 5]),
        lambda u: (u > 0) + np.array([3, 5]),
        lambda u: 2.0 * (np.asarray(u) - [3, 5]) - 1,
    ),
}


class InForm(Integrator):
    """The toy, whose observations and actions have other forms."""

    def __init__(self, seen="box", done="box", wall=3.0):
        super().__init__(wall)
        self.seen, self.done = OBSERVATIONS[seen], ACTIONS[done]
        self.observation_space, self.action_space = self.seen.space, self.done.space

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        if options:
            self.position[:] = options["at"]
            observation = super()._observe()
        return self.seen.of(observation), info

    def step(self, action):
        assert self.action_space.contains(action), action
        observation, *rest = super().step(np.clip(self.done.back(action), -1, 1))
        return self.seen.of(observation), *rest


def in_form(law, seen="box", done="box"):
    """Return a law on plain numbers as an expert of that environment."""
    given, wanted = OBSERVATIONS[seen], ACTIONS[done]
    return lambda observations: wanted.of(law(given.back(observations)))
