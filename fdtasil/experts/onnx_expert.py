"""ONNX files as experts, with the names, types and batch sizes that users' files have."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fdtasil.errors import ExpertError, first_line, shown, warn
from fdtasil.experts.expert import Expert, Hints
from fdtasil.experts.twin import torch_twin
from fdtasil.files.onnx.model import read_model
from fdtasil.files.onnx.session import is_batched, open_session, rebatched, run_session
from fdtasil.rollouts.behaviours import Policy

if TYPE_CHECKING:
    import onnx
    import onnxruntime

    Session = onnxruntime.InferenceSession

__all__ = ["COLUMNS", "open_onnx"]

COLUMNS = "fdtasil.observation_columns"
"""Metadata entry of an exported student that sees some coordinates only."""

_FLOATS = ("tensor(float)", "tensor(double)", "tensor(float16)")


def open_onnx(source: str | Path, hints: Hints) -> Expert:
    """Open an ONNX file as an expert.

    Args:
        source: The file; weights may lie in a side file beside it.
        hints: Sizes, where the file leaves them open, and the output that holds the actions.

    Returns:
        The expert. Its `module` is a torch twin where the graph is an MLP, else None.

    Raises:
        ExpertError: If the file can't be opened, or its signature does not fit.
    """
    path = Path(source)
    model, digest = read_model(path)
    session, columns = open_session(model, str(path)), _columns(model, path)
    try:
        n = _observation_size(session, path, None if columns else hints.observation_size)
        chosen = _choose_output(session, path, hints.action_size, hints.output)
        answer = _answer(model, session, chosen, n)
        m = answer(np.zeros((2, n), np.float32)).shape[-1]
        twin = torch_twin(model, chosen, answer, n)
    except ExpertError:
        raise
    except Exception as error:  # onnxruntime has its own, and damaged names are no text
        limited = isinstance(error, (MemoryError, TimeoutError))
        raise ExpertError(
            f"{path} can't be asked: {first_line(error)}",
            "answers to a few observations",
            "leave the file alone; if you know it, wrap a session of its own in a function"
            if limited
            else "export it again, and ask it with onnxruntime alone",
        ) from error
    return Expert(answer, path.name, n, m, digest, str(source), columns, twin)


def _columns(model: "onnx.ModelProto", path: Path) -> tuple[int, ...] | None:
    """Return the columns that an exported student's file says it sees, or None."""
    texts = {entry.key: entry.value for entry in model.metadata_props}
    columns = texts.get(COLUMNS)
    try:
        return None if columns is None else tuple(int(column) for column in columns.split(","))
    except (TypeError, ValueError) as error:
        raise ExpertError(
            f"{path} says that it sees the columns {shown(columns)}",
            "numbers with commas between, as fdtasil writes them",
            "export the student again, or remove that entry of its metadata",
        ) from error


def _observation_size(session: "Session", path: Path, wanted: int | None) -> int:
    inputs = session.get_inputs()
    described = ", ".join(_describe(entry) for entry in inputs)
    if len(inputs) != 1:
        raise ExpertError(
            f"{path} has {len(inputs)} inputs: {described}",
            "one input (batch, n); policies with memory can't be distilled",
            "export the policy without its state, or wrap it in a function",
        )
    shape, kind = inputs[0].shape, inputs[0].type
    if kind not in _FLOATS or len(shape) not in (1, 2):
        raise ExpertError(
            f"{path} has the input {described}",
            "(batch, n) numbers of type float16, float32 or float64, or (n) of them",
            "export the policy for flat observations",
        )
    n = shape[-1] if isinstance(shape[-1], int) else wanted
    if n is None:
        raise ExpertError(
            f"{path} leaves its observation size open: {described}",
            "a size in the file or from the caller",
            "write load_expert(path, observation_size=...)",
        )
    if wanted is not None and n != wanted:
        raise ExpertError(
            f"{path} wants {n} observations, the environment gives {wanted}",
            "an expert of this environment",
            "check the environment's version and options (Ant-v4 gives 27, Ant-v5 105)",
        )
    return n


def _choose_output(
    session: "Session", path: Path, action_size: int | None, output: str | None
) -> str:
    outputs = session.get_outputs()
    described = ", ".join(_describe(entry) for entry in outputs)
    if output is not None:
        if output not in [entry.name for entry in outputs]:
            raise ExpertError(
                f"{path} has no output {output!r}", f"one of {described}", "choose one of these"
            )
        return output
    rank = len(session.get_inputs()[0].shape)
    fitting = [entry.name for entry in outputs if _could_be_actions(entry, rank, action_size)]
    if len(fitting) != 1:
        raise ExpertError(
            f"{path} has {len(fitting)} outputs that could be the actions: {described}",
            f"one floating-point output (batch, {action_size or 'm'})",
            'name it: load_expert(path, output="...") (--output on the command line)'
            if fitting
            else "check that expert and environment belong together",
        )
    return fitting[0]


def _could_be_actions(entry: "onnxruntime.NodeArg", rank: int, action_size: int | None) -> bool:
    if entry.type not in _FLOATS:
        return False
    # An exporter may leave the shape open; then only asking tells.
    if not entry.shape or not isinstance(entry.shape[-1], int):
        return True
    return len(entry.shape) == rank and action_size in (None, entry.shape[-1])


def _answer(model: "onnx.ModelProto", session: "Session", output: str, n: int) -> Policy:
    """Return the fastest way to ask that gives the answers of single rows."""
    if len(session.get_inputs()[0].shape) == 1:
        return _slow(lambda rows: _one_by_one(session, output, rows), 1, n)
    if is_batched(session):
        if _takes_batches(session, output, n):
            return lambda rows: run_session(session, output, rows)
        size = 1
    else:
        size = session.get_inputs()[0].shape[0]

    def in_turn(rows: np.ndarray) -> np.ndarray:
        padded = np.concatenate([rows, np.zeros((-len(rows) % size, n), np.float32)])
        parts = [
            run_session(session, output, padded[start : start + size])
            for start in range(0, len(padded), size)
        ]
        return np.concatenate(parts)[: len(rows)]

    try:
        free = open_session(rebatched(model), "the re-batched model")
    except ExpertError:
        return _slow(in_turn, size, n)

    def at_once(rows: np.ndarray) -> np.ndarray:
        return run_session(free, output, rows)

    return at_once if _agree(at_once, in_turn, n) else _slow(in_turn, size, n)


def _one_by_one(session: "Session", output: str, rows: np.ndarray) -> np.ndarray:
    """Ask a model that takes an observation without a batch dimension."""
    zeros = np.zeros((1, rows.shape[1]), np.float32)  # for an empty batch, to know the width
    answers = [run_session(session, output, row) for row in (rows if len(rows) else zeros)]
    return np.stack(answers)[: len(rows)]


def _takes_batches(session: "Session", output: str, n: int) -> bool:
    """Whether a free batch dimension is true: a constant inside the graph may hold another."""
    try:
        answers = run_session(session, output, np.zeros((3, n), np.float32))
    except (MemoryError, TimeoutError):
        raise
    except Exception:  # onnxruntime has its own
        return False
    return answers.ndim != 2 or len(answers) == 3


def _agree(at_once: Policy, in_turn: Policy, n: int) -> bool:
    rows = np.random.default_rng(0).standard_normal((17, n)).astype(np.float32)
    try:
        fast, slow = at_once(rows), in_turn(rows)
    except (MemoryError, TimeoutError):
        raise
    except Exception:  # a constant inside the graph still wants the old batch
        return False
    return fast.shape == slow.shape and np.allclose(fast, slow, rtol=1e-4, atol=1e-5)


def _slow(in_turn: Policy, size: int, n: int) -> Policy:
    rows = np.zeros((64 * size, n), np.float32)
    in_turn(rows[:size])
    start = time.perf_counter()
    in_turn(rows)
    seconds = (time.perf_counter() - start) / len(rows)
    warn(
        f"the model takes {size} row(s) at a time and can't be re-batched: asked in turn, "
        f"{1e6 * seconds:.0f} microseconds a row (batches are about ten times faster); "
        "export it with a free batch dimension to mend this"
    )
    return in_turn


def _describe(entry: "onnxruntime.NodeArg") -> str:
    kind = entry.type.removeprefix("tensor(").removesuffix(")")
    return shown(f"{entry.name} {kind} ({', '.join(str(size) for size in entry.shape)})")
