"""Torch modules as ONNX graphs: a layer is a node or a few, and a module may write its own."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from torch import Tensor, nn

if TYPE_CHECKING:
    import onnx

__all__ = ["OPSET", "Graph", "can_write", "write_model"]

OPSET = 18
"""Old enough for the runtimes on robots, new enough for torch's exporter."""
_IR_VERSION = 8  # the oldest that has this opset


@runtime_checkable
class Writable(Protocol):
    """A module that knows its own nodes."""

    def write_onnx(self, graph: "Graph", value: str) -> str:
        """Add the nodes that turn `value` into the module's answer, and return its name."""
        ...


class Graph:
    """Nodes and constants of a graph that grows."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Tensor | np.ndarray | float) -> str:
        """Add a float32 constant, and return its name."""
        from onnx import numpy_helper

        plain = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
        name, array = f"constant_{len(self.constants)}", np.array(plain, np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def integers(self, values: Sequence[int] | int) -> str:
        """Add a constant of integers, and return its name."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, np.int64), name))
        return name

    def node(self, operator: str, *values: str, **attributes: Any) -> str:
        """Add a node, and return the name of its value."""
        from onnx import helper

        name = f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, values, [name], name, **attributes))
        return name

    def module(self, module: nn.Module, value: str) -> str:
        """Add what turns `value` into a module's answer, and return its name.

        Raises:
            KeyError: If it is a layer without a row in the table.
        """
        if isinstance(module, Writable):
            return module.write_onnx(self, value)
        return LAYERS[type(module)](self, module, value)


def can_write(module: nn.Module) -> bool:
    """Return whether a module's graph can be written without torch's exporter."""
    if isinstance(module, nn.Sequential):
        return all(map(can_write, module))
    if isinstance(module, Writable):
        return all(map(can_write, module.children()))
    return type(module) in LAYERS


def write_model(module: nn.Module, observation_size: int, action_size: int) -> "onnx.ModelProto":
    """Return the model of a module: `obs` (batch, n) -> `actions` (batch, m), float32.

    Raises:
        KeyError: If `can_write` says no.
    """
    from onnx import TensorProto, helper

    graph = Graph()
    if graph.module(module, "obs") == "obs":
        graph.node("Identity", "obs")
    graph.nodes[-1].output[0] = "actions"
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("obs", observation_size), ("actions", action_size))
    ]
    body = helper.make_graph(graph.nodes, "policy", ends[:1], ends[1:], graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    return helper.make_model(
        body, opset_imports=opset, ir_version=_IR_VERSION, producer_name="fdtasil"
    )


Writer = Callable[[Graph, Any, str], str]


def _one(operator: str, **fields: str) -> Writer:
    """Return the writer of a layer that is one node; `fields` name attributes of the layer."""

    def write(graph: Graph, layer: nn.Module, value: str) -> str:
        attributes = {name: float(getattr(layer, field)) for name, field in fields.items()}
        return graph.node(operator, value, **attributes)

    return write


def _sequential(graph: Graph, layers: nn.Sequential, value: str) -> str:
    for layer in layers:
        value = graph.module(layer, value)
    return value


def _linear(graph: Graph, layer: nn.Linear, value: str) -> str:
    constants = [graph.constant(layer.weight)]
    constants += [] if layer.bias is None else [graph.constant(layer.bias)]
    return graph.node("Gemm", value, *constants, transB=1)


def _gelu(graph: Graph, layer: nn.GELU, value: str) -> str:
    # In this order onnxruntime replaces them by one kernel: three quarters of the time.
    if layer.approximate == "tanh":
        cube = graph.node("Mul", graph.node("Mul", value, value), value)
        inner = graph.node("Add", value, graph.node("Mul", cube, graph.constant(0.044715)))
        scaled = graph.node("Mul", inner, graph.constant((2 / np.pi) ** 0.5))
        bent = graph.node("Tanh", scaled)
    else:
        bent = graph.node("Erf", graph.node("Div", value, graph.constant(2**0.5)))
    product = graph.node("Mul", value, graph.node("Add", bent, graph.constant(1.0)))
    return graph.node("Mul", product, graph.constant(0.5))


def _silu(graph: Graph, layer: nn.SiLU, value: str) -> str:
    return graph.node("Mul", value, graph.node("Sigmoid", value))


def _hardtanh(graph: Graph, layer: nn.Hardtanh, value: str) -> str:
    low, high = graph.constant(layer.min_val), graph.constant(layer.max_val)
    return graph.node("Clip", value, low, high)


def _softplus(graph: Graph, layer: nn.Softplus, value: str) -> str:
    if layer.beta == 1:
        return graph.node("Softplus", value)
    beta = graph.constant(layer.beta)
    return graph.node("Div", graph.node("Softplus", graph.node("Mul", value, beta)), beta)


LAYERS: dict[type[nn.Module], Writer] = {
    nn.CELU: _one("Celu", alpha="alpha"),
    nn.ELU: _one("Elu", alpha="alpha"),
    nn.GELU: _gelu,
    nn.Hardswish: _one("HardSwish"),
    nn.Hardtanh: _hardtanh,
    nn.Identity: lambda graph, layer, value: value,
    nn.LeakyReLU: _one("LeakyRelu", alpha="negative_slope"),
    nn.Linear: _linear,
    nn.Mish: _one("Mish"),
    nn.ReLU: _one("Relu"),
    nn.ReLU6: _hardtanh,
    nn.SELU: _one("Selu"),
    nn.Sequential: _sequential,
    nn.SiLU: _silu,
    nn.Sigmoid: _one("Sigmoid"),
    nn.Softplus: _softplus,
    nn.Softsign: _one("Softsign"),
    nn.Tanh: _one("Tanh"),
}
"""The layers that have a graph."""
