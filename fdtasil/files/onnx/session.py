"""Asking an ONNX model through onnxruntime, on one thread and in batches."""

import re
from typing import TYPE_CHECKING

import numpy as np

from fdtasil.errors import ExpertError, first_line, shown
from fdtasil.files.onnx.limits import limit_memory, run_within_limits
from fdtasil.files.onnx.runtime import runtime

if TYPE_CHECKING:
    import onnx
    import onnxruntime

__all__ = ["is_batched", "open_session", "rebatched", "run_session"]

# Whose operators come with onnxruntime; the others are in libraries of native code.
_DOMAINS = ("ai.onnx", "com.microsoft")


def open_session(model: "onnx.ModelProto | bytes", name: str) -> "onnxruntime.InferenceSession":
    """Open a model, or its bytes, on one CPU thread.

    Raises:
        ExpertError: If onnxruntime can't run it, with its reason in one line.
    """
    onnxruntime = runtime()
    options = onnxruntime.SessionOptions()
    # One thread and no spinning: the default slows torch in the same process many times over.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.enable_mem_pattern = False  # memory grows with every new batch size otherwise
    options.log_severity_level = 4
    limit_memory(options)
    try:
        # Falling back to the one provider that there is prints a banner to standard output.
        return onnxruntime.InferenceSession(
            model if isinstance(model, bytes) else model.SerializeToString(),
            options,
            providers=["CPUExecutionProvider"],
            enable_fallback=0,
        )
    except Exception as error:
        raise _cannot_run(model, name, error) from error


def run_session(
    session: "onnxruntime.InferenceSession", output: str, observations: np.ndarray
) -> np.ndarray:
    """Answer one batch, casting to the type the model wants and back to float32.

    Raises:
        TimeoutError: If it takes longer than a minute.
        MemoryError: If it takes more than 4 GiB.
        Exception: Whatever onnxruntime has.
    """
    entry = session.get_inputs()[0]
    wanted = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
    batch = observations.astype(wanted.get(entry.type, np.float64), copy=False)
    (found,) = run_within_limits(session, [output], {entry.name: batch})
    return found.astype(np.float32, copy=False)


def is_batched(session: "onnxruntime.InferenceSession") -> bool:
    """Whether the model's first dimension is free."""
    return not isinstance(session.get_inputs()[0].shape[0], int)


def rebatched(data: bytes) -> bytes:
    """Return a model whose first input and output dimensions are free instead of fixed."""
    import onnx

    copy = onnx.load_model_from_string(data)
    for value in (*copy.graph.input, *copy.graph.output):
        if value.type.tensor_type.shape.dim:
            value.type.tensor_type.shape.dim[0].dim_param = "batch"
    del copy.graph.value_info[:]  # shapes inferred for the fixed batch
    return copy.SerializeToString()


def _cannot_run(given: "onnx.ModelProto | bytes", name: str, error: Exception) -> ExpertError:
    """Say why onnxruntime refuses a model; its own texts begin with signatures of C++."""
    import onnx

    text, library = str(error), f"onnxruntime {runtime().__version__}"
    model = onnx.load_model_from_string(given) if isinstance(given, bytes) else given
    try:
        needed = ", ".join(f"{x.domain or 'opset'} {x.version}" for x in model.opset_import)
        foreign = sorted(_foreign_operators(model))
    except (TypeError, ValueError):  # names that are no text come as bytes, or not at all
        needed, foreign = "unreadable", []
    if foreign:
        return ExpertError(
            f"{name} has operators of a library: {shown(', '.join(foreign))}",
            "the operators of ONNX and onnxruntime; libraries of native code are never loaded",
            "export the controller with these, or wrap it in a function on batches",
        )
    known = re.search(r"(?:domain (\S+) is till|max supported) (opset|IR version:) (\d+)", text)
    if known:
        what = "IR" if known[1] is None else "opset" if known[1] == "ai.onnx" else known[1]
        return ExpertError(
            f"{name} needs {shown(needed)} and IR {model.ir_version}; {library} knows {what} "
            f"{known[3]} at most",
            "a file that is not newer than the library",
            "upgrade onnxruntime, or export again with an older opset such as 17",
        )
    return ExpertError(
        f"{library} can't run {name}: {first_line(error)}",
        f"standard operators in a version it knows (this file: {shown(needed)}, "
        f"IR {model.ir_version})",
        "upgrade onnxruntime, or export again with an older opset such as 17",
    )


def _foreign_operators(model: "onnx.ModelProto") -> set[str]:
    own = {(function.domain, function.name) for function in model.functions}
    return {
        f"{node.domain}::{node.op_type}"
        for node in model.graph.node
        if node.domain and not node.domain.startswith(_DOMAINS)
        if (node.domain, node.op_type) not in own
    }
