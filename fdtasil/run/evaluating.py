"""A policy beside an expert, from the same starts."""

import torch

from fdtasil.checks import check_count, check_flag
from fdtasil.compute import torch_settings
from fdtasil.errors import SettingError
from fdtasil.experts.carrying import carry
from fdtasil.experts.examination import examine
from fdtasil.experts.gate import large_batch
from fdtasil.experts.load import ExpertLike, expert_in
from fdtasil.progress import Progress
from fdtasil.results.constraints import Constraints, check_constraints
from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation
from fdtasil.results.pair import evaluate_pair
from fdtasil.rollouts.behaviours import follow_answers
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool, resolve_horizon
from fdtasil.run.judging import (
    acting,
    check_history,
    finished_run,
    judged_in,
    judged_through,
    warn_of_another_environment,
    warn_of_another_expert,
)
from fdtasil.run.subject import named
from fdtasil.seeding import episode_seeds
from fdtasil.student.view import StudentObservation

__all__ = ["evaluate"]


def evaluate(
    policy: ExpertLike | Distilled,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 20,
    horizon: int | None = None,
    seed: int = 0,
    student_obs: StudentObservation | None = None,
    history: int = 1,
    constraints: Constraints | None = None,
    force: bool = False,
    progress: bool = True,
) -> Evaluation:
    """Compare a policy with an expert from the same starts.

    Args:
        policy: The policy to judge: a result, the folder of a run, a `Student`, an exported ONNX
            file, or anything else that an expert may be.
        expert: The policy to judge it by, as in `distill`.
        env: A gymnasium id (`module:Id` too), a gymnasium environment, or a function making one.
        episodes: Number of paired episodes.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the starts; those of `distill` with the same seed.
        student_obs: What the policy sees, as in `distill`; a result, a run and an ONNX file that
            fdtasil exported say it themselves, but for a function that no file can hold.
        history: As in `distill`.
        constraints: As in `distill`.
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If one of the two can't be opened, or the expert fails the gate.
        EnvironmentFault: If the environment can't be used, or misbehaves.

    Example:
        >>> import numpy as np
        >>> def swing(observations):
        ...     cosine, sine, speed = observations.T
        ...     return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]
        >>> evaluate(swing, swing, "Pendulum-v1", episodes=2, horizon=50).normalized_return
        1.0
    """
    check_count("seed", seed, 0, 2**32 - 1)
    force = check_flag("force", force)
    limits = None if constraints is None else check_constraints(constraints)
    history = check_count("history", history)
    policy = finished_run(policy)
    count, bars = check_count("episodes", episodes), Progress(check_flag("progress", progress))
    with EnvironmentPool(env) as pool, torch_settings(torch.device("cpu")):
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        student_obs = named(student_obs, pool.spaces.observations)
        looked_at, student_obs, history = judged_through(policy, student_obs, history)
        history = check_history(history, student_obs)
        black_box, length = expert_in(expert, pool), resolve_horizon(horizon, pool)
        judged = judged_in(looked_at, pool, student_obs, history)
        if judged.memory is not None:
            raise SettingError(
                f"{judged.name}, which has a memory, to be judged",
                "a policy without one",
                "compare it as the expert: evaluate(student, it, env)",
            )
        black_box, _, remembered = carry(black_box, pool, history)
        starts = episode_seeds(seed, "evaluation", 0, count)
        most = large_batch(count, black_box.chunk)
        theirs = examine(black_box, pool, starts, length, bars, force=force, largest=most)
        visited = theirs.observations[theirs.valid]
        student = follow_answers(acting(judged, student_obs, visited, m, remembered=remembered))
        warn_of_another_environment(policy, pool)
        warn_of_another_expert(policy, black_box)
        return evaluate_pair(student, black_box, theirs, pool, length, seed, bars, limits, n)
