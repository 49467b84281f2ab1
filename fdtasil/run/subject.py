"""What a run is about: an expert, an environment, a dataset; two of them may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import SettingError
from fdtasil.experts.carrying import carry
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool
from fdtasil.student.view import StudentObservation, describe_view

__all__ = ["Subject", "open_subject", "visible"]


@dataclass(frozen=True)
class Subject:
    """An expert and its environment, opened.

    Attributes:
        expert: The black box, or None where nobody is asked.
        pool: The environment, or None where nothing is recorded.
        environment: What to call it.
        observation_size: n; behind the environment's own stand past and memory.
        action_size: m.
        past: Length of the past that the student sees.
        remembered: Length of the expert's memory; 0 where it has none.
    """

    expert: Expert | None
    pool: EnvironmentPool | None
    environment: str
    observation_size: int
    action_size: int
    past: int = 0
    remembered: int = 0

    @property
    def comparable(self) -> bool:
        """Whether student and expert can be compared in the environment."""
        return self.expert is not None and self.pool is not None


@contextmanager
def open_subject(
    expert: ExpertLike | None,
    env: EnvironmentLike | None,
    given: Dataset | None,
    history: int = 1,
) -> Iterator[Subject]:
    """Open expert and environment for the length of a block.

    Args:
        expert: The expert.
        env: The environment.
        given: A dataset.
        history: How many observations the student sees.

    Raises:
        SettingError: If something is missing that nothing replaces.
        ExpertError: If the expert can't be opened.
        EnvironmentFault: If the environment can't be used, or does not fit the demonstrations.
    """
    if given is None and (expert is None or env is None):
        missing = "expert" if expert is None else "env"
        raise SettingError(
            f"no {missing}", "an expert and an environment, or a dataset", f"pass {missing}="
        )
    with EnvironmentPool(env) if env is not None else nullcontext() as pool:
        if pool is not None:
            n, m, name = pool.boxes.observation_size, pool.boxes.action_size, pool.name
        else:
            assert given is not None
            n, m, name = *given.sizes, given.environment
        if given is not None and given.sizes != (n, m):
            raise SettingError(
                f"a dataset with (observations, actions) of sizes {given.sizes}",
                f"{(n, m)}, as {name}",
                "pass the environment that they were recorded in, or none",
            )
        opened, past, remembered = None, 0, 0
        if expert is not None:
            opened, past, remembered = carry(load_expert(expert, n, m), pool, history)
        yield Subject(opened, pool, name, n + past + remembered, m, past, remembered)


def visible(
    student_obs: StudentObservation | None, n: int, remembered: int
) -> StudentObservation | None:
    """Return what the student sees: never what the expert remembers.

    Args:
        student_obs: What the caller says, of the environment's own observations.
        n: Length of an observation, with past and memory.
        remembered: Length of the memory.
    """
    if not remembered:
        return student_obs
    own = n - remembered
    if student_obs is None:
        return tuple(range(own))
    if callable(student_obs) and not isinstance(student_obs, type):
        return lambda rows: student_obs(rows[:, :own])
    return describe_view(student_obs, own)  # pyright: ignore[reportReturnType]
