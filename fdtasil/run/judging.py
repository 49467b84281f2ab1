"""A policy that is judged, opened for an environment."""

import os
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np

from fdtasil.checks import check_count
from fdtasil.errors import SettingError, shown, warn
from fdtasil.experts.expert import Expert, Hints, Purpose
from fdtasil.experts.load import ExpertLike, open_expert, sized
from fdtasil.experts.onnx_expert import said_history
from fdtasil.experts.structure import in_spaces
from fdtasil.files.run_format import WEIGHTS
from fdtasil.results.distilled import Distilled, given_view
from fdtasil.rollouts.behaviours import Policy
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.history import past_size
from fdtasil.rollouts.spaces import Spaces, flat_layout
from fdtasil.rollouts.trials import fingerprint, other_environment
from fdtasil.student.policy import Student
from fdtasil.student.view import (
    StudentObservation,
    Unseen,
    View,
    describe_view,
    sees_as,
    view_size,
    visible,
)

__all__ = [
    "acting",
    "check_history",
    "finished_run",
    "judged_in",
    "judged_through",
    "seen_by",
    "warn_of_another_environment",
    "warn_of_another_expert",
]


def finished_run(policy: ExpertLike | Distilled) -> ExpertLike | Distilled:
    """Return the result of a run in the place of its folder, and everything else as it is.

    Raises:
        StorageError: If the folder is a run's, and damaged.
    """
    if isinstance(policy, str | Path) and os.path.isfile(Path(policy) / WEIGHTS):
        return Distilled.load(policy)
    return policy


def warn_of_another_environment(policy: ExpertLike | Distilled, pool: EnvironmentPool) -> None:
    """Warn where a run's student is judged elsewhere than it was distilled."""
    if not isinstance(policy, Distilled):
        return
    names = policy.settings["env"], pool.name
    if names[0] != names[1] and all(name in gymnasium.registry for name in names):
        warn(f"the student was distilled in {names[0]}, and is judged in {names[1]}")
        return
    before = policy.settings.get("fingerprint")
    if not isinstance(before, dict):
        return  # of an earlier fdtasil, or of an environment that does not repeat itself
    seed = before.get("seed")
    if not isinstance(seed, int) or not 0 <= seed < 2**32:
        return
    now = fingerprint(pool, seed)
    # An observation with a past behind it has another length.
    if now is None or np.shape(now["observation"]) != np.shape(before.get("observation", ())):
        return
    if other := other_environment(before, now):
        warn(f"the student was distilled in another {names[0]} than it is judged in: {other[0]}")


def warn_of_another_expert(policy: ExpertLike | Distilled, expert: Expert) -> None:
    """Warn where a run's student is judged by another file than it was distilled from."""
    if not isinstance(policy, Distilled):
        return
    before, now = policy.settings.get("expert_sha256"), expert.origin.sha256
    if before and now and before != now:
        warn(
            f"the student was distilled from {shown(policy.settings['expert'])} with the sha256 "
            f"{before[:8]}..., and is judged by {expert.name} with {now[:8]}...: another file, "
            "and perhaps another expert"
        )


def judged_through(
    policy: ExpertLike | Distilled, student_obs: StudentObservation | None, history: int
) -> tuple[ExpertLike, StudentObservation | None, int]:
    """Return a policy with what it sees; a result and a run's ONNX file say it.

    Args:
        policy: The policy, from `finished_run`.
        student_obs: What the caller says that it sees, by index; or None.
        history: How many observations the caller says that it sees.

    Raises:
        SettingError: If it is None, sees through a function that is lost, or is a result that
            sees something else than the caller says.
    """
    if policy is None:
        raise SettingError(
            "None in the place of the policy to judge", "a result, a file, a function", "pass one"
        )
    if isinstance(policy, Distilled):
        history = max(history, policy.steps_seen)
        if history > 1:
            return policy.student, student_obs, history
        view = policy.view if student_obs is None else given_view(student_obs, policy)
        if isinstance(view.look, Unseen):
            raise view.look.lost
        seen = None if view.is_whole else view.columns or view.look
        return policy.student, seen, history
    if history == 1 and student_obs is None:
        history = said_history(policy)
    return policy, student_obs, history


def judged_in(
    policy: ExpertLike,
    pool: EnvironmentPool,
    student_obs: StudentObservation | None,
    history: int,
) -> Expert:
    """Open a policy that is judged; one that sees a part of the observation takes flat rows.

    Args:
        policy: From `judged_through`.
        pool: The environment, which shows the present alone.
        student_obs: From `judged_through`.
        history: From `judged_through`.
    """
    spaces, n, m = pool.spaces.unless_plain, pool.boxes.observation_size, pool.boxes.action_size
    size = view_size(student_obs, n + past_size(history, n, m))
    judged = open_expert(policy, Hints(size, m, spaces=spaces))
    if isinstance(policy, Student):
        own = {"observation_size": policy.observation_size, "action_size": policy.action_size}
        judged = replace(judged, **own)
    whole = student_obs is None and history == 1
    if spaces is not None and (not whole or judged.origin.columns is not None):
        spaces = Spaces(flat_layout(size or 1), spaces.actions)
    return in_spaces(judged, spaces)


def acting(
    judged: Expert,
    student_obs: StudentObservation | None,
    states: np.ndarray,
    action_size: int,
    *,
    remembered: int = 0,
    purpose: Purpose = "evaluate",
) -> Policy:
    """Return a policy that is judged, as a function of all that is observed.

    Args:
        judged: From `judged_in`.
        student_obs: What it sees; None for what it says itself, or all.
        states: (B, n) observations, which a function of them is tried on.
        action_size: m.
        remembered: Of n, how many numbers are the memory of the expert beside it.
        purpose: That its rows are counted under.

    Raises:
        SettingError: If its file says that it sees something else.
    """
    view = seen_by(judged, student_obs, states, remembered=remembered)
    return view.policy(sized(judged, view.size, action_size).policy(purpose))


def seen_by(
    judged: Expert,
    student_obs: StudentObservation | None,
    states: np.ndarray,
    *,
    remembered: int = 0,
) -> View:
    """Return what a policy that is judged sees; the arguments of `acting`.

    Raises:
        SettingError: If its file says that it sees something else.
    """
    says = judged.origin.columns
    seen = says if student_obs is None else student_obs
    few = states[:256]
    view = View.of(visible(seen, states.shape[1], remembered), few)
    if says is not None and not sees_as(view, View.of(says, few), few):
        raise SettingError(
            f"student_obs={describe_view(student_obs, states.shape[1])} of {judged.name}",
            f"{list(says)}, as the file says itself",
            "leave student_obs= out",
        )
    return view


def check_history(history: object, student_obs: object) -> int:
    """Return the number of observations that a student sees.

    Raises:
        SettingError: If it can't be used.
    """
    count = check_count("history", history)
    if count > 1 and student_obs is not None:
        raise SettingError(
            f"history={count} with student_obs=", "one of the two", "leave one of them out"
        )
    return count
