"""Nodes and constants of an ONNX graph that grows, and what such a graph is given."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import onnx

__all__ = ["Nodes", "free_inputs"]


class Nodes:
    """Nodes and constants, each with a name of its own.

    Args:
        prefix: What their names begin with.
    """

    def __init__(self, prefix: str = "") -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._prefix = prefix

    def constant(self, value: Any) -> str:
        """Add a float32 constant, a tensor of torch too, and return its name."""
        plain = value.detach().cpu().numpy() if hasattr(value, "detach") else value
        return self._keep(np.array(plain, np.float32))

    def integers(self, values: Sequence[int] | int) -> str:
        """Add a constant of integers, and return its name."""
        return self._keep(np.array(values, np.int64))

    def node(self, operator: str, *values: str, **attributes: Any) -> str:
        """Add a node, and return the name of its value."""
        from onnx import helper

        name = f"{self._prefix}value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, values, [name], name, **attributes))
        return name

    def name_last(self, name: str) -> None:
        """Give the value of the last node a name, which nothing has used yet."""
        self.nodes[-1].output[0] = name

    def put_before(self, model: "onnx.ModelProto") -> None:
        """Let a model begin with these nodes."""
        kept = list(model.graph.node)
        del model.graph.node[:]
        model.graph.node.extend([*self.nodes, *kept])
        model.graph.initializer.extend(self.constants)

    def put_behind(self, model: "onnx.ModelProto") -> None:
        """Let a model end with these nodes."""
        model.graph.node.extend(self.nodes)
        model.graph.initializer.extend(self.constants)

    def _keep(self, value: np.ndarray) -> str:
        from onnx import numpy_helper

        name = f"{self._prefix}constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(value, name))
        return name


def free_inputs(graph: "onnx.GraphProto") -> "dict[str, onnx.ValueInfoProto]":
    """Return the inputs that a graph is given when it runs: old files list their weights too."""
    constants = {tensor.name for tensor in graph.initializer}
    return {entry.name: entry for entry in graph.input if entry.name not in constants}
