"""The gate of an expert beside a dataset: on the states that are given, and around them."""

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import GATE_STATES, admit_expert
from fdtasil.probes.scales import measure_scales
from fdtasil.rollouts.behaviours import has_none
from fdtasil.rollouts.environments import Boxes

__all__ = ["examine_given"]

_SAME = 1e-2  # of an action's deviation; demonstrators' files round, and clip
_STILL = 1e-3  # of the largest deviation, that of an action that hardly moves


def examine_given(
    expert: Expert, given: Dataset, *, admit: bool, around: bool, force: bool
) -> None:
    """Check an expert on states of a dataset, and whether its answers are those that stand there.

    Args:
        expert: Counts its rows under "check".
        given: The dataset.
        admit: Whether to check it; elsewhere an environment's states are for that.
        around: Whether it is compared where probes moved the states to, too: a law at its bounds
            shows at the states themselves nothing of what it is around them.
        force: Only warn, where the expert answers at all.

    Raises:
        ExpertError: If it fails a check.
    """
    states = given.demonstrations
    chosen = np.linspace(0, len(states) - 1, GATE_STATES).round().astype(int)
    rows, said = states.observations[chosen], states.actions[chosen]
    if admit:
        boxes = Boxes(rows.shape[1], given.low, given.high)
        admit_expert(expert, rows, boxes, force=force)
    if around:
        points, heard_there = given.around(chosen)
        rows, said = np.concatenate([rows, points]), np.concatenate([said, heard_there])
    answers = expert.ask(rows, "check")
    heard = ~has_none(answers)
    clipped = np.clip(answers[heard], given.low, given.high)
    apart = np.abs(clipped - np.clip(said[heard], given.low, given.high))
    scales = measure_scales(states.actions)
    least = _STILL * scales.deviation[scales.live].max()
    far = apart > _SAME * np.maximum(np.where(scales.live, scales.deviation, 0.0), least)
    other = int(far.any(axis=1).sum())
    if other:
        moved = " and states that a probe moved" if len(rows) > len(chosen) else ""
        warn(
            f"{expert.name} answers otherwise than the demonstrations at {other} of {len(rows)} "
            f"states{moved}, by up to {apart.max():.2g}: the student would learn from two; "
            "check that the expert is the one that was recorded"
        )
