"""A student in numpy alone, for one observation in microseconds and for machines without torch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["PLAIN", "PlainPolicy"]


def _gelu(x: np.ndarray) -> np.ndarray:
    """Return x times the normal distribution function of x, to 2e-7 of x.

    With the error function of Abramowitz and Stegun, 7.1.26. In place: of one row, the calls
    take longer than the numbers.
    """
    size = np.abs(x)
    root = size * 0.7071067811865476
    t = 0.3275911 * root
    t += 1
    np.reciprocal(t, out=t)
    tail = 1.061405429 * t
    for coefficient in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail += coefficient
        tail *= t
    root *= root
    np.negative(root, out=root)
    tail *= np.exp(root, out=root)
    tail *= size
    tail *= 0.5
    return np.maximum(x, 0) - tail


def _silu(x: np.ndarray) -> np.ndarray:
    return x * (0.5 + 0.5 * np.tanh(0.5 * x))  # without an overflow


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


PLAIN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": _elu,
    "gelu": _gelu,
    "relu": _relu,
    "silu": _silu,
    "tanh": np.tanh,
}
"""Every activation by its name in `Mlp`."""


@dataclass(frozen=True)
class PlainPolicy:
    """Linear layers with an activation between them, normaliser and bounds included.

    Attributes:
        mean: (n,) subtracted from an observation.
        scale: (n,) that it is divided by.
        layers: Weights (outputs, inputs) and biases of each layer.
        activation: Its name in `PLAIN`.
        bounded: (m,) bool, the actions that are squashed.
        centre: (m,) middle of each action.
        half: (m,) half the range of each.
    """

    mean: np.ndarray
    scale: np.ndarray
    layers: Sequence[tuple[np.ndarray, np.ndarray]]
    activation: str
    bounded: np.ndarray
    centre: np.ndarray
    half: np.ndarray

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """(n,) or (B, n) raw observations -> (m,) or (B, m) float32 actions."""
        value = (observation - self.mean) / self.scale
        *hidden, (weights, biases) = self.layers
        bend = PLAIN[self.activation]
        for inner, offsets in hidden:
            value = value @ inner.T
            value += offsets
            value = bend(value)
        value = value @ weights.T + biases
        squashed = np.where(self.bounded, np.tanh(value), value)
        return (self.centre + self.half * squashed).astype(np.float32)
