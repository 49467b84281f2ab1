"""A look at an expert, before anything is learnt from it."""

from pathlib import Path

import torch

from fdtasil.checks import check_count
from fdtasil.compute import torch_settings
from fdtasil.errors import without_secrets
from fdtasil.experts.examination import Looked, look_closely
from fdtasil.experts.load import ExpertLike
from fdtasil.probes.calibration import Calibration, calibrate
from fdtasil.probes.scales import action_units, all_but, measure_scales
from fdtasil.results.inspection import Inspection
from fdtasil.rollouts.environments import (
    EnvironmentLike,
    EnvironmentPool,
    bounds_text,
    resolve_horizon,
)
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import generator

__all__ = ["inspect"]


def inspect(
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 5,
    horizon: int | None = None,
    seed: int = 0,
) -> Inspection:
    """Show what an expert is: its contract with the environment, and the return it reaches.

    Args:
        expert: ONNX file, zip of a stable-baselines3 agent, address, or anything else that
            `distill` takes.
        env: Gymnasium id (module:Id imports the module first), or anything else that `distill`
            takes.
        episodes: Episodes that the return is measured over.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the episodes.

    Returns:
        The inspection. Where the expert can't be distilled, its `problem` is the error that
        `distill` would raise.

    Raises:
        SettingError: If an argument can't be used.
        EnvironmentFault: If the environment can't be used.

    Example:
        >>> import numpy as np
        >>> def swing(rows):
        ...     return np.clip(-8 * np.arctan2(rows[:, 1:2], rows[:, :1]) - 2 * rows[:, 2:], -2, 2)
        >>> found = inspect(swing, "Pendulum-v1", episodes=2, horizon=50)
        >>> found.problem, found.calibration.regime
        (None, 'smooth')
    """
    check_count("episodes", episodes)
    check_count("seed", seed, 0, 2**32 - 1)
    with EnvironmentPool(env) as pool, torch_settings(torch.device("cpu")):
        size, length = pool.boxes.observation_size, resolve_horizon(horizon, pool)
        looked = look_closely(expert, pool, horizon, seed, episodes)
        opened, own, chance = looked.expert, looked.own, looked.chance
        memory = opened.memory if opened is not None else None
        return Inspection(
            _named(expert, looked),
            opened.origin.sha256 if opened is not None else None,
            pool.name,
            size,
            memory.size if memory is not None else 0,
            _actions(pool),
            opened is not None and opened.module is not None,
            tuple(looked.findings),
            tuple(own.returns.tolist()) if own is not None else (),
            float(chance.returns.mean()) if chance is not None else None,
            int(own.terminated.sum()) if own is not None else 0,
            length,
            _calibrated(looked, pool, seed),
        )


def _named(source: ExpertLike, looked: Looked) -> str:
    if isinstance(source, str | Path):
        return without_secrets(str(source))
    if looked.expert is None:
        return type(source).__name__
    return looked.expert.origin.source or looked.expert.name


def _actions(pool: EnvironmentPool) -> str:
    boxes, choices = pool.boxes, pool.spaces.actions.choices
    if choices:
        counts = ", ".join(str(stop - start) for start, stop in choices)
        return f"{boxes.action_size} scores of choices, of {counts} each"
    return f"{boxes.action_size}, from {bounds_text(boxes.low, boxes.high)}"


def _calibrated(looked: Looked, pool: EnvironmentPool, seed: int) -> Calibration | None:
    if looked.own is None or looked.expert is None:
        return None
    visited, random = looked.own.observations[looked.own.valid], generator(seed, "calibration")
    moved = all_but(pool.spaces.observations.held, visited.shape[1])
    scales, radius = measure_scales(visited, moved), PRESETS["standard"].radius
    if not (scales.live & scales.seen).any():  # `distill` would clone plainly
        return None
    low, high, choices = pool.boxes.low, pool.boxes.high, pool.spaces.actions.choices
    units = action_units(low, high, looked.own.actions[looked.own.valid], choices)
    return calibrate(looked.expert, visited, scales, random, radius, units=units)
