"""Checks that anyone can run on an expert or a student of their own: one named result each."""

import numpy as np

from fdtasil.errors import ExpertError, ExportError
from fdtasil.experts.examination import LOOKED_AT, look_closely
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import Finding
from fdtasil.experts.load import ExpertLike
from fdtasil.files.onnx.export import export_module
from fdtasil.rollouts.behaviours import has_none
from fdtasil.rollouts.environments import Boxes, EnvironmentLike, EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.student.policy import Student

__all__ = ["Finding", "check_expert", "check_student"]

_EPISODES = 3
_FAR = 1e3


def check_expert(
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    horizon: int | None = None,
    seed: int = 0,
) -> list[Finding]:
    """Check that an expert can be distilled, on states of its environment.

    Args:
        expert: As in `fdtasil.distill`.
        env: As in `fdtasil.distill`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of three episodes of the expert, and three of random actions.

    Returns:
        One finding for each check: opening, answers, beginning (of a memory), determinism, batch
        independence, large batches (as many rows as are asked at once), action bounds, action
        scale, batch sizes, return (against that of random actions). `problem` is None where the
        check is passed. An expert that can't answer has the first two at most.

    Raises:
        EnvironmentFault: If the environment can't be used.
        SettingError: If an argument can't be used.

    Example:
        >>> def swing(rows):
        ...     return np.clip(-8 * np.arctan2(rows[:, 1:2], rows[:, :1]) - 2 * rows[:, 2:], -2, 2)
        >>> [finding.name for finding in check_expert(swing, "Pendulum-v1") if finding.problem]
        []
    """
    with EnvironmentPool(env) as pool:
        looked = look_closely(expert, pool, horizon, seed, _EPISODES)
    if looked.own is None or looked.chance is None or looked.expert is None:
        return looked.findings
    return [*looked.findings, _better_than(looked.own, looked.chance, looked.expert.name)]


def check_student(
    student: ExpertLike, env: EnvironmentLike, *, horizon: int | None = None, seed: int = 0
) -> list[Finding]:
    """Check that a policy can be put to work in an environment.

    Args:
        student: A `Student`, an exported ONNX file, or anything else that an expert may be. It
            sees the whole observation; others are judged by `fdtasil.evaluate`.
        env: As in `fdtasil.distill`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of three episodes of the policy.

    Returns:
        One finding for each check: opening, answers, determinism, batch independence, large
        batches, action bounds, action scale, batch sizes, far states (a thousand times as far
        out), and of a `Student` also export (the ONNX file agrees to 1e-5). `problem` is None
        where the check is passed.

    Raises:
        EnvironmentFault: If the environment can't be used.
        SettingError: If an argument can't be used.

    Example:
        >>> findings = check_student(lambda rows: 2 * rows[:, :1], "Pendulum-v1")
        >>> [finding.name for finding in findings if finding.problem]
        ['far states']
    """
    with EnvironmentPool(env) as pool:
        looked = look_closely(student, pool, horizon, seed, _EPISODES, with_chance=False)
        if looked.own is None or looked.expert is None:
            return looked.findings
        states = looked.own.spread(LOOKED_AT)
        findings = [*looked.findings, _far(looked.expert, states, pool.boxes)]
    return [*findings, _export(student, states)] if isinstance(student, Student) else findings


def _far(expert: Expert, states: np.ndarray, boxes: Boxes) -> Finding:
    """Look far outside of the training states, where a policy meets its first surprise."""
    name = "far states"
    try:
        answers = expert.ask((states * _FAR).astype(np.float32), "check")
    except ExpertError as error:
        return Finding(name, error.found, error)
    answers = answers[~has_none(answers)]
    beyond = float(np.maximum(answers - boxes.high, boxes.low - answers).max(initial=0.0))
    if beyond <= 1e-4:
        return Finding(name, f"bounded at {_FAR:g} times the states", None)
    found = f"{expert.name} leaves the action bounds by {beyond:.2g} at {_FAR:g} times the states"
    advice = (
        "actions inside the bounds whatever is observed",
        "end the policy with a bounded layer",
    )
    return Finding(name, found, ExpertError(found, *advice))


def _export(student: Student, states: np.ndarray) -> Finding:
    try:
        data = export_module(student, states, {})
    except ExportError as error:
        return Finding("export", error.found, error)
    return Finding("export", f"an ONNX file of {len(data):,} bytes agrees to 1e-5", None)


def _better_than(own: Episodes, chance: Episodes, name: str) -> Finding:
    reached, guessed = float(own.returns.mean()), float(chance.returns.mean())
    measured = f"{reached:.4g}, random actions {guessed:.4g}"
    if reached > guessed:
        return Finding("return", measured, None)
    problem = ExpertError(
        f"{name} reaches {measured}",
        "an expert of this environment",
        "check the environment's version, the action scale and missing normalisation statistics",
    )
    return Finding("return", measured, problem)
