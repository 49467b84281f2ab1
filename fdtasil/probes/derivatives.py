"""The analytic reference: exact directional derivatives of an expert that is a torch module."""

from collections.abc import Callable

import numpy as np
import torch

from fdtasil.errors import ExpertError
from fdtasil.experts.expert import Expert

__all__ = ["differentiate"]

_STATES = 64  # differentiated at once


def differentiate(
    expert: Expert,
    observations: np.ndarray,
    directions: np.ndarray,
    numbers: np.ndarray,
    order: int,
) -> np.ndarray:
    """Differentiate the expert along directions.

    Args:
        expert: A differentiable one.
        observations: (N, n) float32 states.
        directions: (P, n) float32 bank.
        numbers: (N, k) rows of the bank, those of each state.
        order: 1, or 2 for second derivatives too.

    Returns:
        (N, k, order, m) float32 directional derivatives.

    Raises:
        ExpertError: If the expert can't be differentiated.
    """
    module = expert.module
    if module is None:
        raise ExpertError(
            f"{expert.name} can't be differentiated",
            "a torch module, or an ONNX file made of the operators of an MLP",
            'probe it instead: probes="basis" or probes=10',
        )
    like = next(module.parameters(), torch.zeros(()))
    along = torch.func.vmap(_derivatives_along(module, order), in_dims=(None, 0))
    every = torch.func.vmap(along)
    parts = []
    for start in range(0, len(observations), _STATES):
        rows = slice(start, start + _STATES)
        states = torch.from_numpy(observations[rows]).to(like.device, like.dtype)
        moved = torch.from_numpy(directions[numbers[rows]]).to(like.device, like.dtype)
        with torch.no_grad():
            parts.append(every(states, moved).float().cpu().numpy())
    return np.concatenate(parts)


def _derivatives_along(
    module: torch.nn.Module, order: int
) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """Return the function from a state and a direction to the (order, m) derivatives there."""

    def first(x: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        return torch.func.jvp(lambda y: module(y[None])[0], (x,), (direction,))[1]

    def derivatives(x: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        if order == 1:
            return first(x, direction)[None]
        both = torch.func.jvp(lambda y: first(y, direction), (x,), (direction,))
        return torch.stack(both[:2])

    return derivatives
