"""One batch of questions: answered as it is or, where it raises, row by row."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fdtasil.errors import ExpertError, in_one_line
from fdtasil.experts.silence import Silence
from fdtasil.experts.worker_process import as_array
from fdtasil.rollouts.behaviours import Policy, has_none
from fdtasil.rollouts.spaces import Part

__all__ = ["Batches", "RaisedElsewhere"]


class RaisedElsewhere(Exception):
    """What an expert raised in another process, where the exception itself can't be sent.

    Args:
        kind: Its type's name.
        message: Its text.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True)
class Batches:
    """Asks batches of rows, whoever answers them, and finds the rows that have no answer.

    Attributes:
        name: Of the expert, in messages.
        action_size: m, or None where the expert does not say.
        parts: What it is given apart; None for flat rows.
        silence: Told of what has no answer, and why.
        again: Told how many rows are asked once more to find that out.
    """

    name: str
    action_size: int | None
    parts: tuple[Part, ...] | None
    silence: Silence
    again: Callable[[int], None]

    def ask(self, rows: np.ndarray, policy: Policy) -> np.ndarray:
        """Answer (B, n) rows with (B, m) actions; a row of NaN is no answer.

        Raises:
            ExpertError: If no row has one, not even one that had it before; if the shape is
                another, or an answer infinite.
        """
        said = None
        try:
            answers = self._checked(rows, policy)
        except _Raised as raised:
            answers, said = self._ask_alone(rows, policy, raised), raised.error
        none = has_none(answers)
        if not len(none):  # says nothing of what the expert answers
            return answers
        if none.all():
            self._check_control(policy, said or self._not_finite(len(rows), none))
        elif self.silence.answered is None:
            self.silence.answered = rows[~none][:1].copy()
        return answers

    def _ask_alone(self, rows: np.ndarray, policy: Policy, raised: "_Raised") -> np.ndarray:
        """Ask a batch that raised again, row by row, to find those that it belongs to.

        Raises:
            ExpertError: If it belongs to none of them.
        """
        if raised.everywhere:
            raise raised.error
        self.again(len(rows) if len(rows) > 1 else 0)
        found = self._each_alone(rows, policy, raised.error) if len(rows) > 1 else [None]
        answered = [answer for answer in found if answer is not None]
        if len(answered) == len(rows):
            raise raised.error  # of the batch, not of a row
        self.silence.reason = raised.text
        size = self.action_size or (answered[0].shape[1] if answered else 1)
        none = np.full((1, size), np.nan, np.float32)
        return np.concatenate([none if answer is None else answer for answer in found])

    def _each_alone(
        self, rows: np.ndarray, policy: Policy, error: ExpertError
    ) -> list[np.ndarray | None]:
        """Ask row by row; raise the error where it does not even answer what it did before."""
        found: list[np.ndarray | None] = []
        silent = 0  # in a row, up to here
        for row in rows:
            found.append(self._asked_alone(row[None], policy))
            silent = silent + 1 if found[-1] is None else 0
            # Seconds each, where it waits for a server or a solver that is gone.
            if silent in _DOUBTED and self.silence.answered is not None:
                self._check_control(policy, error)
        return found

    def _asked_alone(self, row: np.ndarray, policy: Policy) -> np.ndarray | None:
        try:
            return self._checked(row, policy)
        except _Raised as raised:
            if raised.everywhere:
                raise raised.error from raised
            return None

    def _check_control(self, policy: Policy, error: ExpertError) -> None:
        """Raise an error, unless the expert still answers what it has answered before."""
        control = self.silence.answered
        if control is None:
            raise error
        self.again(1)
        answer = self._asked_alone(control, policy)
        if answer is None or has_none(answer).any():
            raise error

    def _checked(self, rows: np.ndarray, policy: Policy) -> np.ndarray:
        """Return the answers to a batch as they are; rows of NaN are none.

        Raises:
            _Raised: What the expert raised.
            ExpertError: If the answers are none in shape, or infinite.
        """
        expected = self._expected(len(rows))
        try:
            # Each call gets a copy and its answer is copied: experts that write into their input
            # or return their own buffer would otherwise change what is stored.
            answer = as_array(policy(rows.copy()))
        except ExpertError:
            raise
        except Exception as error:
            flat = self.parts is None
            raise _Raised.of(self.name, len(rows), expected, error, self._given, flat) from error
        if answer.shape == (len(rows),) and self.action_size in (None, 1):
            answer = answer[:, None]  # of one action, as regressors and tree ensembles answer
        if answer.shape == (len(rows), 1) and self.action_size and np.isnan(answer).all():
            answer = np.repeat(answer, self.action_size, axis=1)  # nulls in the place of rows
        if answer.ndim != 2 or len(answer) != len(rows) or not self._has_action_size(answer):
            asked = len(rows) if self.parts else rows.shape
            given = f"; {self._given}" if self.parts else ""
            raise ExpertError(
                f"{self.name} answered {asked} observations with shape {answer.shape}{given}",
                expected,
                _advice(answer),
            )
        infinite = np.asarray(np.isinf(answer).any(axis=1))
        if infinite.any():
            raise self._not_finite(len(rows), infinite)
        return answer

    @property
    def _given(self) -> str:
        """What it is called with, for who called it wrongly."""
        if self.parts is None:
            return "experts answer (B, n) with (B, m)"
        parts = [f"{p.name or 'an array'} (B, {', '.join(map(str, p.shape))})" for p in self.parts]
        return f"it is given what the environment gives, in a batch: {', '.join(parts[:6])}"

    def _not_finite(self, rows: int, bad: np.ndarray) -> ExpertError:
        return ExpertError(
            f"{self.name} is not finite on {bad.sum()} of {rows} observations, "
            f"the first of them row {int(bad.argmax())}",
            self._expected(rows),
            "check its weights, and its answer to the observations that it is given",
        )

    def _expected(self, rows: int) -> str:
        return f"({rows}, {self.action_size or 'm'}) finite numbers"

    def _has_action_size(self, answer: np.ndarray) -> bool:
        return self.action_size is None or answer.shape[1] == self.action_size


def _advice(answer: np.ndarray) -> str:
    """Return what to do about answers of another shape."""
    if answer.ndim < 2 and answer.size and np.isnan(answer).all():
        return "in the place of None, return a row of NaN for each row that has no answer"
    return "return one row of actions for each row of observations"


class _Raised(Exception):
    """What an expert raised about a batch, as the error that it is if it belongs to no row.

    Args:
        error: The error.
        text: What was raised, in one line.
        everywhere: Whether it says nothing of single rows.
    """

    def __init__(self, error: ExpertError, text: str, *, everywhere: bool) -> None:
        super().__init__(text)
        self.error, self.text, self.everywhere = error, text, everywhere

    @classmethod
    def of(
        cls, name: str, rows: int, expected: str, error: Exception, given: str, flat: bool
    ) -> "_Raised":
        """Return what an exception on so many rows is."""
        kind = error.kind if isinstance(error, RaisedElsewhere) else type(error).__name__
        said = in_one_line(error)
        whole = ExpertError(
            f"{name} raised {kind} on {rows} observations: {said}",
            expected,
            f"call it on such a batch on its own; {given}"
            + (_EACH if kind in _OF_SHAPES and rows > 1 and flat else ""),
        )
        whole.__cause__ = error
        return cls(whole, f"{kind}: {said}", everywhere=kind in _NOT_OF_A_ROW)


_DOUBTED = (8, 64, 512)
"""Rows in a row without an answer, after which it is asked what it has answered before."""
_OF_SHAPES = {"ValueError", "TypeError", "IndexError"}
_EACH = ", one of a single state by lambda rows: np.stack([np.ravel(f(row)) for row in rows])"
_NOT_OF_A_ROW = {"MemoryError", "TimeoutError", "RecursionError"}
