"""The paper's synthetic system, whose stability is a parameter (TaSIL, stability experiments)."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import nn

from fdtasil.seeding import torch_generator

__all__ = ["CONTRACTION", "SIZE", "SyntheticSystem", "advance", "as_function", "make_expert"]

SIZE = 10
"""Coordinates of the state, and of the input."""
CONTRACTION = 0.95
"""eta: how much of a deviation a step leaves."""
_GAIN = 5.0
_WIDTHS = (SIZE, 32, 32, SIZE)
_BIAS = 0.1


class SyntheticSystem(gymnasium.Env):
    """x+ = eta x + (1 - eta) gamma(|e|) e / |e|, where e = h(x) + u and gamma(r) = 5 r^nu.

    The expert -h leaves x+ = eta x whatever nu is; an error of its imitators pushes the state by
    gamma of its size. Episodes start at a standard normal state and have no end.

    The inputs have no bounds: clipping would hide the errors that this system is about, and a
    student of unbounded actions has a linear output.

    Rounding is an error too: gamma(1e-7) is 2.2 at nu = 0.05. At nu below 1 an expert that
    computes h in another order than the system, as a batch does, does not stay on its own path.

    Args:
        nu: The exponent.
        seed: Of h.
    """

    def __init__(self, nu: float, seed: int) -> None:
        everything = np.full(SIZE, np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-everything, everything)
        self.action_space = gymnasium.spaces.Box(-everything, everything)
        self._nu = nu
        self._expert = as_function(make_expert(seed))
        self._state = np.zeros(SIZE)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start anew; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self._state = self.np_random.standard_normal(SIZE)
        return self._state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move by one step; the reward is -|x|^2 of the state that is left."""
        reward = -float(self._state @ self._state)
        error = action - self._expert(self._state[None].astype(np.float32))[0]
        self._state = advance(self._state, error, self._nu)
        return self._state.astype(np.float32), reward, False, False, {}


def advance(states: np.ndarray, errors: np.ndarray, nu: float | np.ndarray) -> np.ndarray:
    """Return the states after one step.

    Args:
        states: (..., 10) x.
        errors: (..., 10) h(x) + u, how far the input is from the expert's.
        nu: The exponent; broadcast against (..., 1).
    """
    size = np.linalg.norm(errors, axis=-1, keepdims=True)
    # Not gamma(r) / r times the error: that is infinite times zero at the expert.
    direction = np.divide(errors, size, out=np.zeros(errors.shape), where=size > 0)
    return CONTRACTION * states + (1 - CONTRACTION) * _GAIN * size**nu * direction


def make_expert(seed: int) -> nn.Module:
    """Return the expert -h: (B, 10) -> (B, 10), h a random MLP with a tanh at its end.

    Kernels are LeCun normal, biases have a standard deviation of 0.1; equal seeds give equal
    experts.
    """
    random = torch_generator(seed, "synthetic system")
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(_WIDTHS):
        layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
        nn.init.normal_(layer.weight, std=inputs**-0.5, generator=random)
        nn.init.normal_(layer.bias, std=_BIAS, generator=random)
        layers += [layer, nn.GELU()]
    return nn.Sequential(*layers[:-1], nn.Tanh(), _Negative()).requires_grad_(False)


def as_function(module: nn.Module) -> Callable[[np.ndarray], np.ndarray]:
    """Return a module as a black box that can be asked, (B, n) float32 -> (B, m), and no more."""

    def answer(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return module(torch.from_numpy(observations)).numpy()

    return answer


class _Negative(nn.Module):
    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return -values
