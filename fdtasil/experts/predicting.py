"""Objects with a `predict`, such as stable-baselines3's agents, with what stands beside them."""

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.own_jacobian import own_jacobian
from fdtasil.experts.sb3.scores import scores_of
from fdtasil.experts.sb3.wrapped import normaliser_of
from fdtasil.experts.stateful import with_state
from fdtasil.rollouts.spaces import Layout

__all__ = ["open_predictor"]

_ITS_OWN = "stable_baselines3.common.base_class"


def open_predictor(
    source: Any,
    observation_size: int | None = None,
    layout: Layout | None = None,
    *,
    chooses: bool = False,
) -> Expert:
    """Ask an object by its `predict`; one that returns a state has a memory.

    An agent that was trained in VecNormalize is asked about what that makes of an observation, as
    its own library does.

    Args:
        source: The object.
        observation_size: n, where it is known; else it is taken to have no memory.
        layout: Of observations that it takes in parts; None where they are flat rows.
        chooses: Whether its actions are choices; an agent's scores are asked for in their place.

    Raises:
        ExpertError: If it was trained on observations that another wrapper made, or its `predict`
            is no function.
    """
    name = f"{type(source).__name__}.predict"
    # scikit-learn's predict takes the batch alone; stable-baselines3's is stochastic by default.
    parameters = _parameters_of(source.predict, name)
    options = {"deterministic": True} if "deterministic" in parameters else {}
    asked, statistics = _asked(source), normaliser_of(source)
    if "action_masks" in parameters:
        warn(
            f"{name} takes action_masks, which nobody hands over here: where they forbid actions, "
            "it is another policy without them. Pass a function that makes the masks of its "
            "observations, and calls it with both"
        )
    if "state" in parameters and observation_size is not None:
        carried = with_state(asked, name, options, statistics, observation_size, layout)
        if carried is not None:
            return carried
    # DQN has a predict of its own, which is the policy's where nothing is random.
    scores = scores_of(getattr(source, "policy", source)) if chooses else None
    known = observation_size is not None
    answer = _Predicts(asked, name, options, statistics, scores, known)
    return Expert(answer, name, jacobian=own_jacobian(source))


def _parameters_of(predict: Any, name: str) -> Collection[str]:
    """Return the names of what a function takes; none of one of a compiled module that hides them.

    Raises:
        ExpertError: If it is no function.
    """
    if not callable(predict):
        found = f"{name} is a {type(predict).__name__}"
        raise ExpertError(found, "a function of observations", "pass a function of a batch")
    try:
        return inspect.signature(predict).parameters
    except (TypeError, ValueError):
        return ()


@dataclass(frozen=True)
class _Predicts:
    """The policy of an object.

    Attributes:
        source: Has `predict`.
        name: What to call it.
        options: What `predict` is called with besides.
        statistics: The VecNormalize that it was trained in, or None.
        scores: What it chooses by, asked in its place; or None.
        known: Whether the length of an observation is, behind which a memory stands.
    """

    source: Any
    name: str
    options: Mapping[str, bool]
    statistics: Any
    scores: Callable[[Any], np.ndarray] | None = None
    known: bool = True

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        if self.statistics is not None:
            observations = self.statistics.normalize_obs(observations)
        if self.scores is not None:
            return self.scores(observations)
        result = self.source.predict(observations, **self.options)
        if not isinstance(result, tuple):
            return result
        actions, state = result
        if state is not None and not self.known:
            raise ExpertError(
                f"{self.name} returns a state, and nobody says how long an observation is",
                "rows (B, n), behind which its memory stands",
                "write load_expert(..., observation_size=n), or ask it in an environment",
            )
        if state is not None:
            raise ExpertError(
                f"{self.name} returns a state beside its actions",
                "predict(observation, state, episode_start), and a state of arrays with a row for "
                "each observation, zeros at the start",
                "take and return these, a tuple or a dictionary of such arrays, or None for no "
                "memory; it is called with 2 and 3 rows of zeros first",
            )
        return actions


def _asked(source: Any) -> Any:
    """Return the part that answers: an agent of the library does nothing but ask its policy.

    Its environment, logger and optimiser can't be sent to another process.
    """
    predict = inspect.getattr_static(type(source), "predict", None)
    own = getattr(predict, "__module__", None) == _ITS_OWN
    return source.policy if own and hasattr(source, "policy") else source
