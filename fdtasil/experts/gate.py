"""The gate: what an expert must show on real states before anything is spent on it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.errors import ExpertError, FdtasilError, warn
from fdtasil.experts.expert import Expert
from fdtasil.rollouts.environments import Boxes

__all__ = ["GATE_QUERIES", "GATE_STATES", "Finding", "admit_expert", "examine_expert"]

GATE_STATES = 16
"""States that the gate asks about, before and after the expert's first rollouts."""
GATE_QUERIES = 3 * GATE_STATES
"""What it asks each time: every state in a batch, once more, and alone."""

# Differences between two answers, as a share of the action range. Batches of another size change
# the last bits of a float32 product; quantised and stochastic experts change the third digit.
_SAME = 1e-4


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


def examine_expert(expert: Expert, observations: np.ndarray, boxes: Boxes) -> list[Finding]:
    """Check an expert on real states without raising.

    Args:
        expert: The expert; about three rows are asked for each observation.
        observations: (B, n) float32 states of the environment, B at least 2; 32 are plenty.
        boxes: The environment's spaces.

    Returns:
        One finding for each check, in the order: answers (shape and finiteness), determinism,
        batch independence, action bounds, action scale. An expert that can't answer has the
        first finding only.
    """
    return _examine(expert, observations, boxes)[0]


def _examine(
    expert: Expert, observations: np.ndarray, boxes: Boxes
) -> tuple[list[Finding], float]:
    """Return the findings, and the seconds that a row takes."""
    times = [time.perf_counter()]
    try:
        answers = expert.ask(observations, "check")
        times.append(time.perf_counter())
        again = expert.ask(observations, "check")
        times.append(time.perf_counter())
        alone = np.concatenate([expert.ask(row[None], "check") for row in observations])
        times.append(time.perf_counter())
    except ExpertError as error:
        return [Finding("answers", error.found, error)], 0.0
    probe = _Answers(expert, observations, answers, boxes)
    found = Finding("answers", f"{answers.shape[1]} finite numbers for each observation", None)
    findings = [
        found,
        probe.same(again, "determinism", "asked twice", _STOCHASTIC),
        probe.same(alone, "batch independence", "asked alone and in a batch", _BATCH_DEPENDENT),
        probe.within_bounds(),
        probe.fills_bounds(),
    ]
    # The first query may start workers, and any may meet a busy machine: the quickest counts.
    return findings, float(np.diff(times).min()) / len(observations)


def admit_expert(
    expert: Expert, observations: np.ndarray, boxes: Boxes, *, force: bool = False
) -> float:
    """Check an expert on real states, and raise what is wrong with it.

    Args:
        expert: The expert.
        observations: (B, n) float32 states of the environment, B at least 2.
        boxes: The environment's spaces.
        force: Warn instead of raising, where the expert answers at all.

    Returns:
        Seconds that a row takes, in such a batch or alone.

    Raises:
        ExpertError: The first problem found.
    """
    findings, seconds = _examine(expert, observations, boxes)
    raise_problems(findings, force=force)
    return seconds


def raise_problems(findings: Sequence[Finding], *, force: bool) -> None:
    """Raise the first problem among `findings`, or warn of all of them if `force`."""
    for finding in findings:
        if finding.problem is None:
            continue
        if not force or finding.name == "answers":
            raise finding.problem
        warn(f"{finding.problem.found} (forced)")


_STOCHASTIC = (
    "equal answers to equal observations",
    "export the deterministic policy (its mean), or pass force=True to clone the noise as well",
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
        difference = float(np.abs(self.answers - other).max())
        measured = f"{how}: largest difference {difference:.1e}"
        if difference <= _SAME * self._range():
            return Finding(name, measured, None)
        found = f"{self.expert.name} {how} differs by up to {difference:.2g}"
        return Finding(name, measured, ExpertError(found, *advice))

    def within_bounds(self) -> Finding:
        low, high = self.boxes.low, self.boxes.high
        beyond = np.maximum(self.answers - high, low - self.answers)
        outside = float((beyond > _SAME * self._range()).any(axis=1).mean())
        measured = f"{100 * outside:.0f} % of the states have an action outside the bounds"
        if outside == 0:
            return Finding("action bounds", measured, None)
        found = (
            f"{self.expert.name} leaves the action bounds at {100 * outside:.0f} % of the states, "
            f"by up to {float(beyond.max()):.2g}"
        )
        problem = ExpertError(
            found,
            f"actions from {_numbers(low)} to {_numbers(high)}",
            "put scaling and clipping inside the expert, or pass force=True to let the "
            "environment clip",
        )
        return Finding("action bounds", measured, problem)

    def fills_bounds(self) -> Finding:
        """Warn of an actor in [-1, 1] whose actions were to be scaled to wider bounds."""
        sizes = np.abs(self.answers)
        largest, saturated = float(sizes.max()), float((sizes > 0.99).mean())
        wider = float(min(-self.boxes.low.max(), self.boxes.high.min()))
        measured = f"largest action {largest:.3g}, bounds {_numbers(self.boxes.high)}"
        if 1.5 <= wider < np.inf and largest <= 1.0 + 1e-6 and saturated > 0.1:
            warn(
                f"all actions of {self.expert.name} lie in [-1, 1], the bounds are +-{wider:.3g}: "
                "is the action scale missing from the export?"
            )
        return Finding("action scale", measured, None)

    def _range(self) -> float:
        width = self.boxes.high - self.boxes.low
        bounded = width[np.isfinite(width)]
        return float(bounded.min()) if bounded.size else max(1.0, float(np.ptp(self.answers)))


def _numbers(values: np.ndarray) -> str:
    """Return one number where all are equal, else the list."""
    return f"{values[0]:g}" if np.all(values == values[0]) else str(values)
