"""The one type that every kind of expert is turned into: a counted, checked black box."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
import torch

from fdtasil.errors import ExpertError, SettingError, in_one_line
from fdtasil.experts.memory import Memory
from fdtasil.experts.sb3.trust import Trust
from fdtasil.experts.silence import Silence
from fdtasil.experts.worker_process import as_array
from fdtasil.rollouts.behaviours import Policy, has_none
from fdtasil.rollouts.spaces import Part, Spaces

__all__ = ["Expert", "Hints", "Purpose", "RaisedElsewhere"]

Purpose = Literal["check", "act", "label", "calibrate", "probe", "evaluate", "remember"]
"""Why a row was asked: gate, acting in rollouts, labels, radius, probes, evaluation, and what is
remembered after it."""

CHUNK = 1024  # rows asked at once; a fixed size keeps onnxruntime's memory from growing


@dataclass(frozen=True)
class Hints:
    """What a caller knows of an expert before it is opened.

    Attributes:
        observation_size: n, or None.
        action_size: m, or None; chooses among the outputs of an ONNX file.
        output: Name of the ONNX output that holds the actions, or None.
        inputs: What the inputs of an ONNX file are given, where it has several.
        memory: Inputs that hold a memory, and the outputs that it comes out of.
        trust: "pickle" where code inside a file may be run, "c" where a C file may be compiled.
        timeout: Seconds that a batch may take, or None.
        spaces: Of the environment, or None.
    """

    observation_size: int | None = None
    action_size: int | None = None
    output: str | None = None
    trust: Trust = None
    timeout: float | None = None
    inputs: Mapping[str, slice | np.ndarray] | None = None
    memory: Mapping[str, str] | None = None
    spaces: Spaces | None = None


class RaisedElsewhere(Exception):
    """What an expert raised in another process, where the exception itself can't be sent.

    Args:
        kind: Its type's name.
        message: Its text.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class Workers(Protocol):
    """Several that answer at once."""

    def each(
        self, ask: Callable[[np.ndarray, Policy], np.ndarray], batches: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """Return `ask(batch, answer)` of every batch, in their order, whoever answers it."""
        ...


@dataclass(frozen=True)
class Expert:
    """A black box that answers observations with actions.

    Attributes:
        answer: (B, n) float32 raw observations -> (B, m) actions in environment units.
        name: What to call it in messages.
        observation_size: n, or None where the expert does not say.
        action_size: m, or None where the expert does not say.
        sha256: Of the file it came from, or None.
        source: What to call it in reports, its path or address; None where it has none.
        columns: The coordinates that a student's file says it sees, or None.
        jacobian: (B, n) observations -> (B, m, n) derivatives of the actions, where the expert
            may give them itself; or None.
        takes: The columns of an observation that it is given; None for all of them.
        memory: What it carries along an episode, or None. Its observations are then those of the
            environment with the memory behind them; see `memory.py`.
        module: The same function as a differentiable torch module, or None; only the analytic
            reference (`probes="jacobian"`) uses it.
        multiply_adds: At most how many a row takes, where the file says it; see `cost.py`.
        chunk: Rows asked at once.
        workers: Who answer chunks side by side instead of `answer`, or None; copies share them.
        queries: Rows asked so far, by purpose.
        silence: Where it had no answer; copies share it as they share the queries.
        seconds: What one query took when the gate asked, by "alone"; copies share it.
        own_form: Whether it takes observations as an environment has them, in a batch:
            dictionaries, stacks of frames; others take flat rows.
        spaces: Those that it was opened in, where they are no plain boxes; see `structure.py`.
        opened: The options that it was opened with, in words; None for none.

    Example:
        >>> import numpy as np
        >>> expert = Expert(lambda x: 2 * x[:, :1], "twice the first coordinate")
        >>> expert.ask(np.ones((3, 4), np.float32), "probe").ravel(), dict(expert.queries)
        (array([2., 2., 2.], dtype=float32), {'probe': 3})
    """

    answer: Policy
    name: str
    observation_size: int | None = None
    action_size: int | None = None
    sha256: str | None = None
    module: torch.nn.Module | None = None
    chunk: int = CHUNK
    workers: Workers | None = None
    queries: Counter[str] = field(default_factory=Counter)
    source: str | None = None
    columns: tuple[int, ...] | None = None
    multiply_adds: int | None = None
    silence: Silence = field(default_factory=Silence)
    jacobian: Callable[[np.ndarray], np.ndarray] | None = None
    memory: Memory | None = None
    takes: tuple[int, ...] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    own_form: bool = False
    spaces: Spaces | None = None
    opened: str | None = None

    def ask(self, observations: np.ndarray, purpose: Purpose) -> np.ndarray:
        """Answer a batch and count its rows.

        Args:
            observations: (B, n) finite raw observations, in any type that numpy takes for
                numbers; not changed.
            purpose: The entry of the ledger that the rows are counted under.

        Returns:
            (B, m) float32 actions, in an array of their own. A row of NaN is no answer: the
            expert's own is one, or it raised about that row and not about others.

        Raises:
            ExpertError: If the expert raises whatever it is asked about, or its answer has
                another shape or is infinite.
            SettingError: If the observations are not finite numbers, or have another shape.
        """
        rows = self._rows(observations)
        self.count(len(rows), purpose)
        if self.takes is not None:
            rows = np.ascontiguousarray(rows[:, list(self.takes)])
        starts = range(0, max(len(rows), 1), self.chunk)
        chunks = [rows[start : start + self.chunk] for start in starts]
        if self.workers is not None:
            parts = self.workers.each(self._ask_chunk, chunks)
        else:
            parts = [self._ask_chunk(chunk, self.answer) for chunk in chunks]
        answers = np.concatenate(_equally_wide(parts, self.name))
        none = has_none(answers)
        if none.any():
            answers[none] = np.nan
            self.silence.rows[purpose] += int(none.sum())
        return answers

    def count(self, rows: int, purpose: Purpose) -> None:
        """Count rows that are answered, here or by a copy of what answers."""
        self.queries[purpose] += rows

    def policy(self, purpose: Purpose) -> Callable[[np.ndarray], np.ndarray]:
        """Return the expert as a policy whose rows are counted under `purpose`."""
        return lambda observations: self.ask(observations, purpose)

    def _rows(self, observations: np.ndarray) -> np.ndarray:
        """Return observations as (B, n) float32 in this machine's order of bytes."""
        plain = type(observations) is np.ndarray and observations.dtype == np.float32
        try:
            # What rollouts and probes ask is float32 already, and asked often.
            rows = np.ascontiguousarray(observations) if plain else _converted(observations)
            if np.ndim(observations) != 2 or self.observation_size not in (None, rows.shape[1]):
                raise ValueError(f"their shape is {np.shape(observations)}")
            finite = np.isfinite(rows)
            if not finite.all():
                row, column = np.argwhere(~finite)[0]
                raise ValueError(f"row {row} has {rows[row, column]} in column {column}")
        except (TypeError, ValueError) as error:
            raise SettingError(
                f"observations that {self.name} can't be asked about: {error}",
                f"(B, {self.observation_size or 'n'}) finite numbers",
                "see where they come from: from the environment, or from your own code",
            ) from error
        return rows

    def _ask_chunk(self, rows: np.ndarray, ask: Policy) -> np.ndarray:
        said = None
        try:
            answers = self._checked(rows, ask)
        except _Raised as raised:
            answers, said = self._ask_alone(rows, ask, raised), raised.error
        none = has_none(answers)
        if not len(none):  # says nothing of what the expert answers
            return answers
        if none.all():
            self._check_control(ask, said or _not_finite(self, len(rows), none))
        elif self.silence.answered is None:
            self.silence.answered = rows[~none][:1].copy()
        return answers

    def _ask_alone(self, rows: np.ndarray, ask: Policy, raised: "_Raised") -> np.ndarray:
        """Ask a batch that raised again, row by row, to find those that it belongs to.

        Raises:
            ExpertError: If it belongs to none of them.
        """
        if raised.everywhere:
            raise raised.error
        self.count(len(rows) if len(rows) > 1 else 0, "check")
        found = self._each_alone(rows, ask, raised.error) if len(rows) > 1 else [None]
        answered = [answer for answer in found if answer is not None]
        if len(answered) == len(rows):
            raise raised.error  # of the batch, not of a row
        self.silence.reason = raised.text
        size = self.action_size or (answered[0].shape[1] if answered else 1)
        none = np.full((1, size), np.nan, np.float32)
        return np.concatenate([none if answer is None else answer for answer in found])

    def _each_alone(
        self, rows: np.ndarray, ask: Policy, error: ExpertError
    ) -> list[np.ndarray | None]:
        """Ask row by row; raise the error where it does not even answer what it did before."""
        found: list[np.ndarray | None] = []
        silent = 0  # in a row, up to here
        for row in rows:
            found.append(self._asked_alone(row[None], ask))
            silent = silent + 1 if found[-1] is None else 0
            # Seconds each, where it waits for a server or a solver that is gone.
            if silent in _DOUBTED and self.silence.answered is not None:
                self._check_control(ask, error)
        return found

    def _asked_alone(self, row: np.ndarray, ask: Policy) -> np.ndarray | None:
        try:
            return self._checked(row, ask)
        except _Raised as raised:
            if raised.everywhere:
                raise raised.error from raised
            return None

    def _check_control(self, ask: Policy, error: ExpertError) -> None:
        """Raise an error, unless the expert still answers what it has answered before."""
        control = self.silence.answered
        if control is None:
            raise error
        self.count(1, "check")
        answer = self._asked_alone(control, ask)
        if answer is None or has_none(answer).any():
            raise error

    def _checked(self, rows: np.ndarray, ask: Policy) -> np.ndarray:
        """Return the answers to a batch as they are; rows of NaN are none.

        Raises:
            _Raised: What the expert raised.
            ExpertError: If the answers are none in shape, or infinite.
        """
        expected = f"({len(rows)}, {self.action_size or 'm'}) finite numbers"
        try:
            # Each call gets a copy and its answer is copied: experts that write into their input
            # or return their own buffer would otherwise change what is stored.
            answer = as_array(ask(rows.copy()))
        except ExpertError:
            raise
        except Exception as error:
            flat = self._parts is None
            raise _Raised.of(self.name, len(rows), expected, error, self._given, flat) from error
        if answer.shape == (len(rows), 1) and self.action_size and np.isnan(answer).all():
            answer = np.repeat(answer, self.action_size, axis=1)  # nulls in the place of rows
        if answer.ndim != 2 or len(answer) != len(rows) or not self._has_action_size(answer):
            raise ExpertError(
                f"{self.name} answered {rows.shape} observations with shape {answer.shape}",
                expected,
                _advice(answer, len(rows), self.action_size),
            )
        infinite = np.asarray(np.isinf(answer).any(axis=1))
        if infinite.any():
            raise _not_finite(self, len(rows), infinite)
        return answer

    @property
    def _parts(self) -> tuple[Part, ...] | None:
        """What it is given apart; None for flat rows."""
        layout = self.spaces.observations if self.spaces and self.own_form else None
        return None if layout is None or layout.plain else layout.parts

    @property
    def _given(self) -> str:
        """What it is called with, for who called it wrongly."""
        if self._parts is None:
            return "experts answer (B, n) with (B, m)"
        parts = [
            f"{p.name or 'an array'} (B, {', '.join(map(str, p.shape))})" for p in self._parts
        ]
        return f"it is given what the environment gives, in a batch: {', '.join(parts[:6])}"

    def _has_action_size(self, answer: np.ndarray) -> bool:
        return self.action_size is None or answer.shape[1] == self.action_size


def _advice(answer: np.ndarray, rows: int, action_size: int | None) -> str:
    """Return what to do about answers of another shape."""
    if answer.ndim < 2 and answer.size and np.isnan(answer).all():
        return "in the place of None, return a row of NaN for each row that has no answer"
    if answer.shape == (rows,) and action_size in (None, 1):
        return "of one action, return found[:, None]: a row for each row of observations"
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


def _equally_wide(parts: Sequence[np.ndarray], name: str) -> list[np.ndarray]:
    """Return answers of one width: where all rows of a batch had none, it was not known.

    Raises:
        ExpertError: If there are several.
    """
    width = max(part.shape[1] for part in parts)
    wide = [
        np.repeat(part, width, axis=1)
        if part.shape[1] == 1 < width and np.isnan(part).all()
        else part
        for part in parts
    ]
    if len(widths := {part.shape[1] for part in wide}) > 1:
        raise ExpertError(
            f"{name} answered some batches with {min(widths)} actions, others with {width}",
            "as many for each",
            "return one row of actions for each row of observations",
        )
    return wide


def _not_finite(expert: Expert, rows: int, bad: np.ndarray) -> ExpertError:
    return ExpertError(
        f"{expert.name} is not finite on {bad.sum()} of {rows} observations, "
        f"the first of them row {int(bad.argmax())}",
        f"({rows}, {expert.action_size or 'm'}) finite numbers",
        "check its weights, and its answer to the observations that it is given",
    )


def _converted(observations: object) -> np.ndarray:
    """Return numbers of any type as float32, in an array of one axis at least."""
    if isinstance(observations, torch.Tensor):
        observations = observations.detach().cpu().numpy()
    if np.ma.is_masked(observations):
        raise ValueError("some of them are masked")
    given = np.asarray(observations)
    if given.dtype.kind not in "biufO":
        raise ValueError(f"numpy takes them for {given.dtype}")
    with np.errstate(over="ignore"):  # what is infinite then is refused
        return np.ascontiguousarray(given, np.float32)


def rows_text(queries: Mapping[str, int]) -> str:
    """Return rows by purpose as one line of text, without those that are none."""
    return ", ".join(f"{purpose} {rows:,}" for purpose, rows in queries.items() if rows)
