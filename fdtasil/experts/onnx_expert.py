"""ONNX files as experts, with the names, types and batch sizes that users' files have."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch.nn import Module

from fdtasil.errors import ExpertError, FdtasilError, SettingError, shown
from fdtasil.experts.cost import stored_numbers
from fdtasil.experts.expert import Expert, Hints, Origin
from fdtasil.experts.memory import Memory, stateless
from fdtasil.experts.sizes import AS_A_STUDENT, size_hint
from fdtasil.experts.trial import try_out
from fdtasil.experts.twin import torch_twin
from fdtasil.files.onnx.binding import Choices, Given, bind
from fdtasil.files.onnx.model import read_model
from fdtasil.files.onnx.nodes import free_inputs
from fdtasil.files.onnx.policy import (
    OnnxPolicy,
    cannot_be_asked,
    open_policy,
    open_within_limits,
)
from fdtasil.files.onnx.recurrent import RecurrentPolicy, find_memory, try_recurrent
from fdtasil.rollouts.spaces import Layout, Spaces

if TYPE_CHECKING:
    import onnx

__all__ = ["COLUMNS", "FUNCTION", "HISTORY", "open_onnx", "said_history"]

COLUMNS, FUNCTION = "fdtasil.observation_columns", "fdtasil.observation_function"
"""Metadata entry of an exported student that sees some coordinates only."""
HISTORY = "fdtasil.history"
"""Metadata entry of one that sees the last observations and actions: how many observations."""


def open_onnx(source: str | Path, hints: Hints) -> Expert:
    """Open an ONNX file as an expert.

    Args:
        source: The file; weights may lie in a side file beside it.
        hints: Sizes, where the file leaves them open, the output that holds the actions, and
            what is given to which input.

    Returns:
        The expert. Its `module` is a torch twin where the graph is an MLP, else None.

    Raises:
        ExpertError: If the file can't be opened, or its signature does not fit.
    """
    path = Path(source)
    if path.suffix in (".safetensors", ".py", ".h", ".tflite"):
        raise ExpertError(
            f"{path}, which is no ONNX file",
            "an .onnx file, an agent's .zip, or a .c file",
            "of a student, take the student.onnx beside it; a function is passed in Python: "
            "fdtasil.distill(function, ...)",
        )
    model, digest = read_model(path)
    columns = _columns(model, path)
    wanted = None if columns else hints.observation_size
    with _damage_is_named(path):
        pairs = find_memory(model, hints.memory, list(hints.inputs or ()))
    if pairs:
        return _recurrent(source, model, digest, pairs, hints)
    model = _bound(model, hints, wanted, path)
    data = model.SerializeToString()
    n, past = _declared_size(model), _history_of(model)
    if n and wanted not in (None, n):
        raise ExpertError(
            f"{path} wants {n} observations, the environment gives {wanted}"
            + (f": it is a student that sees the last {past}" if past > 1 else ""),
            "an expert of this environment",
            AS_A_STUDENT if past > 1 else size_hint(n, wanted),
        )
    choices = len(hints.spaces.actions.choices) if hints.spaces else 0
    call = (data, str(path), wanted, hints.action_size, hints.output, choices)
    work = partial(open_within_limits, *call, straight=_is_straight(model))
    try_out(digest, str(path), work)
    policy, n, m = open_policy(*call)
    twin = _twin(model, policy, n, path)
    # One that takes a row at a time costs as much as a slow one, however small it is.
    work = None if policy.one_by_one else stored_numbers(model)
    origin = Origin(str(source), digest, columns, work)
    return Expert(policy, path.name, n, m, twin, origin=origin)


def _recurrent(
    source: str | Path,
    model: "onnx.ModelProto",
    digest: str,
    pairs: tuple[tuple[str, str], ...],
    hints: Hints,
) -> Expert:
    """Open a model with a memory."""
    if hints.inputs:
        raise SettingError(
            f"inputs= of {source}, which has a memory",
            "an observation and a memory, and nothing else that goes in",
            "wrap its session in an object with predict(observation, state)",
        )
    name = str(source)
    call = (model.SerializeToString(), name, pairs, hints.observation_size, hints.action_size)
    try_out(digest, name, partial(try_recurrent, *call, hints.output))
    try:
        policy = RecurrentPolicy(*call, hints.output)
    except ExpertError:
        raise
    except Exception as error:  # onnxruntime has its own
        raise cannot_be_asked(name, error) from error
    n, k = policy.observation_size, policy.memory_size
    return Expert(
        stateless(policy, n),
        Path(source).name,
        n + k,
        policy.action_size,
        memory=Memory(k, policy),
        origin=Origin(name, digest),
    )


def said_history(source: object) -> int:
    """Return how many observations an exported student says that it sees; 1 for what says nothing.

    Args:
        source: What a policy may be.

    Raises:
        ExpertError: If it is a file that can't be read.
        SettingError: If it sees through a function, without which its answers mean nothing.
    """
    if not isinstance(source, str | Path) or Path(source).suffix != ".onnx":
        return 1
    if "://" in str(source):  # of the hub, or a server: its path says it when it is here
        return 1
    model, _ = read_model(Path(source))
    texts = {entry.key: entry.value for entry in model.metadata_props}
    if FUNCTION in texts:
        raise SettingError(
            f"a student that sees through {shown(texts[FUNCTION])}, which its file does not hold",
            "the function itself",
            "pass student_obs=, or a function of whole observations that calls both",
        )
    return _history_of(model)


def _history_of(model: "onnx.ModelProto") -> int:
    text = next((entry.value for entry in model.metadata_props if entry.key == HISTORY), "1")
    return int(text) if text.isascii() and text.isdigit() and 0 < int(text) < _LONGEST else 1


_LONGEST = 1000


def _bound(
    model: "onnx.ModelProto", hints: Hints, wanted: int | None, path: Path
) -> "onnx.ModelProto":
    """Return a model with one flat input, where what it is given is said or can be told."""
    with _damage_is_named(path):
        inputs = hints.inputs or _natural_inputs(model, hints.spaces)
        return bind(model, inputs, wanted) if inputs else model


@contextmanager
def _damage_is_named(path: Path) -> Iterator[None]:
    """Name the file: names and shapes of a damaged one may be anything."""
    try:
        yield
    except FdtasilError:
        raise
    except Exception as error:
        raise cannot_be_asked(str(path), error) from error


def _natural_inputs(model: "onnx.ModelProto", spaces: Spaces | None) -> Mapping[str, Given]:
    """Return what inputs are given whose names or shapes say it.

    An input that has the name of a part of the observation is given that part, and the only one
    is given all of it where it takes a stack of frames.
    """
    entries = list(free_inputs(model.graph).values())
    if len(entries) == 1:
        sizes = [d.dim_value for d in entries[0].type.tensor_type.shape.dim][1:]
        stacked = len(sizes) > 1 and all(size > 0 for size in sizes)
        return {entries[0].name: slice(0, math.prod(sizes))} if stacked else {}
    found: dict[str, Given] = {}
    for entry in entries:
        with suppress(KeyError):
            columns = spaces.observations.columns(entry.name) if spaces else {}[entry.name]
            found[entry.name] = slice(columns[0], columns[-1] + 1)
    return found | (_chosen(entries, spaces.observations) if spaces else {})


def _chosen(entries: "Sequence[onnx.ValueInfoProto]", observations: Layout) -> dict[str, Choices]:
    """Return the parts that are choices, where an input takes their numbers and not ones."""
    found: dict[str, Choices] = {}
    named = {entry.name: entry for entry in entries}
    for part, start in zip(observations.parts, observations.starts, strict=True):
        if part.name not in named or part.kind != "choice":
            continue
        dimensions = named[part.name].type.tensor_type.shape.dim[1:]
        if math.prod(dimension.dim_value for dimension in dimensions) == len(part.sizes):
            ends = np.cumsum([start, *part.sizes]).tolist()
            found[part.name] = Choices(tuple(pairwise(ends)), part.first)
    return found


def _declared_size(model: "onnx.ModelProto") -> int:
    """Return n as the only input says it; 0 where it leaves it open, or there are several."""
    inputs = list(free_inputs(model.graph).values())
    dimensions = inputs[0].type.tensor_type.shape.dim if len(inputs) == 1 else []
    return max(0, dimensions[-1].dim_value) if dimensions else 0


def _is_straight(model: "onnx.ModelProto") -> bool:
    """Whether no node repeats others, so that any observation is answered in about equal time."""
    return not model.functions and not {"Loop", "Scan"} & {n.op_type for n in model.graph.node}


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


def _twin(model: "onnx.ModelProto", policy: OnnxPolicy, n: int, path: Path) -> Module | None:
    try:
        return torch_twin(model, policy.output, policy, n)
    except Exception as error:  # the model's own, of onnxruntime
        raise cannot_be_asked(str(path), error) from error
