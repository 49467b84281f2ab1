"""Constraints of a task: how often a policy violates them."""

from collections.abc import Callable, Mapping

import numpy as np

from fdtasil.checks import spelt
from fdtasil.errors import SettingError, first_line
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes

__all__ = ["Constraints", "check_constraints", "try_constraints", "violated"]

Constraint = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(N, n) observations and the (N, m) actions taken there -> (N,) numbers, positive where it is
violated."""

Constraints = Mapping[str, Constraint]
"""By the name that each is told by."""

_CONSTRAINTS = "names, each with a function of (N, n) observations and (N, m) actions"
_LIMIT = 'write for example constraints={"rail": lambda x, u: abs(x[:, 0]) - 1}'


def check_constraints(constraints: object) -> Constraints:
    """Refuse what are no constraints.

    Raises:
        SettingError: If they are something else.
    """
    good = isinstance(constraints, Mapping) and all(
        isinstance(name, str) and callable(one) for name, one in constraints.items()
    )
    if not good:
        raise SettingError(spelt("constraints", constraints), _CONSTRAINTS, _LIMIT)
    return constraints  # pyright: ignore[reportReturnType]


def violated(
    constraints: Constraints, episodes: Episodes, pool: EnvironmentPool, own: int | None
) -> dict[str, float]:
    """Return the share of the steps at which each constraint is violated.

    Args:
        constraints: From `check_constraints`.
        episodes: What was seen and done.
        pool: The environment.
        own: Length of the environment's own observations, which constraints are functions of; the
            whole of them if left out.

    Raises:
        SettingError: If one raises, or returns something else than a number for each step.
    """
    states = episodes.observations[episodes.valid][:, :own]
    actions, _ = pool.bounds.put_inside(episodes.actions[episodes.valid])
    return {
        name: float((_values(name, constraint, states, actions, pool) > 0).mean())
        for name, constraint in constraints.items()
    }


def try_constraints(
    constraints: Constraints, states: np.ndarray, actions: np.ndarray, pool: EnvironmentPool
) -> None:
    """Call each constraint on a few rows, before anything is recorded for them.

    Args:
        constraints: From `check_constraints`.
        states: (N, n) observations; a memory behind the environment's own is left out.
        actions: (N, m) as the environment takes them.
        pool: The environment.

    Raises:
        SettingError: If one raises, or returns something else than a number for each step.
    """
    own = states[:, : pool.spaces.observations.size]
    for name, constraint in constraints.items():
        with np.errstate(all="ignore"):  # nobody takes these actions
            _values(name, constraint, own, actions, pool, taken=False)


def _values(
    name: str,
    constraint: Constraint,
    states: np.ndarray,
    actions: np.ndarray,
    pool: EnvironmentPool,
    *,
    taken: bool = True,
) -> np.ndarray:
    try:
        found = np.asarray(constraint(states.copy(), actions.copy()), np.float64)
    except Exception as error:
        said = f"constraints: {name!r} raised {type(error).__name__}: {first_line(error)}"
        order = pool.spaces.observations.order
        flat = f"; an observation is {order}" if order else ""
        raise SettingError(said, f"{_CONSTRAINTS}{flat}", _LIMIT) from error
    if found.shape != (len(states),) or (taken and np.isnan(found).any()):
        nan = "NaN in " if np.isnan(found).any() else ""
        said = f"constraints: {name!r} returned {nan}shape {found.shape}"
        raise SettingError(said, f"({len(states)},) numbers, positive where violated", _LIMIT)
    return found
