"""What the student sees of what the expert sees."""

import operator
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fdtasil.checks import spelt
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError, first_line
from fdtasil.probes.answers import Answers
from fdtasil.rollouts.behaviours import Policy

__all__ = [
    "StudentObservation",
    "Unseen",
    "View",
    "describe_view",
    "sees_as",
    "view_size",
    "visible",
]

StudentObservation = Sequence[int] | Sequence[str] | Callable[[np.ndarray], np.ndarray]
"""Indices of the coordinates that the student sees, names of parts, or (B, n) -> (B, k)."""

_ROUNDINGS = 4  # of float32, in the difference of two steps
_SAME = 1e-4  # relative; beyond the rounding of float32, below any nonlinearity worth the name
_LEAST_SPREAD = 1e-3  # of a coordinate that does not change


def _whole(rows: np.ndarray) -> np.ndarray:
    return rows


@dataclass(frozen=True)
class _Columns:
    """(B, n) -> (B, k), a choice of coordinates."""

    indices: tuple[int, ...]

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        return rows[:, list(self.indices)]


@dataclass(frozen=True)
class Unseen:
    """Stands for a function of the user that no file or pickle holds.

    Attributes:
        name: What the function is called.
    """

    name: str

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Refuse to look.

        Raises:
            SettingError: Always.
        """
        raise self.lost

    @property
    def lost(self) -> SettingError:
        """What is said of it."""
        return SettingError(
            f"the student sees through {self.name}, which no file can hold",
            "the function itself",
            "pass it: Distilled.load(folder, student_obs=...)",
        )


@dataclass(frozen=True)
class View:
    """The student's part of an observation.

    Attributes:
        look: (B, n) -> (B, k).
        columns: The indices, where the view is a choice of coordinates; else None.
        size: k.
        seen: (n,) bool, the coordinates that the view depends on; only these are probed.
    """

    look: Callable[[np.ndarray], np.ndarray]
    columns: tuple[int, ...] | None
    size: int
    seen: np.ndarray

    @staticmethod
    def of(student_obs: StudentObservation | None, states: np.ndarray) -> "View":
        """Read the argument `student_obs`.

        Args:
            student_obs: Indices or a function; None for the whole observation.
            states: (B, n) states, around which the function's dependence is measured.

        Raises:
            SettingError: If indices are outside the observation, or the function does not map
                (B, n) to (B, k) row by row.
        """
        n = states.shape[1]
        if student_obs is None:
            return View(_whole, None, n, np.ones(n, bool))
        if callable(student_obs) and not isinstance(student_obs, type):
            return _from_function(student_obs, states)
        columns = _indices(student_obs, n)
        seen = np.isin(np.arange(n), columns)
        return View(_Columns(columns), columns, len(columns), seen)

    @property
    def is_whole(self) -> bool:
        """Whether it is the observation itself."""
        return self.look is _whole

    def __reduce__(self) -> tuple[object, ...]:
        """Leave out a function that can't be pickled, such as a lambda: the rest is not lost."""
        look = self.look
        try:
            pickle.dumps(look)
        except Exception:  # functions of users raise anything
            look = Unseen(_called(look))
        return View, (look, self.columns, self.size, self.seen)

    def policy(self, student: Policy) -> Policy:
        """Return the student as a policy on whole observations."""
        return lambda observations: student(self.look(observations))

    def demonstrations(self, whole: Demonstrations) -> Demonstrations:
        """Return the demonstrations as the student sees them."""
        seen = np.ascontiguousarray(self.look(whole.observations), np.float32)
        return replace(whole, observations=seen)

    def answers(self, whole: Answers, states: np.ndarray, offsets: Sequence[float]) -> Answers:
        """Return the probes as the student sees them.

        Args:
            whole: The expert's answers.
            states: (N, n) the states that they belong to.
            offsets: Of the stencil, which a curved view does not keep.

        Raises:
            SettingError: If the view is curved and the stencil has points on both sides.
        """
        if self.columns is not None:
            bank = np.ascontiguousarray(whole.displacements[:, list(self.columns)])
            return replace(whole, displacements=bank)
        if self.is_whole:
            return whole
        bank = self.steps(states, whole.displacements[whole.numbers], offsets)
        bank = bank.reshape(-1, self.size).astype(np.float32)
        numbers = np.arange(len(bank), dtype=np.int32).reshape(whole.numbers.shape)
        gains = whole.gains[whole.numbers].reshape(-1)
        return Answers(bank, numbers, whole.values, gains)

    def steps(self, states: np.ndarray, moved: np.ndarray, offsets: Sequence[float]) -> np.ndarray:
        """Return (N, k, size) steps of the view of (N, n) states that are moved by (N, k, n).

        Raises:
            SettingError: As `answers`.
        """
        centres = self.look(states)
        # Exact derivatives have no offsets: a view that is linear keeps them too.
        sides = offsets or (1.0, -1.0)
        steps = [self._step(states, centres, offset * moved) / offset for offset in sides]
        near = _rounding(states, centres, moved, steps[0]) if len(steps) > 1 else 0.0
        if not all(np.allclose(steps[0], step, rtol=0.01, atol=near) for step in steps[1:]):
            raise SettingError(
                "student_obs is a curved function, and the derivatives are exact or central",
                "a linear function, indices, or the forward stencil",
                'write for example probes="sphere:10,forward"',
            )
        return steps[0]

    def _step(self, states: np.ndarray, centres: np.ndarray, moved: np.ndarray) -> np.ndarray:
        points = states[:, None, :] + moved
        seen = self.look(points.reshape(-1, points.shape[-1]))
        return seen.reshape(*points.shape[:2], -1) - centres[:, None, :]


def _rounding(
    states: np.ndarray, centres: np.ndarray, moved: np.ndarray, step: np.ndarray
) -> np.ndarray:
    """Return how far (N, k, size) steps of a linear view may be apart, for each coordinate.

    Beside the largest step, whatever its unit, it is what float32 rounds away of the moved
    points, and of what the view makes of them.
    """
    largest, farthest = (np.abs(one).max(axis=(0, 1), initial=0.0) for one in (step, moved))
    rounded = np.spacing(np.abs(states).max(axis=0, initial=0.0))
    lost = np.divide(rounded, farthest, out=np.zeros(len(farthest)), where=farthest > 0)
    own = np.spacing(np.abs(centres).max(axis=0, initial=0.0))
    return (_SAME + _ROUNDINGS * lost.max(initial=0.0)) * largest + _ROUNDINGS * own


def sees_as(one: View, other: View, states: np.ndarray) -> bool:
    """Whether two views of (B, n) states, and of states around them, are the same."""
    n = states.shape[1]
    chosen = [(*range(n),) if view.is_whole else view.columns for view in (one, other)]
    if one.size != other.size:
        return False
    if None not in chosen:
        return chosen[0] == chosen[1]
    spread = np.maximum(states.std(axis=0), _LEAST_SPREAD)
    noise = np.random.default_rng(0).standard_normal(states.shape) * spread
    around = np.concatenate([states, (states + noise).astype(states.dtype)])
    ours, theirs = (np.asarray(view.look(around), np.float64) for view in (one, other))
    # Beside how far they go: a pressure's tenth of a per mille is more than it varies.
    near = _SAME * theirs.std(axis=0) + _ROUNDINGS * np.spacing(
        np.abs(theirs).max(axis=0).astype(np.float32)
    )
    apart = np.abs(ours - theirs)
    return bool(((apart <= near) | (np.isnan(ours) & np.isnan(theirs))).all())


def view_size(student_obs: StudentObservation | None, n: int) -> int | None:
    """Return how many of n coordinates a student sees; None where only asking tells."""
    if student_obs is None:
        return n
    return None if callable(student_obs) else len(_indices(student_obs, n))


def describe_view(student_obs: object, n: int) -> tuple[int, ...] | str | None:
    """Return a view of n coordinates as it is written into a configuration.

    Raises:
        SettingError: If it is neither a function nor a choice of them.
    """
    if student_obs is None:
        return None
    if callable(student_obs) and not isinstance(student_obs, type):
        return _called(student_obs)
    return _indices(student_obs, n)


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
        return _Own(student_obs, own)
    return describe_view(student_obs, own)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class _Own:
    """A user's function, of the environment's own part of an observation."""

    function: Callable[[np.ndarray], np.ndarray]
    size: int

    @property
    def __name__(self) -> str:
        return _name_of(self.function)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        return self.function(rows[:, : self.size])


def _called(function: Callable[..., object]) -> str:
    return f"the function {_name_of(function)}"


def _name_of(function: Callable[..., object]) -> str:
    return getattr(function, "__name__", type(function).__name__)


def _indices(student_obs: object, n: int) -> tuple[int, ...]:
    expected = f"indices from 0 to {n - 1}, each once; {n} times True or False; or a function"
    columns: tuple[int, ...] = ()
    with suppress(TypeError, ValueError, OverflowError):
        mask = np.asarray(student_obs)
        if mask.dtype != bool:
            columns = tuple(operator.index(index) for index in student_obs)  # pyright: ignore
        elif mask.shape == (n,):
            columns = tuple(np.flatnonzero(mask).tolist())
    distinct = len(set(columns)) == len(columns)
    inside = bool(columns) and distinct and all(0 <= i < n for i in columns)
    if not inside or np.ma.is_masked(student_obs):
        example = f"write for example student_obs=range({min(n, 10)})"
        raise SettingError(spelt("student_obs", student_obs), expected, example)
    return columns


@dataclass(frozen=True)
class _Copying:
    """A user's function, which may work in place or return the same buffer each time."""

    function: Callable[[np.ndarray], np.ndarray]

    @property
    def __name__(self) -> str:
        return _name_of(self.function)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        return np.array(self.function(rows.copy()))


def _from_function(given: Callable[[np.ndarray], np.ndarray], states: np.ndarray) -> View:
    n, function = states.shape[1], _Copying(given)
    shape = (len(states), given.size if isinstance(given, _Own) else n)
    try:
        found, alone = np.asarray(function(states)), np.asarray(function(states[:1]))
    except Exception as error:
        raise SettingError(
            f"student_obs raised {type(error).__name__} on {shape} observations: "
            f"{first_line(error)}",
            "a function (B, n) -> (B, k) of each row on its own",
            "call it on such a batch on its own, and mend it",
        ) from error
    if found.ndim != 2 or len(found) != len(states) or not np.allclose(alone[0], found[0]):
        raise SettingError(
            f"student_obs maps {shape} to {found.shape}",
            "a function (B, n) -> (B, k) of each row on its own",
            "index or transform the last axis only",
        )
    spread = np.maximum(states.std(axis=0), _LEAST_SPREAD)
    seen = [
        not np.array_equal(np.asarray(function(states + spread * (np.arange(n) == i))), found)
        for i in range(n)
    ]
    return View(function, None, found.shape[1], np.array(seen))
