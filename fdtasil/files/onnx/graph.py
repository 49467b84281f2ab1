"""Torch modules as ONNX graphs: a layer is a node or a few, and a module may write its own."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from torch import nn

from fdtasil.files.onnx.nodes import Nodes

if TYPE_CHECKING:
    import onnx

__all__ = ["OPSET", "add_module", "can_write", "write_model"]

OPSET = 18
"""Old enough for the runtimes on robots, new enough for torch's exporter."""
_IR_VERSION = 8  # the oldest that has this opset


@runtime_checkable
class Writable(Protocol):
    """A module that knows its own nodes."""

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add the nodes that turn `value` into the module's answer, and return its name."""
        ...


def add_module(nodes: Nodes, module: nn.Module, value: str) -> str:
    """Add what turns `value` into a module's answer, and return its name.

    Raises:
        KeyError: If it is a layer without a row in the table.
    """
    if isinstance(module, Writable):
        return module.write_onnx(nodes, value)
    return LAYERS[type(module)](nodes, module, value)


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

    nodes = Nodes()
    if add_module(nodes, module, "obs") == "obs":
        nodes.node("Identity", "obs")
    nodes.name_last("actions")
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("obs", observation_size), ("actions", action_size))
    ]
    body = helper.make_graph(nodes.nodes, "policy", ends[:1], ends[1:], nodes.constants)
    opset = [helper.make_opsetid("", OPSET)]
    return helper.make_model(
        body, opset_imports=opset, ir_version=_IR_VERSION, producer_name="fdtasil"
    )


Writer = Callable[[Nodes, Any, str], str]


def _one(operator: str, **fields: str) -> Writer:
    """Return the writer of a layer that is one node; `fields` name attributes of the layer."""

    def write(nodes: Nodes, layer: nn.Module, value: str) -> str:
        attributes = {name: float(getattr(layer, field)) for name, field in fields.items()}
        return nodes.node(operator, value, **attributes)

    return write


def _sequential(nodes: Nodes, layers: nn.Sequential, value: str) -> str:
    for layer in layers:
        value = add_module(nodes, layer, value)
    return value


def _linear(nodes: Nodes, layer: nn.Linear, value: str) -> str:
    constants = [nodes.constant(layer.weight)]
    constants += [] if layer.bias is None else [nodes.constant(layer.bias)]
    return nodes.node("Gemm", value, *constants, transB=1)


def _gelu(nodes: Nodes, layer: nn.GELU, value: str) -> str:
    # In this order onnxruntime replaces them by one kernel: three quarters of the time.
    if layer.approximate == "tanh":
        cube = nodes.node("Mul", nodes.node("Mul", value, value), value)
        inner = nodes.node("Add", value, nodes.node("Mul", cube, nodes.constant(0.044715)))
        scaled = nodes.node("Mul", inner, nodes.constant((2 / np.pi) ** 0.5))
        bent = nodes.node("Tanh", scaled)
    else:
        bent = nodes.node("Erf", nodes.node("Div", value, nodes.constant(2**0.5)))
    product = nodes.node("Mul", value, nodes.node("Add", bent, nodes.constant(1.0)))
    return nodes.node("Mul", product, nodes.constant(0.5))


def _silu(nodes: Nodes, layer: nn.SiLU, value: str) -> str:
    return nodes.node("Mul", value, nodes.node("Sigmoid", value))


def _hardtanh(nodes: Nodes, layer: nn.Hardtanh, value: str) -> str:
    low, high = nodes.constant(layer.min_val), nodes.constant(layer.max_val)
    return nodes.node("Clip", value, low, high)


def _softplus(nodes: Nodes, layer: nn.Softplus, value: str) -> str:
    if layer.beta == 1:
        return nodes.node("Softplus", value)
    beta = nodes.constant(layer.beta)
    return nodes.node("Div", nodes.node("Softplus", nodes.node("Mul", value, beta)), beta)


LAYERS: dict[type[nn.Module], Writer] = {
    nn.CELU: _one("Celu", alpha="alpha"),
    nn.ELU: _one("Elu", alpha="alpha"),
    nn.GELU: _gelu,
    nn.Hardswish: _one("HardSwish"),
    nn.Hardtanh: _hardtanh,
    nn.Identity: lambda nodes, layer, value: value,
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
