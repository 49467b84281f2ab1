"""ONNX files: read safely, answer in batches whatever batch they were exported with, write.

onnx and onnxruntime are imported inside the functions, so that `import fdtasil` needs neither.
"""

import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from fdtasil.errors import ExpertError, ExportError, first_line, shown
from fdtasil.limits import limit_memory, run_within_limits
from fdtasil.side_files import load_side_files, names_of_side_files
from fdtasil.storage import sha256

if TYPE_CHECKING:
    import onnx
    import onnxruntime

__all__ = [
    "export_module",
    "is_batched",
    "open_session",
    "read_model",
    "rebatched",
    "run_session",
    "side_files",
]

_OPSET = 18  # old enough for the runtimes on robots, new enough for torch's exporter
# Bytes, with the side files; a protobuf message can't have more than twice that.
_SIZE_LIMIT = 2**30
# Whose operators come with onnxruntime; the others are in libraries of native code.
_DOMAINS = ("ai.onnx", "com.microsoft")

_ENDS = (".zip", ".onnx")  # which stable-baselines3 and users leave out
_IMPOSTORS = {
    b"<": ("an HTML or XML page", "download the file itself, not the page about it"),
    b"version https://git-lfs": ("a git-LFS pointer", "run `git lfs pull`"),
    b"\x80": ("a Python pickle", "export the controller to ONNX; pickles are never opened"),
    b"PK\x03\x04": (
        "a zip; if stable-baselines3 wrote it, it is an agent and not a model",
        "name it *.zip, or export it with `fdtasil export-sb3`",
    ),
}


def read_model(path: Path) -> "tuple[onnx.ModelProto, str]":
    """Read an ONNX file with its weights, also where they lie in a side file.

    Nothing outside the model's own folder is read, no link to a side file is followed, and no code
    of the file is run.

    Returns:
        The model, and the sha256 of its file (followed by its side files, where it has any).

    Raises:
        ExpertError: If it is missing, not ONNX, over 1 GiB, or a side file of it can't be used.
    """
    import onnx

    path = Path(path)
    data = _read_bytes(path)
    for magic, (found, next_step) in _IMPOSTORS.items():
        if data.startswith(magic):
            raise ExpertError(f"{path} is {found}", "an ONNX model", next_step)
    model = None
    try:
        model = onnx.load_model_from_string(data)
        data += load_side_files(model, path, _SIZE_LIMIT - len(data))
    except ExpertError:
        raise
    except Exception:  # damaged bytes may raise anything
        model = None
    if model is None or not model.graph.node:
        raise ExpertError(
            f"{path} is no whole ONNX model ({len(data):,} bytes)",
            "a file written by an ONNX exporter",
            "copy or export it again",
        )
    return model, sha256(data)


def side_files(data: bytes) -> set[str]:
    """Return the side files that a model's bytes name, unchecked; none where they are no model."""
    import onnx

    try:
        return names_of_side_files(onnx.load_model_from_string(data))
    except Exception:  # `read_model` says what they are instead
        return set()


def open_session(model: "onnx.ModelProto", name: str) -> "onnxruntime.InferenceSession":
    """Open a model on one CPU thread.

    Raises:
        ExpertError: If onnxruntime can't run it, with its reason in one line.
    """
    import onnxruntime

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
            model.SerializeToString(),
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
    return run_within_limits(session, output, {entry.name: batch}).astype(np.float32, copy=False)


def is_batched(session: "onnxruntime.InferenceSession") -> bool:
    """Whether the model's first dimension is free."""
    return not isinstance(session.get_inputs()[0].shape[0], int)


def rebatched(model: "onnx.ModelProto") -> "onnx.ModelProto":
    """Return a copy whose first input and output dimensions are free instead of fixed."""
    import onnx

    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    for value in (*copy.graph.input, *copy.graph.output):
        if value.type.tensor_type.shape.dim:
            value.type.tensor_type.shape.dim[0].dim_param = "batch"
    del copy.graph.value_info[:]  # shapes inferred for the fixed batch
    return copy


def export_module(
    module: torch.nn.Module, observations: np.ndarray, metadata: Mapping[str, str]
) -> bytes:
    """Write a torch policy as one self-contained ONNX file, and compare the two.

    The graph has one input `obs` (batch, n), one output `actions` (batch, m), both float32, and
    a free batch. Equal modules give equal bytes.

    Args:
        module: (B, n) -> (B, m) float32, put into evaluation mode while it is exported.
        observations: (B, n) float32 real states to compare on; B at least 2.
        metadata: Text entries of the file's `metadata_props`.

    Returns:
        The file's bytes.

    Raises:
        ExportError: If the export fails, an answer is not finite, or the file's answers differ
            from torch's by more than 1e-5 (relative to the largest action, if that is over 1).
    """
    import onnx

    example = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
    training = module.training
    module.eval()
    try:
        model = _export_graph(module, example)
        with torch.no_grad():
            expected = module(example).numpy()
    finally:
        module.train(training)
    onnx.helper.set_model_props(model, dict(metadata))
    session = open_session(model, "the export")
    answers = run_session(session, "actions", example.numpy())
    if not all(torch.isfinite(weights).all() for weights in module.parameters()):
        raise ExportError(  # an infinite one may hide behind a tanh
            f"{type(module).__name__} has weights that are not finite",
            "finite numbers",
            "train it again: it did not learn what it answers",
        )
    difference = float(np.abs(answers - expected).max())
    if not difference <= 1e-5 * max(1.0, float(np.abs(expected).max())):  # catches NaN as well
        raise ExportError(
            f"the ONNX file and torch differ by {difference:.1e} on {len(example)} states",
            "at most 1e-5, on finite answers",
            "check the module for layers that behave differently in training, or for NaN weights",
        )
    return model.SerializeToString(deterministic=True)


def _export_graph(module: torch.nn.Module, example: torch.Tensor) -> "onnx.ModelProto":
    try:
        with _silenced():
            program = torch.onnx.export(
                module,
                (example[:2],),
                dynamo=True,
                external_data=False,
                opset_version=_OPSET,
                input_names=["obs"],
                output_names=["actions"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                verbose=False,
            )
        assert program is not None  # for the type checker: dynamo=True always returns one
        model = program.model_proto
    except Exception as error:
        raise ExportError(
            f"torch can't export {type(module).__name__}: {first_line(error)}",
            "a module made of operations that ONNX has",
            "replace the operation named above",
        ) from error
    # The exporter writes stack traces with folder names of this machine into every node.
    for part in (*model.graph.node, *model.graph.value_info, model.graph, *model.functions):
        del part.metadata_props[:]
        part.doc_string = ""
    return model


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep the exporter's remarks about its own internals away from the user."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        inside = ", ".join(sorted(p.name for p in path.glob("*.onnx"))[:5]) or "none"
        raise ExpertError(
            f"{path} is a folder (ONNX files inside: {inside})",
            "an ONNX file",
            "name the file itself",
        )
    try:
        size = path.stat().st_size
        if not 0 < size <= _SIZE_LIMIT:
            raise ExpertError(
                f"{path} has {size:,} bytes",
                f"1 to {_SIZE_LIMIT:,} bytes",
                "check that this is the right file",
            )
        return path.read_bytes()
    except OSError as error:
        beside = [
            p.name for p in (path.with_name(f"{path.name}{end}") for end in _ENDS) if p.exists()
        ]
        raise ExpertError(
            f"{path.absolute()} can't be read: {error.strerror}",
            f"an ONNX file (relative paths start at {Path.cwd()})",
            f"name it whole: {beside[0]}" if beside else "check the path",
        ) from error


def _cannot_run(model: "onnx.ModelProto", name: str, error: Exception) -> ExpertError:
    """Say why onnxruntime refuses a model; its own texts begin with signatures of C++."""
    import onnxruntime

    text, library = str(error), f"onnxruntime {onnxruntime.__version__}"
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
