"""Loading by stable-baselines3 itself, which unpickles: reached with trust="pickle" only."""

import importlib
import io
import pickle
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.errors import ExpertError, first_line
from fdtasil.experts.sb3.archive import Archive
from fdtasil.experts.sb3.network import Clip, ObservationStatistics, Rescale
from fdtasil.experts.sb3.observations import Observed
from fdtasil.experts.sb3.randomness import randomness_kept
from fdtasil.experts.sb3.recipes import Recipe, has_usual_policy
from fdtasil.experts.sb3.spaces import Bounds, read_bounds

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy

__all__ = ["UnpickledPolicy", "unpickle_agent", "unpickle_statistics"]


class UnpickledPolicy(nn.Module):
    """The deterministic answer of any policy of stable-baselines3, before the action bounds."""

    def __init__(self, policy: "BasePolicy") -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) normalised observations -> (B, m)."""
        distribution = torch.distributions.Distribution
        before = distribution._validate_args
        # The check of a distribution's arguments depends on their values, which no graph can.
        distribution.set_default_validate_args(False)
        try:
            return self.policy._predict(observations, deterministic=True)  # pyright: ignore
        finally:
            distribution.set_default_validate_args(before)


def unpickle_agent(
    archive: Archive, recipe: Recipe, sizes: tuple[int, int]
) -> tuple[UnpickledPolicy, bool, Bounds]:
    """Load an agent with the class that wrote it.

    Args:
        archive: The zip.
        recipe: Of its algorithm.
        sizes: n and m, as the spaces say.

    Returns:
        The policy, whether its actions lie in -1..1 and are to be rescaled, and the bounds.

    Raises:
        ExpertError: If the library is not there or can't load the zip, or `predict` answers
            otherwise than the policy that it would be replaced by.
    """
    try:
        algorithm = getattr(importlib.import_module(recipe.package), recipe.algorithm)
    except ImportError as error:
        raise ExpertError(
            f"{recipe.package} can't be imported: {first_line(error)}",
            f"{recipe.algorithm} of {recipe.package}, which trust='pickle' loads with",
            f"pip install {recipe.package.replace('_', '-')}",
        ) from error
    model = _load(algorithm, archive, _replaced(algorithm, archive, recipe, sizes))
    space, squashed = model.action_space, model.policy.squash_output
    model.policy.set_training_mode(False)
    bounds = Bounds(
        np.asarray(getattr(space, "low"), np.float32),  # noqa: B009 (for the type checker)
        np.asarray(getattr(space, "high"), np.float32),  # noqa: B009
    )
    policy = UnpickledPolicy(model.policy)
    _check_predict(model, nn.Sequential(policy, Rescale(bounds) if squashed else Clip(bounds)))
    return policy, squashed, bounds


def unpickle_statistics(
    path: Path, data: bytes, observed: Observed
) -> ObservationStatistics | None:
    """Load what `VecNormalize.save` wrote.

    Args:
        path: The file.
        data: What is in it.
        observed: What the agent observes.

    Returns:
        The statistics, or None where observations were not normalised.

    Raises:
        ExpertError: If it can't be unpickled, or is something else.
    """
    try:
        wrapper: Any = _Unpickler(io.BytesIO(data)).load()
        if not wrapper.norm_obs:
            return None
        if not observed.parts:
            return _statistics(wrapper, wrapper.obs_rms)
        named = wrapper.obs_rms
        if not set(named) <= {name for name, _ in observed.parts}:
            raise ValueError(f"it has statistics of {', '.join(map(str, named))}")
        parts = [
            _statistics(wrapper, named[name]) if name in named else _none_of(size)
            for name, size in observed.parts
        ]
        joined = (np.concatenate([getattr(one, name) for one in parts]) for name in _FIELDS)
        return ObservationStatistics(*joined)
    except Exception as error:  # unpickling may raise anything
        raise ExpertError(
            f"{path} can't be used: {first_line(error)}",
            "what VecNormalize.save() wrote, for the agent's observations",
            "install what it names, or save it again with a current stable-baselines3",
        ) from error


_FIELDS = ("mean", "scale", "clip")


def _statistics(wrapper: Any, moments: Any) -> ObservationStatistics:
    mean, variance = (np.asarray(x, np.float64).ravel() for x in (moments.mean, moments.var))
    clip = np.full(len(mean), float(wrapper.clip_obs))
    return ObservationStatistics(mean, np.sqrt(variance + wrapper.epsilon), clip)


def _none_of(size: int) -> ObservationStatistics:
    """Return the statistics of a part that is left as it is."""
    return ObservationStatistics(np.zeros(size), np.ones(size), np.full(size, np.inf))


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        # Until 2.0 the spaces were gym's; gymnasium reads the state of both.
        package, dot, rest = module_name.partition(".")
        package = "gymnasium" if package == "gym" else package
        return super().find_class(package + dot + rest, global_name)


def _replaced(
    algorithm: Any, archive: Archive, recipe: Recipe, sizes: tuple[int, int]
) -> dict[str, Any]:
    """Return what is not unpickled, because other versions can't or acting does not need it."""
    # Schedules are pickled functions, which other versions of Python can't call.
    replaced: dict[str, Any] = dict.fromkeys(("lr_schedule", "clip_range", "clip_range_vf"), _zero)
    replaced |= {"learning_rate": 0.0, "buffer_size": 1}  # a million transitions otherwise
    if has_usual_policy(archive.record, recipe):
        replaced["policy_class"] = algorithm.policy_aliases["MlpPolicy"]  # moved after 0.7
    if str(archive.record["action_space"].get(":type:")).startswith("<class 'gym."):
        box, bounds = gymnasium.spaces.Box, read_bounds(archive.record, sizes[1], "the zip")
        replaced["observation_space"] = box(-np.inf, np.inf, sizes[:1], np.float32)
        replaced["action_space"] = box(bounds.low, bounds.high, sizes[1:], np.float32)
    return replaced


def _load(algorithm: Any, archive: Archive, replaced: dict[str, Any]) -> "BaseAlgorithm":
    try:
        with randomness_kept(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return algorithm.load(
                io.BytesIO(archive.content), device="cpu", custom_objects=replaced
            )
    except Exception as error:  # unpickling may raise anything
        raise ExpertError(
            f"stable-baselines3 can't load {archive.path}: {first_line(error)}",
            "a zip that the installed version can load",
            "install what it names, or save it again with the version that wrote it",
        ) from error


def _check_predict(model: "BaseAlgorithm", module: nn.Module) -> None:
    """Refuse a policy class with a `predict` of its own, which the module would leave out."""
    size = int(np.prod(model.observation_space.shape or ()))
    states = np.random.default_rng(0).standard_normal((64, size), dtype=np.float32)
    try:
        expected = model.predict(states, deterministic=True)[0]
        with torch.no_grad():
            found = module(torch.from_numpy(states)).numpy()
    except Exception as error:  # code of the zip's author
        raise ExpertError(
            f"the policy can't be asked: {first_line(error)}",
            f"answers to observations of shape (64, {size})",
            "load it yourself, and pass a function on batches of observations",
        ) from error
    if not np.allclose(found, expected, rtol=1e-5, atol=1e-5, equal_nan=True):
        raise ExpertError(
            "predict() of the agent's policy does more than its _predict()",
            "the scaling or clipping of stable-baselines3, and nothing else",
            "load it yourself, and pass the agent: distill(agent, env)",
        )


def _zero(_: float) -> float:
    return 0.0
