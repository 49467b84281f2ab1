"""Several inputs of an ONNX model made one: columns of the observation, or constants."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fdtasil.errors import SettingError, shown
from fdtasil.files.onnx.nodes import Nodes, free_inputs

if TYPE_CHECKING:
    import onnx

__all__ = ["Choices", "Given", "Inputs", "bind", "check_inputs"]

Inputs = Mapping[str, Any] | str
"""Name of an input -> a number or an array, which it is given always, or "0:17" (a slice as well),
the columns of the observation that it is given; as a text "time_step=0,obs=0:17"."""


@dataclass(frozen=True)
class Choices:
    """Columns of choices, a one in each of them, of which an input is given the numbers.

    Attributes:
        ends: First column of each choice, and the one after its last, side by side.
        first: Number of the first possibility of each.
    """

    ends: tuple[tuple[int, int], ...]
    first: tuple[int, ...]

    @property
    def start(self) -> int:
        """The first column."""
        return self.ends[0][0]

    @property
    def stop(self) -> int:
        """The one after the last."""
        return self.ends[-1][1]


Given = slice | Choices | np.ndarray
"""What an input is given: columns of the observation, the numbers of choices, or constants."""

_NAME = "fdtasil.observation"
_EXAMPLE = 'write for example inputs={"time_step": 0.0, "obs": "0:17"}'


def check_inputs(inputs: object) -> "dict[str, slice | np.ndarray]":
    """Return inputs by name, each columns or a constant.

    Raises:
        SettingError: If they are something else.
    """
    expected = "names of inputs, each with a number, an array, or columns"
    if isinstance(inputs, str):
        inputs = _read(inputs)
    if not isinstance(inputs, Mapping) or not all(isinstance(name, str) for name in inputs):
        raise SettingError(f"inputs={shown(inputs)[:80]}", expected, _EXAMPLE)
    found: dict[str, slice | np.ndarray] = {}
    for name, given in inputs.items():
        try:
            found[name] = _columns(given) if isinstance(given, str | slice) else _constant(given)
        except (TypeError, ValueError):
            said = f"inputs: {shown(name)!r} is {shown(given)[:60]}"
            raise SettingError(said, expected, _EXAMPLE) from None
    return found


def _read(text: str) -> Mapping[str, Any]:
    try:
        pairs = [part.split("=") for part in text.split(",")]
        return {name.strip(): value if ":" in value else float(value) for name, value in pairs}
    except ValueError:
        found = f"inputs {shown(text)!r}"
        raise SettingError(
            found, "NAME=NUMBER or NAME=START:STOP", "time_step=0,obs=0:17"
        ) from None


def _columns(given: str | slice) -> slice:
    if isinstance(given, str):
        start, stop = (int(part) for part in given.split(":"))
    else:
        start, stop = int(given.start or 0), int(given.stop)
        if given.step not in (None, 1):
            raise ValueError
    if not 0 <= start < stop:
        raise ValueError
    return slice(start, stop)


def _constant(given: object) -> np.ndarray:
    value = np.asarray(given, np.float64)
    if not np.isfinite(value).all():
        raise ValueError
    return value


def bind(
    model: "onnx.ModelProto", inputs: Mapping[str, Given], size: int | None
) -> "onnx.ModelProto":
    """Return a model of one input, the observation, that computes what the given one does.

    Args:
        model: With its weights loaded; not changed.
        inputs: From `check_inputs`; one input may be left out, which is given the other columns.
        size: n of the environment, or None.

    Raises:
        SettingError: If an input is not there, or is left out besides another one.
    """
    import onnx

    bound = onnx.ModelProto()
    bound.CopyFrom(model)
    graph = bound.graph
    entries = free_inputs(graph)
    parts = _complete(entries, inputs, size)
    n = size or max(part.stop for part in parts.values() if not isinstance(part, np.ndarray))
    nodes = Nodes("fdtasil.input_")
    for name, part in parts.items():
        kind = entries[name].type.tensor_type
        shape = [dimension.dim_value for dimension in kind.shape.dim]
        if isinstance(part, np.ndarray) and len(shape) != 2:
            fixed = np.broadcast_to(part, [size or 1 for size in shape])
            dtype = onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type)
            graph.initializer.append(onnx.numpy_helper.from_array(fixed.astype(dtype), name))
            continue
        if isinstance(part, np.ndarray):
            value = _repeat(nodes, part, shape[1])
        elif isinstance(part, Choices):
            value = _numbers(nodes, part, shape[1:])
        else:
            value = _take(nodes, part, shape)
        nodes.node("Cast", value, to=kind.elem_type)
        nodes.name_last(name)
    nodes.put_before(bound)
    del graph.input[:]
    graph.input.append(
        onnx.helper.make_tensor_value_info(_NAME, onnx.TensorProto.FLOAT, ["batch", n])
    )
    return bound


def _complete(
    entries: "Mapping[str, onnx.ValueInfoProto]",
    inputs: Mapping[str, Given],
    size: int | None,
) -> dict[str, Given]:
    """Return the part of each input; the one that is left out has the columns that are."""
    listed = ", ".join(_described(entry) for entry in entries.values())
    if unknown := [name for name in inputs if name not in entries]:
        raise SettingError(f"inputs: {unknown[0]!r}", f"one of {listed}", "name one of these")
    parts, left = dict(inputs), [name for name in entries if name not in inputs]
    if len(left) > 1:
        written = ", ".join(f'"{name}": ...' for name in left)
        raise SettingError(
            f"inputs: nothing for {' and '.join(map(repr, left))}, of {listed}",
            "all inputs but one, which is given the other columns",
            f'write inputs={{{written}}}, each a number or columns such as "0:3"',
        )
    columns = [part for part in parts.values() if not isinstance(part, np.ndarray)]
    taken = sorted((part.start, part.stop) for part in columns)
    for name in left:
        dimensions = entries[name].type.tensor_type.shape.dim
        width = dimensions[-1].dim_value if dimensions else 0
        # The other columns: those before what is taken, or those behind it.
        before = bool(taken) and taken[0][0] > 0
        start = 0 if not taken or before else taken[-1][1]
        end = taken[0][0] if before else size
        stop = start + width if width else end
        if stop is None or stop <= start or (end is not None and stop > end):
            example = f'write inputs={{"{name}": "{start}:..."}}'
            raise SettingError(
                f"inputs: {_described(entries[name])} is left out, and has no columns of its own",
                "the columns that no other input has",
                example,
            )
        parts[name] = slice(start, stop)
    for name, part in parts.items():
        if not isinstance(part, np.ndarray) and size is not None and part.stop > size:
            found = f"inputs: {name!r} is given columns up to {part.stop}"
            raise SettingError(found, f"columns of {size}", _EXAMPLE)
        _check_width(entries[name], part, listed)
    if all(isinstance(part, np.ndarray) for part in parts.values()):
        raise SettingError(
            "inputs: all of them are constants", "one with the observation", _EXAMPLE
        )
    return parts


def _check_width(entry: "onnx.ValueInfoProto", part: Given, listed: str) -> None:
    """Refuse columns, or a constant, that an input has no place for."""
    dimensions = entry.type.tensor_type.shape.dim
    width = math.prod(dimension.dim_value for dimension in dimensions[1:])
    if not width:
        return
    if isinstance(part, Choices):
        given = len(part.ends)
    else:
        given = part.stop - part.start if isinstance(part, slice) else part.size
    if given != width and not (isinstance(part, np.ndarray) and given == 1):
        raise SettingError(
            f"inputs: {entry.name!r} is given {given} numbers, of {listed}",
            f"{width} of them",
            _EXAMPLE,
        )


def _take(nodes: Nodes, columns: slice, shape: Sequence[int]) -> str:
    """Add columns of the observation, in the shape that an input has."""
    flat = _sliced(nodes, columns.start, columns.stop)
    if len(shape) > 2 and all(size > 0 for size in shape[1:]):
        flat = nodes.node("Reshape", flat, nodes.integers([-1, *shape[1:]]))
    return flat


def _numbers(nodes: Nodes, choices: Choices, shape: Sequence[int]) -> str:
    """Add the numbers of choices, in the shape that an input has."""
    best = []
    for (start, stop), first in zip(choices.ends, choices.first, strict=True):
        chosen = nodes.node("ArgMax", _sliced(nodes, start, stop), axis=1, keepdims=1)
        best.append(nodes.node("Add", chosen, nodes.integers([first])))
    return nodes.node("Reshape", nodes.node("Concat", *best, axis=1), nodes.integers([-1, *shape]))


def _repeat(nodes: Nodes, value: np.ndarray, width: int) -> str:
    """Add a row of a constant for each observation."""
    # Columns of zeros as long as the batch; observations are finite.
    zeros = nodes.node("Mul", _sliced(nodes, 0, 1), nodes.constant([[0.0]]))
    row = np.broadcast_to(value.reshape(1, -1), (1, width or value.size))
    return nodes.node("Add", zeros, nodes.constant(row))


def _sliced(nodes: Nodes, start: int, stop: int) -> str:
    return nodes.node("Slice", _NAME, *(nodes.integers([end]) for end in (start, stop, 1, 1)))


def _described(entry: "onnx.ValueInfoProto") -> str:
    sizes = [d.dim_param or str(d.dim_value) for d in entry.type.tensor_type.shape.dim]
    return shown(f"{entry.name} ({', '.join(sizes)})")
