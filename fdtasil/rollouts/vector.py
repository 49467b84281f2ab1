"""Environments that step together: gymnasium's vector environments, and stable-baselines3's."""

import importlib
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np

from fdtasil.errors import EnvironmentFault, warn
from fdtasil.rollouts.spaces import to_numpy

__all__ = ["Together", "TogetherStep", "make_vector", "vector_of"]


class TogetherStep(NamedTuple):
    """What a step of all of them came to.

    Attributes:
        observations: Of all of them, as the environment gives them.
        rewards: (N,).
        terminated: (N,) bool.
        truncated: (N,) bool.
    """

    observations: Any
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray


class Together(Protocol):
    """N environments that are reset and stepped at once.

    One whose episode is over goes on with another of its own, which nobody looks at.

    Attributes:
        count: N.
        observation_space: Of one of them.
        action_space: Of one of them.
        name: What messages call it.
        time_limit: Steps after which it ends an episode itself, or None.
    """

    count: int
    observation_space: gymnasium.Space
    action_space: gymnasium.Space
    name: str
    time_limit: int | None

    def reset(self, seeds: Sequence[int], options: Any) -> Any:
        """Begin N episodes; return their observations."""
        ...

    def step(self, actions: Any) -> TogetherStep:
        """Take a step in each."""
        ...

    def close(self) -> None:
        """Close them."""
        ...


def vector_of(made: object) -> Together | None:
    """Return what steps together, or None for an environment that steps alone.

    Raises:
        EnvironmentFault: If it normalises observations or rewards as it goes.
    """
    if isinstance(made, gymnasium.vector.VectorEnv):
        return _Gymnasium(made)
    # Not imported for it: whoever has such an environment has imported its library.
    library = sys.modules.get("stable_baselines3.common.vec_env")
    return _Sb3(made) if library is not None and isinstance(made, library.VecEnv) else None


class _Gymnasium:
    """A vector environment of gymnasium, in any of its three modes of reset."""

    def __init__(self, env: Any) -> None:
        _check_layers(env, "env")
        self._env, self.count = env, int(env.num_envs)
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        spec = env.spec or _spec_of(env)
        self.name = spec.id if spec else type(env.unwrapped).__name__
        self.time_limit = _least(spec.max_episode_steps if spec else None, _own_limit(env))
        modes = gymnasium.vector.AutoresetMode
        # What takes no mask and says no mode begins anew by itself.
        self._waits = env.metadata.get("autoreset_mode") == modes.DISABLED
        self._over = np.zeros(self.count, bool)
        self._options: dict[str, Any] = {}
        self._each, self._like = True, None

    def reset(self, seeds: Sequence[int], options: Any) -> Any:
        self._over[:], self._options = False, dict(options or {})
        observations = self._reset(list(seeds), options)
        leaf = observations
        while isinstance(leaf, dict | tuple):
            leaf = next(iter(leaf.values() if isinstance(leaf, dict) else leaf))
        self._like = leaf if hasattr(leaf, "detach") else None
        return observations

    def step(self, actions: Any) -> TogetherStep:
        if self._waits and self._over.any():
            self._env.reset(options={**self._options, "reset_mask": self._over.copy()})
        if self._like is not None:
            import torch

            actions = torch.as_tensor(actions).to(self._like.device)
        observations, rewards, terminated, truncated, _ = self._env.step(actions)
        parts = TogetherStep(observations, *map(to_numpy, (rewards, terminated, truncated)))
        self._over = np.logical_or(parts.terminated, parts.truncated)
        return parts

    def close(self) -> None:
        self._env.close()

    def _reset(self, seeds: list[int], options: Any) -> Any:
        if self._each:
            with suppress(Exception):  # each has its own for seeds that it does not take
                return self._env.reset(seed=seeds, options=options)[0]
            one = self._env.reset(seed=seeds[0], options=options)[0]
            self._each = False
            warn(
                f"{self.name} takes one seed for all of its {self.count} environments, so an "
                "episode depends on the ones beside it"
            )
            return one
        return self._env.reset(seed=seeds[0], options=options)[0]


class _Sb3:
    """A vectorised environment of stable-baselines3."""

    def __init__(self, env: Any) -> None:
        _check_layers(env, "venv")
        self._env, self.count = env, int(env.num_envs)
        self.observation_space, self.action_space = env.observation_space, env.action_space
        spec = _spec_of(env)
        self.name = spec.id if spec else type(env.unwrapped).__name__
        self.time_limit = spec.max_episode_steps if spec else None
        self._innermost = env
        while hasattr(self._innermost, "venv"):
            self._innermost = self._innermost.venv

    def reset(self, seeds: Sequence[int], options: Any) -> Any:
        # Its own seed() takes one for all; each environment's is what it hands on.
        self._innermost._seeds = list(seeds)
        if options is not None:
            self._innermost.set_options(options)
        return self._env.reset()

    def step(self, actions: Any) -> TogetherStep:
        observations, rewards, done, infos = self._env.step(actions)
        late = np.array([bool(info.get("TimeLimit.truncated", False)) for info in infos])
        over = np.asarray(done, bool)
        return TogetherStep(
            observations, np.asarray(rewards, np.float64), over & ~late, over & late
        )

    def close(self) -> None:
        self._env.close()


_NORMALISERS = ("NormalizeObservation", "NormalizeReward", "VecNormalize")


def _check_layers(env: Any, inner: str) -> None:
    layer = env
    while layer is not None:
        kind = type(layer).__name__
        if kind in _NORMALISERS:
            raise EnvironmentFault(
                f"the environment is inside {kind}, which changes with what it has seen",
                "one that gives what it observes, and an expert that normalises by itself",
                f"pass what is inside (its .{inner}); an agent that was trained so keeps its "
                "statistics: pass the agent itself, or what `fdtasil export-sb3 --vecnormalize` "
                "makes of its zip",
            )
        layer = vars(layer).get(inner)


def _spec_of(env: Any) -> Any:
    """Return what the first of the environments was made by, or None where they don't say."""
    with suppress(Exception):  # each library has its own for what is not there
        return env.get_attr("spec")[0]
    return None


def _own_limit(env: gymnasium.vector.VectorEnv) -> int | None:
    """Return the limit of environments that say it as simulators of many do, or None."""
    found = getattr(env.unwrapped, "max_episode_length", None)
    return int(found) if isinstance(found, int | float) and found > 0 else None


def _least(*limits: int | None) -> int | None:
    return min((limit for limit in limits if limit), default=None)


def make_vector(name: str, count: int, kwargs: dict[str, Any]) -> gymnasium.vector.VectorEnv:
    """Make N environments in processes of their own; "module:Id" imports the module first."""
    module, colon, _ = name.partition(":")
    if colon:
        importlib.import_module(module)
    return gymnasium.make_vec(name, count, vectorization_mode="async", **kwargs)
