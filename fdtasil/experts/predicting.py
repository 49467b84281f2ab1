"""Objects with a `predict`, such as stable-baselines3's agents, with what stands beside them."""

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.own_jacobian import own_jacobian

__all__ = ["open_predictor"]

# Wrappers of vectorised environments that leave observations and actions as they are.
_HARMLESS = {"VecMonitor", "VecCheckNan", "VecVideoRecorder", "VecNormalize"}
_ITS_OWN = "stable_baselines3.common.base_class"


def open_predictor(source: Any) -> Expert:
    """Ask an object by its `predict`.

    An agent that was trained in VecNormalize is asked about what that makes of an observation, as
    its own library does.

    Raises:
        ExpertError: If it was trained on observations that another wrapper made.
    """
    name = f"{type(source).__name__}.predict"
    # scikit-learn's predict takes the batch alone; stable-baselines3's is stochastic by default.
    parameters = inspect.signature(source.predict).parameters
    options = {"deterministic": True} if "deterministic" in parameters else {}
    answer = _Predicts(_asked(source), name, options, _statistics(source))
    return Expert(answer, name, jacobian=own_jacobian(source))


@dataclass(frozen=True)
class _Predicts:
    """The policy of an object.

    Attributes:
        source: Has `predict`.
        name: What to call it.
        options: What `predict` is called with besides.
        statistics: The VecNormalize that it was trained in, or None.
    """

    source: Any
    name: str
    options: Mapping[str, bool]
    statistics: Any

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        if self.statistics is not None:
            observations = self.statistics.normalize_obs(observations)
        result = self.source.predict(observations, **self.options)
        if not isinstance(result, tuple):
            return result
        actions, state = result
        if state is not None:
            raise ExpertError(
                f"{self.name} returns a state beside its actions",
                "a policy without memory",
                "distil a policy that depends on the observation only",
            )
        return actions


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
