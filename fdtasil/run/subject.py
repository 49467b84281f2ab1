"""What a run is about: an expert, an environment, a dataset; two of them may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from fdtasil.checks import spelt
from fdtasil.demonstrations.dataset import Dataset, warn_of_bounds
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError, warn
from fdtasil.experts.carrying import beside_past, carry
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import ExpertLike, expert_in, load_expert
from fdtasil.experts.structure import in_spaces
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool, bounds_text
from fdtasil.rollouts.history import past_size
from fdtasil.rollouts.naming import columns_named
from fdtasil.rollouts.spaces import Layout, Spaces, flat_layout
from fdtasil.student.view import StudentObservation

__all__ = ["Subject", "bounded", "named", "open_subject"]

_ROUNDING = 1e-5  # of the largest score


@dataclass(frozen=True)
class Subject:
    """An expert and its environment, opened.

    Attributes:
        expert: The black box, or None where nobody is asked.
        pool: The environment, or None where nothing is recorded.
        environment: What to call it.
        observation_size: n; behind the environment's own stand past and memory.
        action_size: m.
        history: How many observations the student sees.
        past: Length of those before the present one, with the actions then.
        remembered: Length of the expert's memory; 0 where it has none.
        spaces: Of the environment, where they are no plain boxes.
    """

    expert: Expert | None
    pool: EnvironmentPool | None
    environment: str
    observation_size: int
    action_size: int
    history: int = 1
    past: int = 0
    remembered: int = 0
    spaces: Spaces | None = None

    @property
    def actions(self) -> Layout:
        """How an action is made of numbers."""
        return self.spaces.actions if self.spaces else flat_layout(self.action_size)

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
        SettingError: If something is missing that nothing replaces, or the dataset shows another
            memory.
        ExpertError: If the expert can't be opened.
        EnvironmentFault: If the environment can't be used, or does not fit the demonstrations.
    """
    if isinstance(expert, Dataset):
        found = "a dataset in the place of the expert"
        raise SettingError(found, "an expert, or None", "write dataset=, in a shell --dataset")
    if given is None and (expert is None or env is None):
        missing, place = ("expert", "first") if expert is None else ("env", "second")
        raise SettingError(
            f"no {missing}",
            "an expert and an environment, or a dataset",
            f"pass {missing}=, in a shell as the {place} argument",
        )
    with EnvironmentPool(env) if env is not None else nullcontext() as pool:
        if pool is not None:
            n, m, name = pool.boxes.observation_size, pool.boxes.action_size, pool.name
            spaces = pool.spaces.unless_plain
        else:
            assert given is not None
            n, m = given.own_size, given.sizes[1]
            name, spaces = given.environment, given.spaces
        if given is not None and (found := (given.own_size, given.sizes[1])) != (n, m):
            chosen = spaces is not None and len(spaces.actions.choices) == 1 and found[0] == n
            raise SettingError(
                f"a dataset with (observations, actions) of sizes {found}",
                f"{(n, m)}, as {name}",
                f"choices, from 0 on, are scores there: np.eye({m})[chosen] - 1 / {m}"
                if chosen
                else "pass the environment that they were recorded in, or none",
            )
        opened, past = None, past_size(history, n, m)
        remembered = given.remembered if given is not None else 0
        if expert is not None:
            found = load_expert(expert, n, m) if pool is None else expert_in(expert, pool)
            found = in_spaces(found, spaces)
            if pool is not None:
                opened, past, remembered = carry(found, pool, history)
            else:
                opened, remembered = _without_memory(found), 0
                opened = beside_past(opened, n, past) if past else opened
            if given is not None and given.remembered != remembered:
                raise SettingError(
                    f"{opened.name}, which remembers {remembered or 'nothing'}, beside states of "
                    f"one that remembered {given.remembered or 'nothing'}",
                    "the expert that they were recorded with, and its memory beside them",
                    "pass it, or none (nobody is asked, and probes=0 learns from the actions)"
                    + ("" if pool is None else ", or leave dataset= out, and it is recorded here"),
                )
        size = n + past + remembered
        yield Subject(opened, pool, name, size, m, history, past, remembered, spaces)


def _without_memory(expert: Expert) -> Expert:
    """Return an expert that needs no environment to be asked.

    Raises:
        SettingError: If it has a memory.
    """
    if expert.memory is None:
        return expert
    raise SettingError(
        f"{expert.name}, which has a memory, without an environment",
        "one in which it is remembered: what it remembered at recorded states is not known",
        "pass env= and no dataset; or pass no expert, and probes=0 learns from the actions",
    )


def bounded(given: Dataset, pool: EnvironmentPool) -> Dataset:
    """Return a dataset with the environment's spaces, and its bounds of actions that have none.

    Scores of its choices are centred, as an expert's are: a student that learns from both would
    learn from two otherwise.

    Raises:
        SettingError: If no action lies within both.
    """
    boxes = pool.boxes
    low, high = (
        np.where(np.isfinite(said), said, own).astype(np.float32)
        for said, own in ((given.low, boxes.low), (given.high, boxes.high))
    )
    theirs = f"{pool.name} has the action bounds {bounds_text(boxes.low, boxes.high)}"
    found = f"a dataset with the action bounds {bounds_text(given.low, given.high)}"
    if not (low < high).all():
        raise SettingError(found, theirs, "leave low= and high= out of from_arrays")
    if not (np.allclose(low, boxes.low) and np.allclose(high, boxes.high)):
        warn(f"{found}: the student stays within them; {theirs}")
    states = _centred(given.demonstrations, pool.spaces.actions)
    spaces = given.spaces or pool.spaces.unless_plain
    whole = replace(given, low=low, high=high, demonstrations=states, spaces=spaces)
    if not (np.array_equal(low, given.low) and np.array_equal(high, given.high)):
        warn_of_bounds(whole)
    return whole


def _centred(states: Demonstrations, actions: Layout) -> Demonstrations:
    """Return states with scores that sum to zero; those that do, but for rounding, as they are."""
    centred = actions.centred(states.actions.copy())
    if np.allclose(centred, states.actions, rtol=0, atol=_ROUNDING * np.abs(centred).max()):
        return states
    return replace(states, actions=centred)


def named(
    student_obs: StudentObservation | None, observations: Layout | None
) -> StudentObservation | None:
    """Return the columns of parts that are said by their names; what else is said as it is.

    The parts stay in the order of the space, in which everybody else reads them.

    Raises:
        SettingError: If there is no such part.
    """
    names = (student_obs,) if isinstance(student_obs, str) else student_obs
    if not isinstance(names, list | tuple) or not any(isinstance(one, str) for one in names):
        return student_obs
    said, example = spelt("student_obs", student_obs), "write indices, such as 0 1 2"
    columns = (columns_named(str(name), observations, said, example) for name in names)
    return tuple(sorted({*chain.from_iterable(columns)}))
