"""What a query of an expert costs, as its kind and size say, and never as a clock does."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from fdtasil.experts.expert import Expert
from fdtasil.experts.twin import OPERATORS

if TYPE_CHECKING:
    import onnx

__all__ = ["CHEAP", "multiply_adds", "stored_numbers"]

CHEAP = 2**20
"""Multiply-adds a row up to which a million queries take less than a minute of one core."""

_FEW = 64  # rows at once, below which the calls take longer than the rows
_MANY = 500  # operations: each takes microseconds, whatever it computes

# Operators that use each number of the file at most once for a row: those of an MLP, and others.
_ONCE = OPERATORS.keys() | {
    "ArgMax",
    "BatchNormalization",
    "DequantizeLinear",
    "DynamicQuantizeLinear",
    "LayerNormalization",
    "MatMulInteger",
    "Pow",
    "QGemm",
    "QLinearMatMul",
    "QuantizeLinear",
    "Softmax",
    "TreeEnsemble",
    "TreeEnsembleClassifier",
    "TreeEnsembleRegressor",
    "Where",
}
_RIGHT = {"QLinearMatMul": 3, "QGemm": 3}
_PRODUCTS = {"Gemm", "MatMul", "MatMulInteger", *_RIGHT}
"""Operators that multiply matrices, and which input is the right one, if it is not the second."""


def multiply_adds(expert: Expert, observation_size: int) -> int | None:
    """Return at most how many multiply-adds one row takes.

    Args:
        expert: The expert.
        observation_size: n.

    Returns:
        The number, or None where kind and size do not say it: functions, servers, workers, experts
        that are asked about few rows at once, and networks with loops or memory.

    Example:
        >>> multiply_adds(Expert(lambda rows: rows, "a function"), 3) is None
        True
    """
    if expert.workers is not None or expert.chunk < _FEW:
        return None
    if expert.multiply_adds is not None or expert.module is None:
        return expert.multiply_adds
    return _counted(expert.module, observation_size)


def stored_numbers(model: "onnx.ModelProto") -> int | None:
    """Return how many numbers an ONNX model holds, or None if it may use them many times a row."""
    nodes = model.graph.node
    if model.functions or len(nodes) > _MANY or not {n.op_type for n in nodes} <= _ONCE:
        return None
    if any(n.op_type in _PRODUCTS and not _is_of_weights(n, model) for n in nodes):
        return None
    held = sum(_product(tensor.dims) for tensor in model.graph.initializer)
    for node in nodes:
        for entry in node.attribute:
            held += max(len(entry.floats), len(entry.ints), _product(entry.t.dims))
    return held


def _is_of_weights(node: "onnx.NodeProto", model: "onnx.ModelProto") -> bool:
    """Whether a product has a matrix of the file on its right: a row then meets each number once.

    Of a quantised network that matrix comes out of a node that has numbers of the file alone.
    """
    held = {tensor.name: len(tensor.dims) for tensor in model.graph.initializer}
    for other in model.graph.node:
        if other.op_type == "DequantizeLinear" and set(other.input) <= held.keys():
            held[other.output[0]] = held[other.input[0]]
        if other.op_type == "Constant":
            held[other.output[0]] = len(other.attribute[0].t.dims)
    right = node.input[_RIGHT.get(node.op_type, 1)]
    return held.get(right) == 2


def _product(sizes: Iterable[int]) -> int:
    product = 1
    for size in sizes:
        product *= size
    return product


def _counted(module: torch.nn.Module, observation_size: int) -> int | None:
    """Return what a module does for one row, counted while it does it."""
    like = next(module.parameters(), torch.zeros(()))
    row = torch.zeros((1, observation_size), device=like.device, dtype=like.dtype)
    operations, products = _Operations(), FlopCounterMode(display=False)
    try:
        with torch.no_grad(), products, operations:
            module(row)
    except Exception:  # of the module, which says so itself when it is asked
        return None
    if operations.count > _MANY:
        return None
    return products.get_total_flops() // 2 + operations.numbers


class _Operations(TorchDispatchMode):
    """Counts the operations inside a block, and the numbers that they return."""

    def __init__(self) -> None:
        super().__init__()
        self.count = self.numbers = 0

    def __torch_dispatch__(
        self,
        func: Any,
        types: object,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        self.count += 1
        if isinstance(result, torch.Tensor) and not func.is_view:
            self.numbers += result.numel()
        return result
