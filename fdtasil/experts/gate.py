"""The gate: what an expert must show on real states before anything is spent on it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.errors import ExpertError, FdtasilError, warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.silence import check_answered
from fdtasil.rollouts.behaviours import farthest_apart, has_none
from fdtasil.rollouts.environments import Boxes, bounds_text

__all__ = [
    "GATE_QUERIES",
    "GATE_STATES",
    "Finding",
    "admit_expert",
    "compare_again",
    "examine_expert",
    "large_batch",
    "raise_problems",
]

GATE_STATES = 16
"""States that the gate asks about, before and after the expert's first rollouts."""
GATE_QUERIES = 3 * GATE_STATES
"""What it asks each time: every state in a batch, once more, and alone."""

# Differences between two answers, as a share of the action range. Batches of another size change
# the last bits of a float32 product; quantised and stochastic experts change the third digit.
_SAME = 1e-4
_LEAST = 0.1  # of an action's size, what counts as its range at least
# Of the bounds' range too, times _SAME: a last layer that scales to them rounds by some digits of
# float32 more.
_SCALED = 0.1


@dataclass(frozen=True)
class Finding:
    """One check's outcome.

    Attributes:
        name: What was checked.
        measured: What was found, in words.
        problem: The error that it amounts to, or None.
    """

    name: str
    measured: str
    problem: FdtasilError | None


def large_batch(rows: int, chunk: int) -> int:
    """Return how many rows the gate asks at once, where so many will be asked in all.

    Fewer than the rows of small batches are none: those have been asked.
    """
    most = min(rows, chunk)
    return most if most > GATE_STATES else 0


def examine_expert(expert: Expert, observations: np.ndarray, boxes: Boxes) -> list[Finding]:
    """Check an expert on real states without raising.

    Args:
        expert: The expert; about three rows are asked for each observation, and one whole batch
            of `expert.chunk` rows.
        observations: (B, n) float32 states of the environment, B at least 2; 32 are plenty.
        boxes: The environment's spaces.

    Returns:
        One finding for each check, in the order: answers (shape and finiteness), determinism,
        batch independence, large batches, action bounds, action scale. An expert that can't
        answer has the first finding only.
    """
    largest = large_batch(expert.chunk, expert.chunk)
    return _examine(expert, observations, boxes, largest)


def _examine(
    expert: Expert,
    observations: np.ndarray,
    boxes: Boxes,
    largest: int,
    announce: Callable[[float], None] = lambda seconds: None,
) -> list[Finding]:
    """Return the findings; the seconds that a row takes are announced before the large batch."""
    times = [time.perf_counter()]
    try:
        answers = expert.ask(observations, "check")
        times.append(time.perf_counter())
        again = expert.ask(observations, "check")
        times.append(time.perf_counter())
        alone, each = _one_by_one(expert, observations)
    except ExpertError as error:
        return [Finding("answers", error.found, error)]
    # The first query may start workers, and any may meet a busy machine: the quickest counts.
    announce(float(min(*np.diff(times), sum(each))) / len(observations))
    expert.seconds["alone"] = float(np.median(each))
    none = has_none(answers) | has_none(again) | has_none(alone)
    measured = f"{answers.shape[1]} finite numbers for each observation"
    if none.any():
        measured += f", none at {none.sum()} of {len(none)}"
        try:
            check_answered(
                expert.name, expert.silence, int(none.sum()), len(none), "visited states"
            )
        except ExpertError as error:
            return [Finding("answers", error.found, error)]
        parts = (observations, answers, again, alone)
        observations, answers, again, alone = (part[~none] for part in parts)
    probe = _Answers(expert, observations, answers, boxes)
    found = Finding("answers", measured, None)
    return [
        found,
        probe.same(again, "determinism", "asked twice", _STOCHASTIC),
        probe.alone(alone),
        probe.in_large_batches(largest),
        probe.within_bounds(),
        probe.fills_bounds(),
    ]


def _one_by_one(expert: Expert, observations: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Return the answers to single rows, and the seconds of each."""
    found, seconds = [], []
    for row in observations:
        begun = time.perf_counter()
        found.append(expert.ask(row[None], "check"))
        seconds.append(time.perf_counter() - begun)
    return np.concatenate(found), seconds


def admit_expert(
    expert: Expert,
    observations: np.ndarray,
    boxes: Boxes,
    *,
    force: bool = False,
    largest: int = 0,
    announce: Callable[[float], None] = lambda seconds: None,
) -> None:
    """Check an expert on real states, and raise what is wrong with it.

    Args:
        expert: The expert.
        observations: (B, n) float32 states of the environment, B at least 2.
        boxes: The environment's spaces.
        force: Warn instead of raising, where the expert answers at all.
        largest: Rows of the large batch that is asked too; see `large_batch`.
        announce: Told the seconds that a row takes, before that batch.

    Raises:
        ExpertError: The first problem found.
    """
    findings = _examine(expert, observations, boxes, largest, announce)
    raise_problems(findings, force=force)


def compare_again(
    expert: Expert, observations: np.ndarray, answers: np.ndarray, width: np.ndarray
) -> None:
    """Ask an expert again at the end of a run, and warn where it answers otherwise than before.

    It is no error: what was trained would be lost by it.

    Args:
        expert: The expert.
        observations: (N, n) states of the run.
        answers: (N, m) what it answered there.
        width: (m,) from each action's lower bound to its upper one.
    """
    chosen = np.linspace(0, len(observations) - 1, GATE_STATES).round().astype(int)
    before = answers[chosen]
    try:
        now = expert.ask(observations[chosen], "check")
    except ExpertError as error:
        warn(f"asked again at the end of the run, the expert failed: {error.found}")
        return
    none = has_none(now)
    if none.all():
        warn("asked again at the end of the run, the expert has no answer where it had one")
        return
    apart, units = np.abs(now - before)[~none], _ranges(answers, width)
    farther = apart.max(axis=0) / units
    if farther.max() <= _SAME:
        return
    usual = np.abs(before - before.mean(axis=0)).max(axis=0) / units
    most = apart[:, farther.argmax()].max()
    other = (
        "altogether other actions, so do not rely on this student: "
        if (farther > np.maximum(usual, _SAME)).any()
        else ""
    )
    warn(
        f"{expert.name} has changed during the run: asked again at {GATE_STATES} states, its "
        f"answers differ by up to {most:.2g} from those at the beginning; {other}"
        "look for memory, noise or a clock in it, or for a server whose model was replaced"
    )


def raise_problems(findings: Sequence[Finding], *, force: bool) -> None:
    """Raise the first problem among `findings`, or warn of all of them if `force`."""
    for finding in findings:
        if finding.problem is None:
            continue
        if not force or finding.name == "answers":
            raise finding.problem
        warn(f"{finding.problem.found} (forced)")


_STOCHASTIC = (
    "equal answers to equal observations, without noise, and without memory of earlier ones",
    "export the deterministic policy (its mean); what remembers says so with predict("
    "observations, state, episode_start) -> (actions, state); or pass force=True (--force)",
)
_LARGE = (
    "the same answers in batches of any size",
    "mend what depends on the size, or write load_expert(..., batch={})",
)
_BATCH_DEPENDENT = (
    "an answer that depends on its own row only",
    "ask row by row with load_expert(..., batch=1), or quantise statically",
)


@dataclass(frozen=True)
class _Answers:
    """The answers that the checks share."""

    expert: Expert
    observations: np.ndarray
    answers: np.ndarray
    boxes: Boxes

    def same(self, other: np.ndarray, name: str, how: str, advice: tuple[str, str]) -> Finding:
        difference, unit = farthest_apart(self.answers, other), self._ranges
        measured = f"{how}: largest difference {difference:.1e}"
        if farthest_apart(self.answers / unit, other / unit) <= _SAME:
            return Finding(name, measured, None)
        found = f"{self.expert.name} {how} differs by up to {difference:.2g}"
        return Finding(name, measured, ExpertError(found, *advice))

    def alone(self, other: np.ndarray) -> Finding:
        """Compare with answers to single rows; what differs between two of them is noise."""
        found = self.same(
            other, "batch independence", "asked alone and in a batch", _BATCH_DEPENDENT
        )
        if found.problem is None:
            return found
        try:
            again, _ = _one_by_one(self.expert, self.observations)
        except ExpertError as error:
            return Finding("answers", error.found, error)
        if not self._apart(again, other)[0]:
            return found
        text = f"{self.expert.name} asked the same single observations twice differs"
        return Finding(found.name, found.measured, ExpertError(text, *_STOCHASTIC))

    def in_large_batches(self, rows: int) -> Finding:
        """Ask as many rows at once as probes will be; the states are few, and are repeated."""
        name = "large batches"
        if not rows:
            return Finding(name, "none are asked", None)
        repeats = -(-rows // len(self.observations))
        advice = _LARGE[0], _LARGE[1].format(len(self.observations))
        try:
            many = np.tile(self.observations, (repeats, 1))[:rows]
            answers = self.expert.ask(many, "check")
            wrong, most = self._apart(answers, np.tile(self.answers, (repeats, 1))[:rows])
            measured = f"{rows:,} rows at once: largest difference {most:.1e}"
            if not wrong:
                return Finding(name, measured, None)
            # The size, or chance that few rows did not show: the same batch once more tells.
            again, farthest = self._apart(self.expert.ask(many, "check"), answers)
        except ExpertError as error:
            # Named so that nothing can force it: the probes would meet it after hours.
            return Finding("answers", error.found, ExpertError(error.found, *advice))
        if again:
            found = (
                f"{self.expert.name} asked the same {rows:,} observations twice differs at "
                f"{again:,} of them, by up to {farthest:.2g}"
            )
            return Finding(name, measured, ExpertError(found, *_STOCHASTIC))
        found = (
            f"{self.expert.name} answers {wrong:,} of {rows:,} observations at once otherwise "
            f"than few, by up to {most:.2g}"
        )
        return Finding(name, measured, ExpertError(found, *advice))

    def _apart(self, ours: np.ndarray, theirs: np.ndarray) -> tuple[int, float]:
        """Return at how many rows answers differ, and by how much at most."""
        difference = np.nan_to_num(np.abs(ours - theirs), nan=0.0)
        wrong = (difference > _SAME * self._ranges).any(axis=1)
        return int(wrong.sum()), float(difference.max())

    def within_bounds(self) -> Finding:
        low, high = self.boxes.low, self.boxes.high
        beyond = np.maximum(self.answers - high, low - self.answers)
        width = np.where(np.isfinite(self._width), self._width, self._ranges)
        outside = float((beyond > _SAME * width).any(axis=1).mean())
        measured = f"{100 * outside:.0f} % of the states have an action outside the bounds"
        if outside == 0:
            return Finding("action bounds", measured, None)
        found = (
            f"{self.expert.name} leaves the action bounds at {100 * outside:.0f} % of the states, "
            f"by up to {float(beyond.max()):.2g}"
        )
        problem = ExpertError(
            found,
            f"actions from {bounds_text(low, high)}",
            "put scaling and clipping inside the expert, or pass force=True (--force on the "
            "command line) to let the environment clip",
        )
        return Finding("action bounds", measured, problem)

    def fills_bounds(self) -> Finding:
        """Warn of an actor in [-1, 1] whose actions were to be scaled to wider bounds."""
        sizes = np.abs(self.answers)
        largest, saturated = float(sizes.max()), float((sizes > 0.99).mean())
        wider = float(min(-self.boxes.low.max(), self.boxes.high.min()))
        bounds = bounds_text(self.boxes.low, self.boxes.high)
        measured = f"largest action {largest:.3g}, bounds {bounds}"
        if 1.5 <= wider < np.inf and largest <= 1.0 + 1e-6 and saturated > 0.1:
            warn(
                f"all actions of {self.expert.name} lie in [-1, 1], the bounds are +-{wider:.3g}: "
                "is the action scale missing from the export?"
            )
        return Finding("action scale", measured, None)

    @property
    def _width(self) -> np.ndarray:
        return self.boxes.high.astype(np.float64) - self.boxes.low

    @property
    def _ranges(self) -> np.ndarray:
        return _ranges(self.answers, self._width)


def _ranges(answers: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return what differences of each action are measured in, (m,): how far it goes.

    So that one in millimetres is no measure, nor bounds that are far beyond what is done.

    Args:
        answers: (B, m).
        width: (m,) from each lower bound to the upper one.
    """
    sizes = np.abs(answers).max(axis=0)
    seen = np.maximum(np.ptp(answers, axis=0), _LEAST * sizes).astype(np.float64)
    bounded = np.isfinite(width)
    seen = np.where(seen > 0, seen, np.where(bounded, width, 1.0))
    return np.where(bounded, np.maximum(np.minimum(seen, width), _SCALED * width), seen)
