"""What a student can be written as: one writer for each target, chosen by the file's suffix."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.files.onnx.export import check_finite, export_module
from fdtasil.student.policy import Student

__all__ = ["EXPORTS", "export"]

Writer = Callable[[Student, np.ndarray, Mapping[str, str]], bytes]
"""A student, (B, n) states of its training and metadata -> the bytes of a file."""


def _safetensors(student: Student, states: np.ndarray, metadata: Mapping[str, str]) -> bytes:
    check_finite(student)
    return student.to_bytes(metadata)


EXPORTS: dict[str, Writer] = {
    ".onnx": export_module,
    ".safetensors": _safetensors,
}
"""Every target by the suffix of its file."""


def export(
    student: Student, states: np.ndarray, metadata: Mapping[str, str], name: str | Path
) -> bytes:
    """Return a student as the file that a name asks for.

    Args:
        student: The student.
        states: (B, n) states of its training, on which the file is compared with it.
        metadata: What the file says of itself.
        name: Ends with one of the suffixes of `EXPORTS`.

    Raises:
        SettingError: If there is no such target.
        ExportError: If the file's answers differ from the student's by more than 1e-5.
    """
    suffix = Path(name).suffix
    if suffix not in EXPORTS:
        raise SettingError(
            f"{str(name)!r} to export a student to",
            f"a name that ends with {' or '.join(EXPORTS)}",
            "write for example student.onnx",
        )
    return EXPORTS[suffix](student, states, metadata)
