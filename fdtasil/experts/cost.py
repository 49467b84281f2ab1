"""What a query of an expert costs, as its kind and size say, and never as a clock does."""

import math
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
    "Constant",
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
# Which input of a product of matrices is the right one.
_RIGHT = {"Gemm": 1, "MatMul": 1, "MatMulInteger": 1, "QLinearMatMul": 3, "QGemm": 3}


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
    if expert.origin.multiply_adds is not None or expert.module is None:
        return expert.origin.multiply_adds
    return _counted(expert.module, observation_size)


def stored_numbers(model: "onnx.ModelProto") -> int | None:
    """Return how many numbers an ONNX model holds, or None if it may use them many times a row."""
    nodes = model.graph.node
    if model.functions or len(nodes) > _MANY or not {n.op_type for n in nodes} <= _ONCE:
        return None
    matrices = _matrices(model)
    if any(n.op_type in _RIGHT and n.input[_RIGHT[n.op_type]] not in matrices for n in nodes):
        return None  # a row meets a matrix of the file once, and others who knows how often
    held = sum(math.prod(tensor.dims) for tensor in model.graph.initializer)
    for node in nodes:
        for entry in node.attribute:
            held += max(len(entry.floats), len(entry.ints), math.prod(entry.t.dims))
    return held


def _matrices(model: "onnx.ModelProto") -> set[str]:
    """Return the names of the values that are matrices of the file.

    Of a quantised network they come out of nodes that have numbers of the file alone.
    """
    axes = {tensor.name: len(tensor.dims) for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "DequantizeLinear" and set(node.input) <= axes.keys():
            axes[node.output[0]] = axes[node.input[0]]
        if node.op_type == "Constant":
            axes[node.output[0]] = len(node.attribute[0].t.dims)
    return {name for name, count in axes.items() if count == 2}


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
