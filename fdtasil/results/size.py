"""What a student and its expert weigh, and how long one answer takes them."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.experts.cost import multiply_adds
from fdtasil.experts.expert import Expert
from fdtasil.files.plain import to_plain
from fdtasil.student.policy import Student

__all__ = ["Size", "size_of_expert", "size_of_student", "size_text"]

_CALLS, _REPEATS = 50, 5


@dataclass(frozen=True)
class Size:
    """How large a policy is.

    Attributes:
        parameters: Numbers that it was trained in; None where it does not say.
        bytes: Of these numbers, in float32.
        multiply_adds: At most, for one observation; None where it does not say.
        microseconds: For one observation: `predict` of a student, a query of an expert; of one
            thread of the machine that the run was on. None where it was not asked.
    """

    parameters: int | None
    bytes: int | None
    multiply_adds: int | None
    microseconds: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the size as plain JSON values."""
        return to_plain(self)


def size_of_student(student: Student) -> Size:
    """Return a student's size; it is asked some hundred times."""
    row = np.zeros(student.observation_size, np.float32)
    student.predict(row)
    taken = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        for _ in range(_CALLS):
            student.predict(row)
        taken.append((time.perf_counter() - start) / _CALLS)
    numbers = sum(parameter.numel() for parameter in student.network.parameters())
    weights = sum(p.numel() for p in student.network.parameters() if p.ndim > 1)
    return Size(numbers, 4 * numbers, weights, _rounded(min(taken)))


def size_of_expert(expert: Expert, observation_size: int) -> Size:
    """Return an expert's size, as far as its kind says it, and as the gate has timed it."""
    module, numbers = expert.module, None
    if module is not None:
        numbers = sum(part.numel() for part in (*module.parameters(), *module.buffers()))
    seconds = expert.seconds.get("alone")
    return Size(
        numbers,
        None if numbers is None else 4 * numbers,
        multiply_adds(expert, observation_size),
        None if seconds is None else _rounded(seconds),
    )


def size_text(size: dict[str, Any]) -> str:
    """Return a size of a report in a few words."""
    parts = []
    if size["bytes"] is not None:
        parts.append(f"{size['parameters']:,} numbers ({size['bytes'] / 1000:,.0f} kB)")
    if size["microseconds"] is not None:
        parts.append(f"{size['microseconds']:,.3g} microseconds")
    return ", ".join(parts) or "unknown"


def _rounded(seconds: float) -> float:
    return float(f"{1e6 * seconds:.3g}")
