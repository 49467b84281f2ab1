"""The expert's answers around demonstrated states: asked in bounded blocks, kept in one array."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fdtasil.errors import ExpertError, SettingError, warn
from fdtasil.experts.expert import Expert, Purpose
from fdtasil.experts.silence import check_answered
from fdtasil.probes.derivatives import differentiate
from fdtasil.probes.surroundings import Drawn, Surroundings
from fdtasil.rollouts.behaviours import has_none

__all__ = ["FROM_THE_START", "Answers", "Beginning", "ask_moved", "ask_probes"]

# Points asked at once: as quick as more for an onnxruntime session, and of an expert that takes
# 50 ms a row no more than a minute is lost.
_ROWS = 2**10
_MUCH = 2**30  # bytes of answers that are announced before they are asked
_NEEDED = "they need"


@dataclass(frozen=True)
class Answers:
    """What the expert said around each state.

    Attributes:
        displacements: (P, n) float32 bank of displacements in raw observation units; for an
            exact stencil the directions that were differentiated along.
        numbers: (N, k) int32, the rows of the bank that each state was probed along.
        values: (N, k, p, m) float32 expert actions at state + offset * displacement for each of
            the stencil's p offsets; for an exact stencil they are the p first derivatives.
        gains: (P,) what turns a difference of values along each displacement into the whitened
            Jacobian's Frobenius norm, in expectation over directions: sqrt(d) / step.
    """

    displacements: np.ndarray
    numbers: np.ndarray
    values: np.ndarray
    gains: np.ndarray

    def __add__(self, other: "Answers") -> "Answers":
        """Join the answers of two rounds.

        A coordinate may begin to move in a later round, and a basis is longer by it then: states
        with fewer probes have some of them twice.
        """
        count = max(self.numbers.shape[1], other.numbers.shape[1])
        ours, theirs = (np.arange(count) % one.numbers.shape[1] for one in (self, other))
        later = other.numbers[:, theirs] + len(self.displacements)
        return Answers(
            np.concatenate([self.displacements, other.displacements]),
            np.concatenate([self.numbers[:, ours], later]),
            np.concatenate([self.values[:, ours], other.values[:, theirs]]),
            np.concatenate([self.gains, other.gains]),
        )

    def at(self, rows: np.ndarray) -> "Answers":
        """Return those around some states, given by their (S,) numbers."""
        return replace(self, numbers=self.numbers[rows], values=self.values[rows])

    def among(self, rows: np.ndarray, states: int) -> "Answers":
        """Return answers around `states` states, those of (S,) rows as here, the others empty."""
        if len(rows) == states:  # nothing is held out
            return self
        numbers = np.zeros((states, *self.numbers.shape[1:]), self.numbers.dtype)
        values = np.zeros((states, *self.values.shape[1:]), self.values.dtype)
        numbers[rows], values[rows] = self.numbers, self.values
        return replace(self, numbers=numbers, values=values)


@dataclass(frozen=True)
class Beginning:
    """What is there already of answers that take long to ask, and who hears of the others.

    Attributes:
        known: (S, k, p, m) answers around the first S states, or None.
        told: Given the (S, k, p, m) answers so far and how many states of them are new.
    """

    known: np.ndarray | None = None
    told: Callable[[np.ndarray, int], None] = lambda values, states: None


FROM_THE_START = Beginning()


def ask_probes(
    expert: Expert,
    around: Surroundings,
    random: np.random.Generator,
    order: int = 1,
    beginning: Beginning = FROM_THE_START,
    asked: Callable[[Drawn], np.ndarray] | None = None,
) -> Answers:
    """Ask the expert around each state; probes without an answer are left out.

    A state has others of its probes twice then, and one without any answer has its own label.

    Args:
        expert: Who is asked; differentiated instead, if the stencil is exact.
        around: Where.
        random: Draws the directions.
        order: 1, or 2 for exact second derivatives too; a finite stencil has them in its values.
        beginning: What is there already; not used where derivatives are exact.
        asked: Who answers instead of the expert, all at once; None for itself.

    Raises:
        ExpertError: If the stencil is exact and the expert can't be differentiated, or it has no
            answer at most of the moved states.
        SettingError: If a step is lost in rounding, or the answers do not fit into memory.
    """
    probes, observations = around.probes, around.observations
    assert probes.stencil is not None, "the order sets the stencil"
    try:
        _check_room(expert, around)
        drawn = around.sample(random)
        if asked is not None:
            values = asked(drawn)
        elif probes.exact:
            along = drawn.displacements, drawn.numbers
            values = differentiate(expert, observations, *along, order)
        else:
            offsets = probes.stencil.offsets
            values = _ask_values(expert, observations, drawn, offsets, beginning)
        answers = Answers(drawn.displacements, drawn.numbers, values, drawn.gains)
        return _without_silence(answers, expert, around)
    except MemoryError as error:
        numbers = str(error).startswith(_NEEDED) and f": {error}"
        raise SettingError(
            f"{probes.describe()!r} at {len(observations):,} states does not fit into memory"
            f"{numbers or ''}",
            "answers that do",
            "pass fewer probes: they teach alike",
        ) from error


def _without_silence(answers: Answers, expert: Expert, around: Surroundings) -> Answers:
    """Replace probes without an answer by others of their state."""
    silent = np.asarray(np.isnan(answers.values).any(axis=3))
    if not silent.any():
        return answers
    silence, count = expert.silence, int(silent.sum())
    check_answered(expert.name, silence, count, silent.size, "moved states")
    none = np.asarray(silent.any(axis=2))
    numbers, values, left = answers.numbers.copy(), answers.values.copy(), none.copy()
    for turn in range(1, none.shape[1]):  # the next one that has an answer
        others = np.roll(none, -turn, axis=1)
        found = left & ~others
        numbers[found] = np.roll(answers.numbers, -turn, axis=1)[found]
        values[found] = np.roll(answers.values, -turn, axis=1)[found]
        left &= ~found
    whole = Answers(answers.displacements, numbers, values, answers.gains)
    return _standing_still(whole, np.asarray(left.all(axis=1)), expert, around)


def _standing_still(
    answers: Answers, states: np.ndarray, expert: Expert, around: Surroundings
) -> Answers:
    """Let some states, (N,) bool, have probes that move nothing, which teach nothing new."""
    if not states.any():
        return answers
    if around.probes.exact:  # along no direction nothing changes
        said = np.zeros((int(states.sum()), answers.values.shape[-1]), np.float32)
    elif around.actions is not None:
        said = around.actions[states]
    else:
        said = expert.ask(around.observations[states], "probe")
        if has_none(said).any():
            raise ExpertError(
                f"{expert.name} has no answer at a state, and none around it",
                "one of them",
                "leave such states out",
            )
    numbers, values = answers.numbers.copy(), answers.values.copy()
    numbers[states], values[states] = len(answers.displacements), said[:, None, None, :]
    still = np.zeros((1, answers.displacements.shape[1]), np.float32)
    return Answers(
        np.concatenate([answers.displacements, still]),
        numbers,
        values,
        np.append(answers.gains, 1.0),
    )


def ask_moved(expert: Expert, points: np.ndarray, purpose: Purpose) -> np.ndarray:
    """Ask an expert about states that were moved, and say so where it can't answer.

    Raises:
        ExpertError: As `Expert.ask`.
    """
    try:
        return expert.ask(points, purpose)
    except ExpertError as error:
        beyond = (
            "; probes leave the bounds of the observations, so it must answer there as well, or "
            "the radius be smaller"
        )
        # A connection that broke says nothing of states.
        broken = isinstance(error.__cause__, OSError)
        step = error.next_step + ("" if broken else beyond)
        found = f"{error.found} (states moved by probes)"
        raise ExpertError(found, error.expected, step) from error


def _ask_values(
    expert: Expert,
    observations: np.ndarray,
    drawn: Drawn,
    offsets: Sequence[float],
    beginning: Beginning,
) -> np.ndarray:
    """Ask for the values at the stencil's points, a bounded number of rows at a time."""
    states, count = drawn.numbers.shape
    block = max(1, _ROWS // (count * len(offsets)))
    shifts = np.asarray(offsets, np.float32)[:, None]
    values, done = None, 0
    if beginning.known is not None:
        done = len(beginning.known)
        values = np.empty((states, *beginning.known.shape[1:]), np.float32)
        values[:done] = beginning.known
        beginning.told(values[:done], done)
    for start in range(done, states, block):
        rows = slice(start, start + block)
        moved = drawn.displacements[drawn.numbers[rows]][:, :, None, :] * shifts
        points = observations[rows, None, None, :] + moved
        _check_moved(points, observations[rows], drawn.displacements)
        answers = ask_moved(expert, points.reshape(-1, points.shape[-1]), "probe")
        if values is None:  # the first block says how long an action is
            values = np.empty((states, count, len(offsets), answers.shape[1]), np.float32)
            _announce(values)
        values[rows] = answers.reshape(*points.shape[:3], -1)
        beginning.told(values[: start + len(points)], len(points))
    assert values is not None, "there is no demonstration without a state"
    return values


def _check_room(expert: Expert, around: Surroundings) -> None:
    """Refuse what would take more than half of the machine's memory, before anybody is asked.

    The system hands out memory that it does not have, and kills who uses it.

    Raises:
        MemoryError: With the numbers.
    """
    (states, size), count, stencil = around.observations.shape, around.count, around.probes.stencil
    points = 1 if stencil is None else max(1, len(stencil.offsets))
    answers = 4 * states * count * (points * (expert.action_size or 1) + 1)
    # Of one state: its directions, drawn, of length one and scaled, and the points they lead to.
    at_once = count * size * (3 * 8 + 2 * 4 * points)
    there = _memory()
    if there is not None and answers + at_once > there / 2:
        raise MemoryError(
            f"{_NEEDED} {(answers + at_once) / 2**30:.3g} GiB, and at most half of "
            f"{there / 2**30:.3g} GiB are used"
        )


def _memory() -> int | None:
    """Return the bytes of memory that this process may use at most, or None if nobody says."""
    found = []
    with suppress(AttributeError, ValueError, OSError):  # Windows has no such call
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # of a container; "max" where there is none
        found.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(found, default=None)


def _announce(values: np.ndarray) -> None:
    """Say what the answers take where that is much; the memory is not touched yet."""
    if values.nbytes > _MUCH:
        warn(
            f"the expert's answers, {values.shape[0]:,} states x {values.shape[1]} probes, take "
            f"{values.nbytes / 2**30:.1f} GiB of memory; fewer probes take less and teach alike"
        )


def _check_moved(points: np.ndarray, centres: np.ndarray, displacements: np.ndarray) -> None:
    still = (points == centres[:, None, None, :]).all(axis=-1)
    if still.any() and displacements.any(axis=1).all():
        raise SettingError(
            f"{still.sum()} of {still.size} probes do not move the state: float32 rounds the "
            "step away",
            "a radius above the rounding of the observations",
            "raise the radius, or probe in whitened space",
        )
