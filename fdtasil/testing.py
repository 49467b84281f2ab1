"""Checks that anyone can run on an expert or a student of their own: one named result each."""

import numpy as np

from fdtasil.errors import ExpertError, ExportError
from fdtasil.experts.examination import LOOKED_AT, look_closely
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import Finding
from fdtasil.experts.load import ExpertLike
from fdtasil.files.onnx.export import export_module
from fdtasil.results.distilled import Distilled
from fdtasil.rollouts.behaviours import has_none
from fdtasil.rollouts.environments import Boxes, EnvironmentLike, EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.history import WithHistory
from fdtasil.rollouts.rollout import first_observations
from fdtasil.run.judging import acting, check_history, finished_run, judged_in, judged_through
from fdtasil.run.subject import named
from fdtasil.seeding import episode_seeds
from fdtasil.student.policy import Student
from fdtasil.student.view import StudentObservation, View

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
    student: ExpertLike | Distilled,
    env: EnvironmentLike,
    *,
    horizon: int | None = None,
    seed: int = 0,
    student_obs: StudentObservation | None = None,
    history: int = 1,
) -> list[Finding]:
    """Check that a policy can be put to work in an environment.

    Args:
        student: A result, the folder of a run, a `Student`, an exported ONNX file, or anything
            else that an expert may be.
        env: As in `fdtasil.distill`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of three episodes of the policy.
        student_obs: What it sees, as in `fdtasil.evaluate`.
        history: As there.

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
    policy, own = finished_run(student), None
    with EnvironmentPool(env) as pool:
        student_obs = named(student_obs, pool.spaces.observations)
        try:
            source, student_obs, history = judged_through(policy, student_obs, history)
            if isinstance(source, Student):
                own = source
            history = check_history(history, student_obs)
            source = _seeing(source, pool, student_obs, history, seed)
        except ExpertError as error:
            return [Finding("opening", error.found, error)]
        looked = look_closely(source, pool, horizon, seed, _EPISODES, with_chance=False)
        if looked.own is None or looked.expert is None:
            return looked.findings
        states = looked.own.spread(LOOKED_AT)
        findings = [*looked.findings, _far(looked.expert, states, pool.boxes)]
    if own is None:
        return findings
    return [*findings, _export(own, View.of(student_obs, states).look(states))]


def _seeing(
    policy: ExpertLike,
    pool: EnvironmentPool,
    student_obs: StudentObservation | None,
    history: int,
    seed: int,
) -> Expert:
    """Return a policy as one of all that is observed, whatever it sees of it."""
    judged = judged_in(policy, pool, student_obs, history)
    if student_obs is None and history == 1 and judged.origin.columns is None:
        return judged
    if history > 1:
        pool.wrap(lambda made: WithHistory(made, history, pool.spaces.actions))
    first = first_observations(pool, episode_seeds(seed, "evaluation", 0, 1))
    m = pool.boxes.action_size
    act = acting(judged, student_obs, first, m, purpose="check")
    return Expert(act, judged.name, first.shape[1], m, spaces=pool.spaces)


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
