"""A torch twin of an MLP-type ONNX graph: differentiable, and quick on a GPU."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from fdtasil.files.onnx.nodes import free_inputs
from fdtasil.rollouts.behaviours import largest_action

if TYPE_CHECKING:
    import onnx

__all__ = ["AGREEMENT", "OPERATORS", "torch_twin"]

Operator = Callable[..., Tensor]

AGREEMENT = 1e-4
"""Relative to the largest action; float32 networks reach 1e-6."""
_LARGEST = 2**27  # numbers in one value of a twin on trial: torch has no limit of memory


def torch_twin(
    model: "onnx.ModelProto",
    output: str,
    answer: Callable[[np.ndarray], np.ndarray],
    observation_size: int,
) -> torch.nn.Module | None:
    """Build a torch module that computes what an MLP-type ONNX model computes.

    Args:
        model: With its weights loaded.
        output: Name of the output that holds the actions.
        answer: The session's own answers, which the twin is held against on random states.
        observation_size: n.

    Returns:
        The twin, float32, or None where the output depends on an operator that is not one of an
        MLP, or the twin does not agree with the session.
    """
    try:
        twin = _Twin(model, output)
    except Exception:  # no twin is no failure, and damaged models may raise anything
        return None
    rows = np.random.default_rng(0).standard_normal((64, observation_size)).astype(np.float32)
    expected = answer(rows)
    try:
        with torch.no_grad():
            answers = twin.compute(torch.from_numpy(rows), _LARGEST).numpy()
    except Exception:
        return None
    tolerance = AGREEMENT * largest_action(expected)
    agrees = answers.shape == expected.shape and np.abs(answers - expected).max() <= tolerance
    return twin if agrees else None


class _Twin(torch.nn.Module):
    """Runs the nodes of a graph in their order; the order of an ONNX graph is topological."""

    def __init__(self, model: "onnx.ModelProto", output: str) -> None:
        import onnx

        super().__init__()
        graph = model.graph
        self._constants: dict[str, str] = {}  # by name in the graph, of buffers: they go along
        for tensor in graph.initializer:
            self._keep(tensor.name, tensor)
        (self._input,), self._output = free_inputs(graph), output
        self._nodes: list[tuple[str, list[str], str, dict[str, Any]]] = []
        for node in _needed(graph, output):
            attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
            if node.op_type == "Constant":
                self._keep(node.output[0], attributes["value"])
                continue
            # Its name and not its function: a twin may be sent to another process.
            self._nodes.append((node.op_type, list(node.input), node.output[0], attributes))
        if unknown := {operator for operator, *_ in self._nodes} - OPERATORS.keys():
            raise ValueError(f"{unknown} are no operators of an MLP")

    def _keep(self, name: str, tensor: "onnx.TensorProto") -> None:
        """Keep a constant of the graph, weights as float32, shapes and axes as they are."""
        import onnx

        value = torch.from_numpy(np.array(onnx.numpy_helper.to_array(tensor)))
        self._constants[name] = buffer = f"constant_{len(self._constants)}"
        self.register_buffer(buffer, value.float() if value.is_floating_point() else value)

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) float32 -> (B, m) float32."""
        return self.compute(observations)

    def compute(self, observations: Tensor, largest: int | None = None) -> Tensor:
        """Do the same, with at most `largest` numbers in a value if that is given."""
        values: dict[str, Any] = {"": None, self._input: observations}
        for name, buffer in self._constants.items():
            values[name] = self.get_buffer(buffer)
        for operator, inputs, output, attributes in self._nodes:
            values[output] = OPERATORS[operator](*(values[name] for name in inputs), **attributes)
            if largest is not None and values[output].numel() > largest:
                raise ValueError(f"{output} is larger than anything in an MLP")
        return values[self._output]


def _needed(graph: "onnx.GraphProto", output: str) -> "list[onnx.NodeProto]":
    """Return the nodes that an output depends on; value functions and the like are none of it."""
    wanted, found = {output}, []
    for node in reversed(graph.node):
        if wanted & set(node.output):
            wanted |= set(node.input) - {""}
            found.append(node)
    return found[::-1]


def _gemm(
    a: Tensor,
    b: Tensor,
    c: Tensor | None = None,
    alpha: float = 1.0,
    beta: float = 1.0,
    transA: int = 0,
    transB: int = 0,
) -> Tensor:
    product = alpha * ((a.T if transA else a) @ (b.T if transB else b))
    return product if c is None else product + beta * c


def _clip(x: Tensor, low: Tensor | None = None, high: Tensor | None = None) -> Tensor:
    return x.clamp(low, high) if low is not None or high is not None else x


def _gelu(x: Tensor, approximate: bytes = b"none") -> Tensor:
    return torch.nn.functional.gelu(x, approximate=approximate.decode())


def _slice(x: Tensor, starts: Tensor, ends: Tensor, axes: Tensor, steps: Tensor) -> Tensor:
    if axes.tolist() != [1] or steps.tolist() != [1]:
        raise ValueError("only slices of columns")
    return x[:, int(starts[0]) : int(ends[0])]


OPERATORS: dict[str, Operator] = {
    "Abs": torch.abs,
    "Add": torch.add,
    "Celu": lambda x, alpha=1.0: torch.nn.functional.celu(x, alpha),
    "Cast": lambda x, to: x,  # the twin computes in float32 throughout
    "Clip": _clip,
    "Concat": lambda *parts, axis: torch.cat(parts, dim=axis),
    "Div": torch.div,
    "Elu": lambda x, alpha=1.0: torch.nn.functional.elu(x, alpha),
    "Erf": torch.erf,
    "Exp": torch.exp,
    "Flatten": lambda x, axis=1: x.flatten(axis),
    "Gelu": _gelu,
    "Gemm": _gemm,
    "HardSwish": torch.nn.functional.hardswish,
    "Identity": lambda x: x,
    "LeakyRelu": lambda x, alpha=0.01: torch.nn.functional.leaky_relu(x, alpha),
    "MatMul": torch.matmul,
    "Max": torch.maximum,
    "Min": torch.minimum,
    "Mish": torch.nn.functional.mish,
    "Mul": torch.mul,
    "Neg": torch.neg,
    "Relu": torch.relu,
    "Selu": torch.nn.functional.selu,
    "Sigmoid": torch.sigmoid,
    "Slice": _slice,
    "Softplus": torch.nn.functional.softplus,
    "Softsign": torch.nn.functional.softsign,
    "Sqrt": torch.sqrt,
    "Sub": torch.sub,
    "Tanh": torch.tanh,
}
