"""A student's ONNX file in the environment's own form: choices go out, and one input a part in."""

from typing import TYPE_CHECKING

import numpy as np

from fdtasil.errors import ExportError
from fdtasil.files.onnx.nodes import Nodes
from fdtasil.files.onnx.session import open_session
from fdtasil.rollouts.spaces import Layout, Part, Spaces
from fdtasil.student.policy import Student

if TYPE_CHECKING:
    import onnx

__all__ = ["check_own_form", "own_form"]

_FLAT, _ANSWER = "fdtasil.obs", "actions"


def _with_choices(model: "onnx.ModelProto", actions: Layout) -> "onnx.ModelProto":
    """Return a model that gives the best of its scores beside them.

    Args:
        model: Its output `actions` holds the scores.
        actions: Of the environment.

    Returns:
        One with the outputs `scores` (batch, m) and `actions`: int64, (batch) for one choice,
        (batch, c) for those of several parts, else in the shape of the space.
    """
    from onnx import TensorProto, helper

    nodes = Nodes("fdtasil.choice_")
    for node in model.graph.node:
        node.output[:] = ["scores" if name == _ANSWER else name for name in node.output]
        node.input[:] = ["scores" if name == _ANSWER else name for name in node.input]
    first = [value for part in actions.parts for value in part.first]
    best = []
    for (start, end), offset in zip(actions.choices, first, strict=True):
        ends = [nodes.integers([value]) for value in (start, end, 1)]
        mine = nodes.node("Slice", "scores", *ends)
        chosen = nodes.node("ArgMax", mine, axis=1, keepdims=1)
        best.append(nodes.node("Add", chosen, nodes.integers([offset])))
    joined = nodes.node("Concat", *best, axis=1)
    single = len(actions.parts) == 1
    shape = actions.parts[0].shape if single else (len(best),)
    if not shape:
        nodes.node("Squeeze", joined, nodes.integers([1]))
    elif len(shape) > 1:
        nodes.node("Reshape", joined, nodes.integers([0, *shape]))
    nodes.name_last(_ANSWER)
    nodes.put_behind(model)
    (scores,) = model.graph.output
    scores.name = "scores"
    kind = helper.make_tensor_value_info(_ANSWER, TensorProto.INT64, ["batch", *shape])
    model.graph.output.append(kind)
    return model


def _with_keys(model: "onnx.ModelProto", observations: Layout) -> "onnx.ModelProto":
    """Return a model that takes each part of an observation by its name.

    Args:
        model: Its only input `obs` (batch, n) holds them all.
        observations: Of the environment.

    Raises:
        ExportError: If one is called as an output is.
    """
    from onnx import TensorProto, helper

    taken = {entry.name for entry in model.graph.output} & set(observations.names)
    if taken:
        raise ExportError(
            f"a part of the observation called {taken.pop()!r}, as an output of the file is",
            "another name",
            'leave inputs= out: the file takes one input, "obs"',
        )
    nodes, columns, inputs = Nodes("fdtasil.key_"), [], []
    for part in observations.parts:
        whole = part.kind in ("choice", "whole")
        kind = TensorProto.INT64 if whole else TensorProto.FLOAT
        inputs.append(helper.make_tensor_value_info(part.name, kind, ["batch", *part.shape]))
        columns.append(_flat(nodes, part, whole))
    nodes.node("Concat", *columns, axis=1)
    nodes.name_last(_FLAT)
    nodes.put_before(model)
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    return model


def own_form(model: "onnx.ModelProto", spaces: Spaces | None, *, keys: bool) -> "onnx.ModelProto":
    """Return a student's model with what its environment's spaces ask for.

    Raises:
        ExportError: If the parts of the observations have no names, where they are asked for.
    """
    from onnx.compose import add_prefix_graph

    # What is inside has names that no part of an observation has.
    model.graph.CopyFrom(add_prefix_graph(model.graph, "fdtasil.", rename_outputs=False))
    if spaces is not None and spaces.actions.choices:
        model = _with_choices(model, spaces.actions)
    if not keys:
        model.graph.input[0].name = "obs"
        for node in model.graph.node:
            node.input[:] = ["obs" if name == _FLAT else name for name in node.input]
        return model
    if spaces is None or len(spaces.observations.names) < len(spaces.observations.parts):
        raise ExportError(
            'inputs="keys" of observations that have none',
            "a student of a dictionary or a tuple of observations",
            'leave inputs= out: the file takes one input, "obs"',
        )
    return _with_keys(model, spaces.observations)


def check_own_form(
    model: "onnx.ModelProto", student: Student, states: np.ndarray, *, keys: bool
) -> None:
    """Compare a file in the environment's own form with its student.

    Args:
        model: From `own_form`.
        student: The student.
        states: (B, n) states of its training.
        keys: Whether it takes each part by its name.

    Raises:
        ExportError: If it can't be run, or answers otherwise.
    """
    spaces = student.spaces
    assert spaces is not None, "keys of observations without names were refused"
    session, layout = open_session(model, "the export"), spaces.observations
    feed = {"obs": states.astype(np.float32)}
    if keys:
        pairs = zip(session.get_inputs(), layout.parts, layout.starts, strict=True)
        feed = {
            entry.name: part.values(states[:, start : start + part.size]).astype(
                np.int64 if entry.type == "tensor(int64)" else np.float32
            )
            for entry, part, start in pairs
        }
    scores, *chosen = (np.asarray(found) for found in session.run(None, feed))
    expected = student.act(layout.rows(layout.values(states)).astype(np.float32))
    near = np.abs(scores - expected).max() <= _NEAR * max(1.0, float(np.abs(expected).max()))
    best = spaces.actions.values(scores) if chosen else None
    if len(spaces.actions.parts) > 1:
        best = None  # parts of several kinds, whose choices are given side by side
    if near and (best is None or np.array_equal(chosen[0], best)):
        return
    raise ExportError(
        "the ONNX file in the environment's own form answers otherwise than the student",
        "the same answers",
        'leave inputs= out, and tell us: the file takes one input, "obs"',
    )


_NEAR = 1e-4


def _flat(nodes: Nodes, part: Part, whole: bool) -> str:
    from onnx import TensorProto

    if part.kind != "choice":
        given = nodes.node("Cast", part.name, to=TensorProto.FLOAT) if whole else part.name
        return nodes.node("Reshape", given, nodes.integers([0, part.size]))
    entries = nodes.node("Reshape", part.name, nodes.integers([-1, len(part.sizes)]))
    hot = []
    for entry, (size, first) in enumerate(zip(part.sizes, part.first, strict=True)):
        ends = [nodes.integers([value]) for value in (entry, entry + 1, 1)]
        mine = nodes.node("Sub", nodes.node("Slice", entries, *ends), nodes.integers([first]))
        row = nodes.node("Squeeze", mine, nodes.integers([1]))
        hot.append(
            nodes.node("OneHot", row, nodes.integers([size]), nodes.constant([0.0, 1.0]), axis=1)
        )
    return nodes.node("Concat", *hot, axis=1)
