"""Objects with a `predict`, such as stable-baselines3's agents, with what stands beside them."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.memory import Memory, stateless
from fdtasil.experts.own_jacobian import own_jacobian
from fdtasil.experts.sb3.scores import scores_of

__all__ = ["open_predictor"]

# Wrappers of vectorised environments that leave observations and actions as they are.
_HARMLESS = {"VecMonitor", "VecCheckNan", "VecVideoRecorder", "VecNormalize"}
_ITS_OWN = "stable_baselines3.common.base_class"


def open_predictor(
    source: Any, observation_size: int | None = None, *, chooses: bool = False
) -> Expert:
    """Ask an object by its `predict`; one that returns a state has a memory.

    An agent that was trained in VecNormalize is asked about what that makes of an observation, as
    its own library does.

    Args:
        source: The object.
        observation_size: n, where observations are flat; else it is taken to have no memory.
        chooses: Whether its actions are choices; an agent's scores are asked for in their place.

    Raises:
        ExpertError: If it was trained on observations that another wrapper made.
    """
    name = f"{type(source).__name__}.predict"
    # scikit-learn's predict takes the batch alone; stable-baselines3's is stochastic by default.
    parameters = inspect.signature(source.predict).parameters
    options = {"deterministic": True} if "deterministic" in parameters else {}
    if "state" in parameters and observation_size is not None:
        carried = _carried(source, name, options, observation_size)
        if carried is not None:
            return carried
    asked = _asked(source)
    # DQN has a predict of its own, which is the policy's where nothing is random.
    scores = scores_of(getattr(source, "policy", source)) if chooses else None
    answer = _Predicts(asked, name, options, _statistics(source), scores)
    return Expert(answer, name, jacobian=own_jacobian(source))


@dataclass(frozen=True)
class _Predicts:
    """The policy of an object.

    Attributes:
        source: Has `predict`.
        name: What to call it.
        options: What `predict` is called with besides.
        statistics: The VecNormalize that it was trained in, or None.
        scores: What it chooses by, asked in its place; or None.
    """

    source: Any
    name: str
    options: Mapping[str, bool]
    statistics: Any
    scores: Callable[[Any], np.ndarray] | None = None

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        if self.statistics is not None:
            observations = self.statistics.normalize_obs(observations)
        if self.scores is not None:
            return self.scores(observations)
        result = self.source.predict(observations, **self.options)
        if not isinstance(result, tuple):
            return result
        actions, state = result
        if state is not None:
            raise ExpertError(
                f"{self.name} returns a state beside its actions",
                "a state of arrays whose rows are those of the observations, zeros at the start",
                "return such arrays, a tuple or a dictionary of them, or None for no memory",
            )
        return actions


def _carried(
    source: Any, name: str, options: Mapping[str, bool], observation_size: int
) -> Expert | None:
    """Return an object with a memory as an expert, or None where it has none."""
    asked, statistics = _asked(source), _statistics(source)
    try:
        states = [_ask_first(asked, rows, observation_size, options) for rows in (2, 3)]
    except Exception:  # of the user's; the gate will show it
        return None
    if any(state is None for state in states):
        return None
    axes = [_axis(*parts) for parts in zip(*map(_leaves, states), strict=True)]
    if None in axes:  # no memory of rows
        return None
    step = _Carries(asked, statistics, options, states[0], tuple(axis or 0 for axis in axes))
    memory = Memory(_flat(_leaves(states[0]), step.axes).shape[1], step)
    _check_start(asked, step, memory.size, observation_size, name)
    n = observation_size
    return Expert(stateless(step, n), name, n + memory.size, memory=memory)


def _check_start(source: Any, step: "_Carries", k: int, n: int, name: str) -> None:
    """Refuse a memory that does not begin with zeros.

    Raises:
        ExpertError: If the first answer of an episode is not that to a memory of zeros.
    """
    rows = np.random.default_rng(0).standard_normal((2, n)).astype(np.float32)
    begun = source.predict(rows.copy(), episode_start=np.ones(2, bool), **step.options)[0]
    zeros, _ = replace(step, statistics=None)(rows.copy(), np.zeros((2, k), np.float32))
    if not np.allclose(begun, zeros, rtol=1e-3, atol=1e-4):
        raise ExpertError(
            f"{name} begins an episode with another memory than zeros",
            "a memory of zeros at the start",
            "wrap it: let its state be the difference to the first one",
        )


def _ask_first(source: Any, rows: int, n: int, options: Mapping[str, bool]) -> Any:
    begun = np.ones(rows, bool)
    answer = source.predict(np.zeros((rows, n), np.float32), episode_start=begun, **options)
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
        like: A state, for the kinds and shapes of its parts.
        axes: Of rows, in each part of a state.
    """

    source: Any
    statistics: Any
    options: Mapping[str, bool]
    like: Any
    axes: tuple[int, ...]

    def __call__(
        self, observations: np.ndarray, memories: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.statistics is not None:
            observations = self.statistics.normalize_obs(observations)
        rows, parts, start = len(observations), [], 0
        for part, axis in zip(_leaves(self.like), self.axes, strict=True):
            shape = np.moveaxis(part, axis, 0).shape[1:]
            stop = start + int(np.prod(shape))
            moved = memories[:, start:stop].reshape(rows, *shape).astype(part.dtype)
            parts.append(np.ascontiguousarray(np.moveaxis(moved, 0, axis)))
            start = stop
        begun, state = np.zeros(rows, bool), _state_of(parts, self.like)
        actions, after = self.source.predict(
            observations, state=state, episode_start=begun, **self.options
        )
        return actions, _flat(_leaves(after), self.axes)


def _asked(source: Any) -> Any:
    """Return the part that answers: an agent of the library does nothing but ask its policy.

    Its environment, logger and optimiser can't be sent to another process.
    """
    predict = inspect.getattr_static(type(source), "predict", None)
    own = getattr(predict, "__module__", None) == _ITS_OWN
    return source.policy if own and hasattr(source, "policy") else source


def _statistics(source: Any) -> Any:
    """Return the VecNormalize that normalises an agent's observations, or None."""
    if not hasattr(source, "get_vec_normalize_env"):
        return None
    found = None
    for layer in _layers(source.env):
        kind = type(layer).__name__
        if kind not in _HARMLESS:
            raise ExpertError(
                f"the {type(source).__name__} agent was trained on observations that {kind} makes",
                "an agent that takes the environment's own observations",
                "do in the environment what the wrapper does (for VecFrameStack "
                "FrameStackObservation and FlattenObservation), and pass agent.policy",
            )
        if kind == "VecNormalize" and layer.norm_obs:
            found = layer
    _check_innermost(source)
    return found


def _layers(outermost: Any) -> Iterator[Any]:
    """Yield the wrappers around a vectorised environment."""
    while outermost is not None and "venv" in vars(outermost):
        yield outermost
        outermost = outermost.venv


def _check_innermost(source: Any) -> None:
    """Warn of statistics that are kept inside the agent's own environments."""
    *_, innermost = [source.env, *(layer.venv for layer in _layers(source.env))]
    layer = next(iter(getattr(innermost, "__dict__", {}).get("envs", ())), None)
    while layer is not None:
        if type(layer).__name__ == "NormalizeObservation":
            warn(
                f"the {type(source).__name__} agent was trained in NormalizeObservation, whose "
                "statistics are not the agent's: pass an environment that has them, and keeps "
                "them as they are (update_running_mean = False)"
            )
            return
        layer = getattr(layer, "__dict__", {}).get("env")
