"""A student's ONNX file in eight bits: a quarter of the bytes, each output with a scale."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fdtasil.compute import in_turn
from fdtasil.errors import ExportError, first_line
from fdtasil.files.onnx.export import silenced
from fdtasil.files.onnx.runtime import runtime
from fdtasil.files.onnx.session import open_session, run_session
from fdtasil.files.reading import read_plain
from fdtasil.files.storage import write_bytes
from fdtasil.student.policy import Student

__all__ = ["as_int8", "check_change"]

_BATCHES = 8  # that the calibration is read in
_AROUND = 0.5  # deviations that half of its states are moved by, as probes move them
_MOST = 0.05  # of an action's unit, as the mean change of an action that is still the student's


def as_int8(written: bytes, student: Student, states: np.ndarray, output: str) -> bytes:
    """Quantise a student's file, with its demonstrations and states around them as calibration.

    Args:
        written: Its ONNX file in float32.
        student: The student.
        states: (B, n) states of its training.
        output: Name of the output that is compared.

    Raises:
        ExportError: If it can't be quantised, or actions change by more than 5 % of their unit
            (half the range of bounded ones) on the mean.
    """
    random = np.random.default_rng(0)
    moved = states + _AROUND * student.scale.numpy() * random.standard_normal(states.shape)
    rows = np.concatenate([states, moved]).astype(np.float32)
    runtime()  # without its telemetry
    try:
        with in_turn(), silenced():
            data = _quantised(written, rows)
    except Exception as error:  # onnxruntime's tools raise anything
        raise ExportError(
            f"onnxruntime can't quantise the student: {first_line(error)}",
            "linear layers and activations",
            "export it as .onnx",
        ) from error
    answers = run_session(open_session(data, "the int8 export"), output, states)
    check_change(answers, student, states, "export it as .onnx")
    return data


def check_change(answers: np.ndarray, student: Student, states: np.ndarray, way: str) -> None:
    """Refuse eight bits in which a student is not itself.

    Args:
        answers: (B, m) in eight bits.
        student: The student.
        states: (B, n) what was answered.
        way: What to do instead of training a wider student.

    Raises:
        ExportError: If actions change by more than 5 % of their unit on the mean.
    """
    apart = np.abs(answers - student.act(states)) / student.action_units.numpy()
    if not float(apart.mean()) <= _MOST:
        raise ExportError(
            f"in int8 the student's actions change by {apart.mean():.1%} of their unit",
            f"at most {_MOST:.0%} on the mean",
            f"train a wider student, or {way}",
        )


def _quantised(written: bytes, rows: np.ndarray) -> bytes:
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self.batches = iter(np.array_split(rows, _BATCHES))

        def get_next(self) -> Any:
            batch = next(self.batches, None)
            return None if batch is None else {"obs": batch}

    with TemporaryDirectory() as folder:
        source, target = Path(folder, "float.onnx"), Path(folder, "int8.onnx")
        write_bytes(source, written)
        quantize_static(
            str(source),
            str(target),
            Reader(),
            quant_format=QuantFormat.QOperator,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            # Signed ones overflow on processors without VNNI, which add pairs of products in 16
            # bits: an action was off by 0.32 of its unit, and by 0.08 with these.
            weight_type=QuantType.QUInt8,
            op_types_to_quantize=["Gemm"],
        )
        return read_plain(target)
