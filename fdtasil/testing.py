"""Checks that anyone can run on an expert or a student of their own: one named result each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.errors import ExpertError, ExportError
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import Finding, examine_expert
from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.experts.sb3.trust import Trust
from fdtasil.files.onnx.export import export_module
from fdtasil.rollouts.behaviours import follow, random_behaviour
from fdtasil.rollouts.environments import Boxes, EnvironmentLike, EnvironmentPool, resolve_horizon
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds, generator
from fdtasil.student.network import Student

__all__ = ["check_expert", "check_student"]

_STATES, _EPISODES = 32, 3
_FAR = 1e3
_SAME = 1e-4


def check_expert(
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    horizon: int | None = None,
    seed: int = 0,
    output: str | None = None,
    trust: Trust = None,
) -> list[Finding]:
    """Check that an expert can be distilled, on states of its environment.

    Args:
        expert: As in `fdtasil.distill`.
        env: As in `fdtasil.distill`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of three episodes of the expert, and three of random actions.
        output: Name of the ONNX output with the actions, where several could be it.
        trust: As in `fdtasil.distill`.

    Returns:
        One finding for each check: opening, answers, determinism, batch independence, action
        bounds, action scale, batch sizes, return (against that of random actions). `problem` is
        None where the check is passed. An expert that can't answer has the first two at most.

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
        looked = _look(expert, pool, horizon, seed, output, trust)
        if looked.own is None or looked.expert is None:
            return looked.findings
        noise = [generator(seed, "random actions", episode) for episode in range(_EPISODES)]
        starts, length = looked.own.seeds.tolist(), looked.own.valid.shape[1]
        chance = rollout(random_behaviour(pool), pool, starts, length, noise)
        return [*looked.findings, _better_than(looked.own, chance, looked.expert.name)]


def check_student(
    student: ExpertLike, env: EnvironmentLike, *, horizon: int | None = None, seed: int = 0
) -> list[Finding]:
    """Check that a policy can be put to work in an environment.

    Args:
        student: A `Student`, an exported ONNX file, or anything else that an expert may be.
        env: As in `fdtasil.distill`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of three episodes of the policy.

    Returns:
        One finding for each check: opening, answers, determinism, batch independence, action
        bounds, action scale, batch sizes, far states (a thousand times as far out), and of a
        `Student` also export (the ONNX file agrees to 1e-5). `problem` is None where the check is
        passed.

    Raises:
        EnvironmentFault: If the environment can't be used.
        SettingError: If an argument can't be used.

    Example:
        >>> findings = check_student(lambda rows: 2 * rows[:, :1], "Pendulum-v1")
        >>> [finding.name for finding in findings if finding.problem]
        ['far states']
    """
    with EnvironmentPool(env) as pool:
        looked = _look(student, pool, horizon, seed)
        if looked.own is None or looked.expert is None:
            return looked.findings
        states = looked.own.spread(_STATES)
        findings = [*looked.findings, _far(looked.expert, states, pool.boxes)]
    return [*findings, _export(student, states)] if isinstance(student, Student) else findings


@dataclass(frozen=True)
class _Looked:
    """What the checks of experts and students share: it was opened, followed and examined."""

    findings: list[Finding]
    expert: Expert | None = None
    own: Episodes | None = None


def _look(
    policy: ExpertLike,
    pool: EnvironmentPool,
    horizon: int | None,
    seed: int,
    output: str | None = None,
    trust: Trust = None,
) -> _Looked:
    boxes, length = pool.boxes, resolve_horizon(horizon, pool)
    sizes = boxes.observation_size, boxes.action_size
    try:
        opened = load_expert(policy, *sizes, output=output, trust=trust)
    except ExpertError as error:
        return _Looked([Finding("opening", error.found, error)])
    opening = Finding("opening", f"{opened.name}: {sizes[0]} -> {sizes[1]} numbers", None)
    try:
        starts = episode_seeds(seed, "evaluation", 0, _EPISODES)
        own = rollout(follow(opened.policy("act")), pool, starts, length)
    except ExpertError as error:
        return _Looked([opening, Finding("answers", error.found, error)])
    states = own.spread(_STATES)
    examined = [*examine_expert(opened, states, boxes), _batch_sizes(opened, states)]
    return _Looked([opening, *examined], opened, own)


def _batch_sizes(expert: Expert, states: np.ndarray) -> Finding:
    """Look at the batches that reveal a function of single rows: as many rows as coordinates."""
    name, width = "batch sizes", states.shape[1]
    rows = np.tile(states, (width // len(states) + 2, 1))[: width + 2]
    counts = (1, 2, width, width + 1)
    try:
        whole = expert.ask(rows, "check")
        parts = {count: expert.ask(rows[:count], "check") for count in counts}
    except ExpertError as error:
        return Finding(name, error.found, error)
    bound = _SAME * max(1.0, float(np.abs(whole).max()))
    wrong = [n for n, part in parts.items() if np.abs(part - whole[:n]).max() > bound]
    if not wrong:
        return Finding(name, f"the same answers in batches of {_listed(counts)} rows", None)
    found = f"{expert.name} answers otherwise in batches of {_listed(wrong)} rows"
    advice = "return one row of actions for each row of observations"
    return Finding(name, found, ExpertError(found, "answers row by row", advice))


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _far(expert: Expert, states: np.ndarray, boxes: Boxes) -> Finding:
    """Look far outside of the training states, where a policy meets its first surprise."""
    name = "far states"
    try:
        answers = expert.ask((states * _FAR).astype(np.float32), "check")
    except ExpertError as error:
        return Finding(name, error.found, error)
    beyond = float(np.maximum(answers - boxes.high, boxes.low - answers).max())
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
