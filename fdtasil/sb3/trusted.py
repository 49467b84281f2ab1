"""Loading by stable-baselines3 itself, which unpickles: reached with trust="pickle" only."""

import importlib
import io
import pickle
import random
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.errors import ExpertError
from fdtasil.sb3.archive import Archive, first_line
from fdtasil.sb3.network import Statistics
from fdtasil.sb3.recipes import Recipe
from fdtasil.sb3.spaces import Bounds

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


def unpickle_agent(archive: Archive, recipe: Recipe) -> tuple[UnpickledPolicy, bool, Bounds]:
    """Load an agent with the class that wrote it.

    Returns:
        The policy, whether its actions lie in -1..1 and are to be rescaled, and the bounds.

    Raises:
        ExpertError: If the library is not there or can't load the zip.
    """
    try:
        algorithm = getattr(importlib.import_module(recipe.package), recipe.algorithm)
    except ImportError as error:
        raise ExpertError(
            f"{recipe.package} can't be imported: {first_line(error)}",
            f"{recipe.algorithm} of {recipe.package}, which trust='pickle' loads with",
            f"pip install {recipe.package.replace('_', '-')}",
        ) from error
    model = _load(algorithm, archive)
    policy, space = model.policy, model.action_space
    policy.set_training_mode(False)
    bounds = Bounds(
        np.asarray(getattr(space, "low"), np.float32),  # noqa: B009 (for the type checker)
        np.asarray(getattr(space, "high"), np.float32),  # noqa: B009
    )
    return UnpickledPolicy(policy), policy.squash_output, bounds


def unpickle_statistics(path: Path, data: bytes) -> Statistics | None:
    """Load what `VecNormalize.save` wrote.

    Returns:
        The statistics, or None where observations were not normalised.

    Raises:
        ExpertError: If it can't be unpickled, or is something else.
    """
    try:
        wrapper: Any = pickle.loads(data)
        if not wrapper.norm_obs:
            return None
        mean, variance = (
            np.asarray(x, np.float64) for x in (wrapper.obs_rms.mean, wrapper.obs_rms.var)
        )
        scale = np.sqrt(variance + wrapper.epsilon)
        return Statistics(mean, scale, float(wrapper.clip_obs))
    except Exception as error:  # unpickling may raise anything
        raise ExpertError(
            f"{path} can't be used: {first_line(error)}",
            "what VecNormalize.save() wrote, for flat observations",
            "install what it names, or save it again with a current stable-baselines3",
        ) from error


def _load(algorithm: Any, archive: Archive) -> "BaseAlgorithm":
    # Schedules are pickled functions, which other versions of Python can't call; acting does not
    # need them.
    unneeded = {"learning_rate": 0.0, "lr_schedule": _zero, "clip_range": _zero}
    try:
        with _randomness_kept(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return algorithm.load(
                io.BytesIO(archive.content), device="cpu", custom_objects=unneeded
            )
    except Exception as error:  # unpickling may raise anything
        raise ExpertError(
            f"stable-baselines3 can't load {archive.path}: {first_line(error)}",
            "a zip that the installed version can load",
            "install what it names, or save it again with the version that wrote it",
        ) from error


@contextmanager
def _randomness_kept() -> Iterator[None]:
    """Undo the seeding of all global generators that loading an agent does."""
    plain, numbers = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        random.setstate(plain)
        np.random.set_state(numbers)


def _zero(_: float) -> float:
    return 0.0
