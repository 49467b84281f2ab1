"""Environments that step together: gymnasium's vector environments, and stable-baselines3's."""

import importlib
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np

from fdtasil.errors import EnvironmentFault, warn
from fdtasil.rollouts.physics import RESET, TellsResets, clock, data_of, was_reset
from fdtasil.rollouts.spaces import to_numpy

__all__ = ["Together", "TogetherStep", "make_vector", "vector_of"]

_PATIENCE = 5.0  # seconds that processes of environments have to end


class TogetherStep(NamedTuple):
    """What a step of all of them came to.

    Attributes:
        observations: Of all of them, as the environment gives them.
        rewards: (N,).
        terminated: (N,) bool.
        truncated: (N,) bool.
        reset: (N,) bool, whose simulation MuJoCo reset inside the step, as far as it is known;
            where the next episode begins in the last step of one, it is not known of that.
    """

    observations: Any
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    reset: np.ndarray


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
        self._simulations = _Simulations(env.unwrapped, self.count)
        self._anew = env.metadata.get("autoreset_mode") == modes.SAME_STEP

    def reset(self, seeds: Sequence[int], options: Any) -> Any:
        self._over[:], self._options = False, dict(options or {})
        observations = self._reset(list(seeds), options)
        self._simulations.begin()
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
        try:
            observations, rewards, terminated, truncated, info = self._env.step(actions)
        except (EOFError, ConnectionError) as error:  # which say nothing
            raise ChildProcessError("one of its processes has ended") from error
        rewards, terminated, truncated = map(to_numpy, (rewards, terminated, truncated))
        self._over = np.logical_or(terminated, truncated)
        told = np.asarray(info[RESET], bool) if isinstance(info, dict) and RESET in info else False
        reset = self._simulations.reset() | told
        if self._anew:  # the clock went back for the next episode
            reset &= ~self._over
        return TogetherStep(observations, rewards, terminated, truncated, reset)

    def close(self) -> None:
        inner = self._env.unwrapped
        workers = getattr(inner, "processes", None)
        if workers is None:
            self._env.close()
            return
        try:
            self._env.close(timeout=_PATIENCE)  # a step that is under way is waited for
        except TypeError:  # of a wrapper whose close() takes nothing
            self._env.close()
        except (EOFError, OSError):  # of a worker that is gone
            inner.closed = True
        finally:
            _end(workers)

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
        self._simulations = _Simulations(self._innermost, self.count)

    def reset(self, seeds: Sequence[int], options: Any) -> Any:
        # Its own seed() takes one for all; each environment's is what it hands on.
        self._innermost._seeds = list(seeds)
        if options is not None:
            self._innermost.set_options(options)
        observations = self._env.reset()
        self._simulations.begin()
        return observations

    def step(self, actions: Any) -> TogetherStep:
        try:
            observations, rewards, done, infos = self._env.step(actions)
        except (EOFError, ConnectionError) as error:  # which say nothing
            raise ChildProcessError("one of its processes has ended") from error
        late = np.array([bool(info.get("TimeLimit.truncated", False)) for info in infos])
        over = np.asarray(done, bool)
        reset = self._simulations.reset() & ~over  # whose clock went back for the next episode
        return TogetherStep(
            observations, np.asarray(rewards, np.float64), over & ~late, over & late, reset
        )

    def close(self) -> None:
        workers = getattr(self._innermost, "processes", ())
        try:
            if getattr(self._innermost, "waiting", False):  # its close() waits for ever
                self._innermost.closed = True
            else:
                self._env.close()
        except (EOFError, OSError):  # of a worker that is gone
            self._innermost.closed = True
        finally:
            _end(workers)


class _Simulations:
    """MuJoCo's simulations of environments that step together in this process.

    Args:
        environment: The innermost vector environment.
        count: Of its environments.
    """

    def __init__(self, environment: Any, count: int) -> None:
        inside = getattr(environment, "envs", None)
        listed = list(inside) if isinstance(inside, list | tuple) else []
        known = len(listed) == count and all(isinstance(one, gymnasium.Env) for one in listed)
        self._environments, self._count = listed if known else [], count
        self._data: list[object] = []

    def begin(self) -> None:
        """See that episodes begin."""
        self._data = [data_of(one) for one in self._environments]
        self._clocks, self._first = [clock(one) for one in self._data], True

    def reset(self) -> np.ndarray:
        """Return (N,) bool, which were reset in the last step, as far as it is known."""
        pairs = zip(self._data, self._clocks, strict=True)
        found = [was_reset(data, before, first=self._first) for data, before in pairs]
        self._clocks, self._first = [clock(one) for one in self._data], False
        return np.array(found, bool) if found else np.zeros(self._count, bool)


def _end(workers: Sequence[Any]) -> None:
    """End the processes of environments that are left, whatever they do."""
    for one in workers:
        if one.is_alive():
            one.terminate()
    for one in workers:
        one.join(_PATIENCE)


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
    wrappers = [*kwargs.get("wrappers", ()), TellsResets]
    kwargs = {**kwargs, "wrappers": wrappers, "vectorization_mode": "async"}
    return gymnasium.make_vec(name, count, **kwargs)
