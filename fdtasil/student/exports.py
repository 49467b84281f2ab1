"""What a student can be written as: one writer for each target, chosen by the file's suffix."""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from fdtasil.checks import check_choice
from fdtasil.errors import ExportError, SettingError, printable, shown
from fdtasil.experts.onnx_expert import COLUMNS, FUNCTION, HISTORY
from fdtasil.files.onnx.export import check_finite, export_module
from fdtasil.rollouts.history import present_size
from fdtasil.student import plain
from fdtasil.student.c_int8 import INT8, rounded
from fdtasil.student.c_source import c_header, c_source, check_parity, comment_lines
from fdtasil.student.int8 import as_int8, check_change
from fdtasil.student.own_form import check_own_form, own_form
from fdtasil.student.plain import PlainPolicy
from fdtasil.student.policy import Student
from fdtasil.student.tflite import tflite_model

__all__ = ["EXPORTS", "SPACES", "export", "order_of"]

_INT8 = ".int8"
_LONG = 120  # letters of a list that a comment shows whole
SPACES = "fdtasil.spaces"
"""What a file calls the spaces of its environment."""

Writer = Callable[[Student, np.ndarray, Mapping[str, str]], bytes]
"""A student, (B, n) states of its training and metadata -> the bytes of a file."""


def _onnx(
    student: Student, states: np.ndarray, metadata: Mapping[str, str], *, keys: bool = False
) -> bytes:
    written = export_module(student, states, metadata)
    if student.spaces is None and not keys:
        return written
    import onnx

    model = own_form(onnx.load_from_string(written), student.spaces, keys=keys)
    check_own_form(model, student, states, keys=keys)
    return model.SerializeToString(deterministic=True)


def _onnx_with_keys(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    return _onnx(student, states, metadata, keys=True)


def _int8(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    chooses = student.spaces is not None and student.spaces.actions.choices
    output = "scores" if chooses else "actions"
    return as_int8(_onnx(student, states, metadata), student, states, output)


def _safetensors(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    check_finite(student)
    return student.to_bytes(metadata)


def _plain(student: Student) -> PlainPolicy:
    check_finite(student)
    found = student.plain
    if found is None:
        raise ExportError(
            f"a student of {type(student.architecture).__name__} without torch",
            "fdtasil.Mlp, on the CPU",
            "export it as .onnx",
        )
    return found


def order_of(student: Student, metadata: Mapping[str, str]) -> str:
    """Return what stands where in an observation, "" where it is a plain vector."""
    if HISTORY in metadata:
        steps, m = int(metadata[HISTORY]), student.action_size
        n, _ = present_size(student.observation_size, steps, m)
        return (
            f"0:{n} now, then for each of {steps - 1} steps before, the latest first, {n} of its "
            f"observation and {m} of its action; before a start, the first observation and zeros"
        )
    if FUNCTION in metadata:
        return f"what {shown(metadata[FUNCTION])} makes of the environment's"
    layout = student.spaces.observations if student.spaces else None
    if layout is None or not layout.names:
        columns = metadata.get(COLUMNS, "")
        told = (
            f"{columns.count(',') + 1} of them, by {COLUMNS}" if len(columns) > _LONG else columns
        )
        return f"of the environment's numbers {told}" if columns else ""
    return layout.order


def _comment(student: Student, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the lines of a C file's comment: of the spaces, those that a reader needs."""
    order = order_of(student, metadata)
    kept = {name: text for name, text in metadata.items() if name != SPACES}
    return kept | ({"observation": order} if order else {})


def _c(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    policy = _plain(student)
    source = c_source(policy, _comment(student, metadata))
    check_parity(source, policy, states)
    return source.encode()


def _int8_c(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    policy = _plain(student)
    small = rounded(policy)
    check_change(small(states), student, states, "export it as .c")
    source = c_source(policy, _comment(student, metadata), INT8)
    check_parity(source, small, states, INT8.agreement)
    return source.encode()


def _tflite(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    return tflite_model(_plain(student), states, metadata)


def _h(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    return c_header(_plain(student), order_of(student, metadata)).encode()


def _py(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    _plain(student)  # who is no such network needs torch
    order = order_of(student, metadata)
    lines = comment_lines(f"The observation: {printable(order)}") if order else []
    return "".join([*(f"# {line}\n" for line in lines), inspect.getsource(plain)]).encode()


EXPORTS: dict[str, Writer] = {
    ".int8.onnx": _int8,
    ".onnx": _onnx,
    ".safetensors": _safetensors,
    ".tflite": _tflite,
    ".int8.c": _int8_c,
    ".c": _c,
    ".h": _h,
    ".py": _py,
}
"""Every target by the suffix of its file; the first that fits."""


def export(
    student: Student,
    states: np.ndarray,
    metadata: Mapping[str, str],
    name: str | Path,
    inputs: str = "flat",
) -> bytes:
    """Return a student as the file that a name asks for.

    Args:
        student: The student.
        states: (B, n) states of its training, on which the file is compared with it.
        metadata: What the file says of itself.
        name: Ends with one of the suffixes of `EXPORTS`.
        inputs: "flat", or "keys" for an ONNX file with one input for each part of an observation.

    Raises:
        SettingError: If there is no such target, or it has one input.
        ExportError: If the file's answers differ from the student's by more than 1e-5.
    """
    suffix = next((suffix for suffix in EXPORTS if str(name).endswith(suffix)), None)
    if suffix is None:
        raise SettingError(
            f"{str(name)!r} to export a student to",
            f"a name that ends with {' or '.join(EXPORTS)}",
            "write for example student.onnx",
        )
    if _INT8 in Path(str(name).lower()).suffixes and not suffix.startswith(_INT8):
        raise SettingError(
            f"{str(name)!r} to export a student to",
            f"{_INT8}.onnx or {_INT8}.c at the end, for weights in eight bits",
            f"write for example student{_INT8}.onnx, or leave {_INT8} out of the name",
        )
    if check_choice("inputs", inputs, ("flat", "keys")) == "flat":
        return EXPORTS[suffix](student, states, metadata)
    if suffix != ".onnx":
        step = 'write a name that ends with .onnx, or inputs="flat"'
        raise SettingError(f'{suffix} with inputs="keys"', "an ONNX file", step)
    return _onnx_with_keys(student, states, metadata)
