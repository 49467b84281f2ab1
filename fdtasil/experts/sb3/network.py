"""The parts of an agent as torch modules, from observations to actions in environment units."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.errors import ExpertError, shown
from fdtasil.experts.sb3.recipes import Recipe
from fdtasil.experts.sb3.spaces import Bounds
from fdtasil.experts.sb3.trust import TRUST
from fdtasil.files.onnx.nodes import Nodes

__all__ = ["Clip", "MeanOfQuantiles", "Normalise", "Rescale", "build_network"]


@dataclass(frozen=True)
class ObservationStatistics:
    """What VecNormalize knows of observations.

    Attributes:
        mean: (n,) float64.
        scale: (n,) float64, the standard deviation with epsilon in it.
        clip: (n,) float64, the largest absolute value of a normalised number; infinite where
            nothing is normalised.
    """

    mean: np.ndarray
    scale: np.ndarray
    clip: np.ndarray


class Normalise(nn.Module):
    """What VecNormalize does to observations."""

    mean: Tensor
    rest: Tensor
    scale: Tensor
    clip: Tensor

    def __init__(self, statistics: ObservationStatistics) -> None:
        super().__init__()
        # stable-baselines3 does this in float64. Two float32 numbers hold the mean as well, and
        # the subtraction of the first is exact where it matters: near the mean.
        mean = statistics.mean.astype(np.float32)
        self.register_buffer("mean", torch.from_numpy(mean))
        self.register_buffer("rest", torch.from_numpy(statistics.mean - mean).float())
        self.register_buffer("scale", torch.from_numpy(statistics.scale).float())
        self.register_buffer("clip", torch.from_numpy(statistics.clip).float())

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) raw -> (B, n) normalised observations."""
        normalised = (observations - self.mean - self.rest) / self.scale
        return torch.minimum(torch.maximum(normalised, -self.clip), self.clip)

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add its nodes to an ONNX graph; see `Writable`."""
        for shift in (self.mean, self.rest):
            value = nodes.node("Sub", value, nodes.constant(shift))
        normalised = nodes.node("Div", value, nodes.constant(self.scale))
        raised = nodes.node("Max", normalised, nodes.constant(-self.clip))
        return nodes.node("Min", raised, nodes.constant(self.clip))


class _Bounded(nn.Module):
    low: Tensor
    high: Tensor

    def __init__(self, bounds: Bounds) -> None:
        super().__init__()
        self.register_buffer("low", torch.from_numpy(bounds.low.copy()))
        self.register_buffer("high", torch.from_numpy(bounds.high.copy()))


class Rescale(_Bounded):
    """Takes squashed actions to the bounds, in the order of operations of stable-baselines3."""

    def forward(self, squashed: Tensor) -> Tensor:
        """(B, m) in -1..1 -> (B, m) in environment units."""
        return self.low + 0.5 * (squashed + 1.0) * (self.high - self.low)

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add its nodes to an ONNX graph; see `Writable`."""
        shifted = nodes.node("Add", value, nodes.constant(1.0))
        halved = nodes.node("Mul", shifted, nodes.constant(0.5))
        scaled = nodes.node("Mul", halved, nodes.constant(self.high - self.low))
        return nodes.node("Add", scaled, nodes.constant(self.low))


class Clip(_Bounded):
    """Clips actions to the bounds."""

    def forward(self, actions: Tensor) -> Tensor:
        """(B, m) -> (B, m), both in environment units."""
        return torch.minimum(torch.maximum(actions, self.low), self.high)

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add its nodes to an ONNX graph; see `Writable`."""
        raised = nodes.node("Max", value, nodes.constant(self.low))
        return nodes.node("Min", raised, nodes.constant(self.high))


class MeanOfQuantiles(nn.Module):
    """Takes the quantiles of each score to their mean."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def forward(self, quantiles: Tensor) -> Tensor:
        """(B, count * m) -> (B, m)."""
        return quantiles.unflatten(1, (self.count, -1)).mean(dim=1)

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add its nodes to an ONNX graph; see `Writable`."""
        apart = nodes.node("Reshape", value, nodes.integers([0, self.count, -1]))
        return nodes.node("ReduceMean", apart, nodes.integers([1]), keepdims=0)


def build_network(
    weights: Mapping[str, Tensor],
    recipe: Recipe,
    activation: type[nn.Module],
    sizes: tuple[int, int],
    source: str,
) -> nn.Sequential:
    """Build the layers of a policy, with the tanh of a squashed one.

    Args:
        weights: The policy's state dict.
        recipe: Of its algorithm.
        activation: Put between the layers.
        sizes: n and m, as the spaces say.
        source: Name of the zip, for messages.

    Returns:
        (B, n) normalised observations -> (B, m) actions, before the bounds.

    Raises:
        ExpertError: If there are weights that an MLP policy does not have, or layers that do not
            fit each other.
    """
    known = (*recipe.layers, *recipe.unused)
    strange = [name for name in weights if not name.startswith(tuple(f"{k}." for k in known))]
    strange = [name for name in strange if name not in recipe.unused]
    if strange:
        raise ExpertError(
            f"{source} has weights that no MLP policy has: {shown(', '.join(strange[:3]))}",
            f"weights of {', '.join(known)}",
            TRUST,
        )
    pairs = [pair for prefix in recipe.layers for pair in _pairs(weights, prefix, source)]
    _check_chain(pairs, sizes, source)
    layers: list[nn.Module] = []
    for weight, bias in pairs:
        layers += [_linear(weight, bias), activation()]
    layers[-1:] = [nn.Tanh()] if recipe.squashed else []
    return nn.Sequential(*layers)


def _pairs(weights: Mapping[str, Tensor], prefix: str, source: str) -> list[tuple[Tensor, Tensor]]:
    """Return the weights and biases under a prefix: of one layer, or of every second of a list."""
    names = {name for name in weights if name.startswith(f"{prefix}.")}
    bare = re.compile(rf"{re.escape(prefix)}\.(weight|bias)")
    stems = [prefix] if any(bare.fullmatch(name) for name in names) else []
    stems = stems or [f"{prefix}.{2 * index}" for index in range(len(names) // 2)]
    if names != {f"{stem}.{part}" for stem in stems for part in ("weight", "bias")}:
        raise ExpertError(
            f"{source} has layers that are not linear: {shown(', '.join(sorted(names)))}",
            "linear layers and activations in turn",
            TRUST,
        )
    return [(weights[f"{stem}.weight"], weights[f"{stem}.bias"]) for stem in stems]


def _check_chain(pairs: list[tuple[Tensor, Tensor]], sizes: tuple[int, int], source: str) -> None:
    shapes = [tuple(weight.shape) for weight, _ in pairs]
    fits = bool(pairs) and all(
        weight.ndim == 2 and bias.shape == weight.shape[:1] and _is_plain(weight, bias)
        for weight, bias in pairs
    )
    fits = fits and all(after[1] == before[0] for before, after in pairwise(shapes))
    if not fits or (shapes[0][1], shapes[-1][0]) != sizes:
        raise ExpertError(
            f"{source} has layers of shapes {', '.join(map(str, shapes)) or 'none'}",
            f"finite layers that lead from {sizes[0]} observations to {sizes[1]} actions",
            "copy or download the file again",
        )


def _is_plain(*tensors: Tensor) -> bool:
    # A tensor may claim to be larger than its storage by stepping over the same number again.
    return all(
        tensor.layout == torch.strided
        and tensor.is_floating_point()
        and tensor.is_contiguous()
        and bool(tensor.isfinite().all())
        for tensor in tensors
    )


def _linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    # On "meta" nothing is drawn from torch's global generator, whose state is the caller's.
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.weight = nn.Parameter(weight.detach().float().clone())
    layer.bias = nn.Parameter(bias.detach().float().clone())
    return layer
