"""Functions of the caller, called once before anything is asked for them."""

import numpy as np

from fdtasil.results.constraints import Constraints, try_constraints
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import first_observations
from fdtasil.seeding import episode_seeds, generator
from fdtasil.student.view import StudentObservation, View

__all__ = ["try_functions"]

_STARTS = 2


def try_functions(
    pool: EnvironmentPool,
    student_obs: StudentObservation | None,
    constraints: Constraints | None,
    seed: int,
) -> None:
    """Call the functions of a run on the first observations of two episodes.

    A mistake in one would else be found after hours of recording and training.

    Args:
        pool: The environment.
        student_obs: What the student sees, of all that is observed.
        constraints: Of the evaluation.
        seed: Of the run.

    Raises:
        SettingError: If one raises, or returns something else than it should.
    """
    if not (callable(student_obs) or constraints):
        return
    states = first_observations(pool, episode_seeds(seed, "evaluation", 0, _STARTS))
    if callable(student_obs):
        View.of(student_obs, states)
    if constraints:
        random = generator(seed, "constraints").uniform(-1, 1, (len(states), len(pool.boxes.low)))
        actions, _ = pool.bounds.put_inside(random.astype(np.float32))
        try_constraints(constraints, states, actions, pool)
