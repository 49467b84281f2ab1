"""What a student and its expert weigh, and how long one answer takes them."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.experts.cost import multiply_adds
from fdtasil.experts.expert import Expert
from fdtasil.files.compiled import shared_function
from fdtasil.files.onnx.graph import can_write, write_model
from fdtasil.files.onnx.policy import OnnxPolicy
from fdtasil.files.onnx.session import open_session
from fdtasil.files.plain import to_plain
from fdtasil.student.c_source import c_memory
from fdtasil.student.policy import Student

__all__ = ["Size", "c_microseconds", "size_of_expert", "size_of_student", "size_text"]

_CALLS, _REPEATS = 50, 5
_QUICK = 1e-3  # seconds: a slower one would take as many again


@dataclass(frozen=True)
class Size:
    """How large a policy is.

    Attributes:
        parameters: Numbers that it was trained in; None where it does not say.
        bytes: Of these numbers, in float32.
        multiply_adds: At most, for one observation; None where it does not say.
        microseconds: For one observation: `predict` of a student, a query of an expert; of one
            thread of the machine that the run was on. None where it was not asked.
        onnx_microseconds: For one observation by onnxruntime, from the student's own file, or
            the expert's; None of other experts, and of networks that only torch's exporter can
            write.
        c_constants: Bytes that a board needs for the numbers of the student's C file.
        c_memory: Bytes of static memory of this file. There is no other, but for the stack.
    """

    parameters: int | None
    bytes: int | None
    multiply_adds: int | None
    microseconds: float | None
    onnx_microseconds: float | None = None
    c_constants: int | None = None
    c_memory: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the size as plain JSON values."""
        return to_plain(self)


def size_of_student(student: Student) -> Size:
    """Return a student's size; it is asked some hundred times."""
    row = np.zeros(student.observation_size, np.float32)
    numbers = sum(parameter.numel() for parameter in student.network.parameters())
    weights = sum(p.numel() for p in student.network.parameters() if p.ndim > 1)
    constants, memory = (None, None) if student.plain is None else c_memory(student.plain)
    return Size(
        numbers,
        4 * numbers,
        weights,
        _microseconds(lambda: student.predict(row)),
        _onnx_microseconds(student, row[None]),
        constants,
        memory,
    )


def c_microseconds(source: str, student: Student) -> float:
    """Return how long the C file of a student takes for one observation, compiled here.

    Raises:
        ExportError: If there is no compiler, or the file can't be compiled.
    """
    function = shared_function(source, "student")
    seen = np.zeros(student.observation_size, np.float32)
    done = np.zeros(student.action_size, np.float32)
    places = seen.ctypes.data, done.ctypes.data
    return _microseconds(lambda: function(*places))


def _onnx_microseconds(student: Student, row: np.ndarray) -> float | None:
    if not can_write(student):
        return None
    model = write_model(student, student.observation_size, student.action_size)
    session = open_session(model, "the student")
    return _microseconds(lambda: session.run(None, {"obs": row}))


def _microseconds(call: Callable[[], object]) -> float:
    """Return how long a call takes: of several rounds the quickest, which others disturb least."""
    call()
    taken = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        for _ in range(_CALLS):
            call()
        taken.append((time.perf_counter() - start) / _CALLS)
    return _rounded(min(taken))


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
        _onnx_expert_microseconds(expert, seconds),
    )


def _onnx_expert_microseconds(expert: Expert, seconds: float | None) -> float | None:
    """Ask an ONNX file that is quick, past what counts and checks its answers."""
    policy = expert.answer
    if not isinstance(policy, OnnxPolicy) or seconds is None or seconds > _QUICK:
        return None
    row = np.zeros((1, policy.size), np.float32)
    return _microseconds(lambda: policy(row))


def size_text(size: dict[str, Any]) -> str:
    """Return a size of a report in a few words."""
    parts = []
    if size["bytes"] is not None:
        parts.append(f"{size['parameters']:,} numbers ({size['bytes'] / 1000:,.0f} kB)")
    if size["microseconds"] is not None:
        parts.append(f"{size['microseconds']:,.3g} microseconds")
    if size.get("onnx_microseconds") is not None:
        parts.append(f"{size['onnx_microseconds']:,.3g} in onnxruntime")
    if size.get("c_memory") is not None:
        memory = f"{size['c_constants'] / 1000:,.0f} kB and {size['c_memory']:,} bytes of memory"
        parts.append(f"as C {memory}")
    return ", ".join(parts) or "unknown"


def _rounded(seconds: float) -> float:
    return float(f"{1e6 * seconds:.3g}")
