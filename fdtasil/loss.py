"""The Taylor loss: match the expert's actions, and its differences along the probes."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fdtasil.probes import Stencil

__all__ = ["Minibatch", "TaylorLoss", "taylor_loss"]


@dataclass(frozen=True)
class Minibatch:
    """What one training step sees.

    Attributes:
        observations: (B, n).
        actions: (B, m) expert actions.
        displacements: (B, k, n) where each state is probed, or None without probes.
        values: (B, k, p, m) what the expert said there, or None.
    """

    observations: Tensor
    actions: Tensor
    displacements: Tensor | None = None
    values: Tensor | None = None


@dataclass(frozen=True)
class TaylorLoss:
    """The loss of a minibatch and its two parts.

    Attributes:
        total: (), what is minimised: `action + weight * derivative`.
        action: (), mean norm of the action error.
        derivative: (), mean norm of the error of the differences, in units of the Jacobian's
            Frobenius norm; 0 without probes.
    """

    total: Tensor
    action: Tensor
    derivative: Tensor


def taylor_loss(
    student: nn.Module, batch: Minibatch, stencil: Stencil | None, weight: float, gain: float
) -> TaylorLoss:
    """Compare a student with the expert's answers (TaSIL, equation 5 with p = 1; appendix).

    Student and expert are differenced on the same float32 points, so the loss is zero at the
    expert whatever the radius and however rough the expert. Both norms are unsquared, as in the
    paper's experiments.

    Args:
        student: (B, n) -> (B, m).
        batch: B states with k probes each.
        stencil: How the expert was differenced; None without probes.
        weight: lambda_1, the weight of the derivative error.
        gain: From `Answers`, so that the weight means the same for every design, number of
            probes and radius.

    Example:
        >>> batch = Minibatch(torch.zeros(2, 3), torch.ones(2, 3))
        >>> taylor_loss(nn.Identity(), batch, None, weight=0.0, gain=1.0).total
        tensor(1.7321)
    """
    if stencil is None or batch.displacements is None or batch.values is None:
        action = _mean_norm(student(batch.observations) - batch.actions)
        return TaylorLoss(action, action, torch.zeros_like(action))
    errors = _exact_errors if stencil.exact else _difference_errors
    action_error, derivative_error = errors(
        student, batch, batch.displacements, batch.values, stencil
    )
    probes = derivative_error.shape[1]
    action = _mean_norm(action_error)
    derivative = gain / probes**0.5 * _mean_norm(derivative_error.flatten(1))
    return TaylorLoss(action + weight * derivative, action, derivative)


def _difference_errors(
    student: nn.Module, batch: Minibatch, displacements: Tensor, values: Tensor, stencil: Stencil
) -> tuple[Tensor, Tensor]:
    """Return the errors (B, m) at the states and (B, k, m) of the first differences."""
    rows, n = batch.observations.shape
    offsets = torch.tensor(stencil.offsets, device=displacements.device)
    points = batch.observations[:, None, None, :] + displacements[:, :, None, :] * offsets[:, None]
    # One forward pass over all points: a stencil must see one and the same function.
    answers = student(torch.cat([batch.observations, points.reshape(-1, n)]))
    action_error = answers[:rows] - batch.actions
    value_errors = answers[rows:].reshape(values.shape) - values
    weights = torch.tensor(stencil.weights, device=displacements.device)
    # The difference of errors is the error of the difference: both are linear.
    derivative_error = torch.einsum("p,bkpm->bkm", weights, value_errors)
    return action_error, derivative_error + stencil.centre * action_error[:, None, :]


def _exact_errors(
    student: nn.Module, batch: Minibatch, displacements: Tensor, values: Tensor, stencil: Stencil
) -> tuple[Tensor, Tensor]:
    """Return the errors (B, m) at the states and (B, k, m) of the exact derivatives."""
    count = displacements.shape[1]
    states = batch.observations.repeat_interleave(count, dim=0)
    answers, slopes = _derivative_along(student, states, displacements.flatten(0, 1))
    action_error = answers[::count] - batch.actions
    return action_error, slopes.reshape(values[:, :, 0].shape) - values[:, :, 0]


def _derivative_along(
    student: nn.Module, states: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return f(x) and J u, each (B, m), differentiable.

    Reverse mode twice: v'J is linear in v, and its derivative there is J. Forward mode takes half
    as long again, for its formulas of the activations are decomposed into many small operations.
    """
    states = states.detach().requires_grad_()
    answers = student(states)
    dummy = torch.zeros_like(answers, requires_grad=True)
    (pulled,) = torch.autograd.grad(answers, states, dummy, create_graph=True)
    (slopes,) = torch.autograd.grad(pulled, dummy, directions, create_graph=True)
    return answers, slopes


def _mean_norm(errors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(errors, dim=-1).mean()
