"""The one type that every kind of expert is turned into: a counted, checked black box."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, Protocol

import numpy as np
import torch

from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.batches import Batches
from fdtasil.experts.memory import Memory
from fdtasil.experts.sb3.trust import Trust
from fdtasil.experts.silence import Silence
from fdtasil.rollouts.behaviours import Policy, has_none
from fdtasil.rollouts.spaces import Spaces

__all__ = ["Expert", "Hints", "Origin", "Purpose"]

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


class Workers(Protocol):
    """Several that answer at once."""

    def each(
        self, ask: Callable[[np.ndarray, Policy], np.ndarray], batches: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """Return `ask(batch, answer)` of every batch, in their order, whoever answers it."""
        ...


@dataclass(frozen=True)
class Origin:
    """What is known of the file or object that an expert was opened from.

    Attributes:
        source: What to call it in reports, its path or address; None where it has none.
        sha256: Of its file, or None.
        columns: The coordinates that a student's file says it sees, or None.
        multiply_adds: At most how many a row takes, where the file says it; see `cost.py`.
        options: Those that it was opened with, in words; None for none.
    """

    source: str | None = None
    sha256: str | None = None
    columns: tuple[int, ...] | None = None
    multiply_adds: int | None = None
    options: str | None = None


@dataclass(frozen=True, repr=False)
class Expert:
    """A black box that answers observations with actions.

    Attributes:
        answer: (B, n) float32 raw observations -> (B, m) actions in environment units.
        name: What to call it in messages.
        observation_size: n, or None where the expert does not say.
        action_size: m, or None where the expert does not say.
        module: The same function as a differentiable torch module, or None; only the analytic
            reference (`probes="jacobian"`) uses it.
        jacobian: (B, n) observations -> (B, m, n) derivatives of the actions, where the expert
            may give them itself; or None.
        memory: What it carries along an episode, or None. Its observations are then those of the
            environment with the memory behind them; see `memory.py`.
        takes: The columns of an observation that it is given; None for all of them.
        own_form: Whether it takes observations as an environment has them, in a batch:
            dictionaries, stacks of frames; others take flat rows.
        spaces: Those that it was opened in, where they are no plain boxes; see `structure.py`.
        chunk: Rows asked at once.
        workers: Who answer chunks side by side instead of `answer`, or None; copies share them.
        queries: Rows asked so far, by purpose.
        silence: Where it had no answer; copies share it as they share the queries.
        seconds: What one query took when the gate asked, by "alone"; copies share it.
        origin: Where it came from.

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
    module: torch.nn.Module | None = None
    jacobian: Callable[[np.ndarray], np.ndarray] | None = None
    memory: Memory | None = None
    takes: tuple[int, ...] | None = None
    own_form: bool = False
    spaces: Spaces | None = None
    chunk: int = CHUNK
    workers: Workers | None = None
    queries: Counter[str] = field(default_factory=Counter)
    silence: Silence = field(default_factory=Silence)
    seconds: dict[str, float] = field(default_factory=dict)
    origin: Origin = field(default_factory=Origin)

    def __repr__(self) -> str:
        """Return its sizes and what it was asked, not the fields."""
        n, m = (str(size or "?") for size in (self.observation_size, self.action_size))
        memory = f" with a memory of {self.memory.size}" if self.memory else ""
        asked = f"{sum(self.queries.values()):,} queries"
        return f"Expert({self.name}: {n} observations -> {m} actions{memory}, {asked})"

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
        ask = self._batches().ask
        if self.workers is not None:
            parts = self.workers.each(ask, chunks)
        else:
            parts = [ask(chunk, self.answer) for chunk in chunks]
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

    def _batches(self) -> Batches:
        layout = self.spaces.observations if self.spaces and self.own_form else None
        parts = None if layout is None or layout.plain else layout.parts
        again = partial(self.count, purpose="check")
        return Batches(self.name, self.action_size, parts, self.silence, again)


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
