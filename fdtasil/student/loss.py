"""The Taylor loss: match the expert's actions, and its differences along the probes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from fdtasil.probes.stencils import Stencil

__all__ = ["Minibatch", "ProbeBatch", "TaylorLoss", "Weights", "taylor_loss"]

Network = Callable[[Tensor], Tensor]
"""A student as it is trained: (B, n) -> (B, m)."""


@dataclass(frozen=True)
class ProbeBatch:
    """What the expert said around the states of a training step.

    Attributes:
        displacements: (B, k, n) where each state is probed.
        values: (B, k, p, m) what the expert said there; see `Answers`.
        gains: (B, k) from `Answers`, so that the weights mean the same for every design, number
            of probes and radius.
    """

    displacements: Tensor
    values: Tensor
    gains: Tensor


@dataclass(frozen=True)
class Minibatch:
    """What one training step sees.

    Attributes:
        observations: (B, n).
        actions: (B, m) expert actions.
        probes: What it said around them; None for plain behaviour cloning.
    """

    observations: Tensor
    actions: Tensor
    probes: ProbeBatch | None = None


@dataclass(frozen=True)
class Weights:
    """The weights of the loss's terms, None for those that it does not have; the actions' is 1.

    Attributes:
        derivative: lambda_1.
        curvature: lambda_2, in a loss of second order.
        moved: Of the actions at the moved states.
    """

    derivative: float | None
    curvature: float | None = None
    moved: float | None = None


class TaylorLoss(NamedTuple):
    """The loss of a minibatch and its parts, by the names that a history has them under.

    Attributes:
        loss: (), what is minimised.
        action_error: (), mean norm of the action error, in units of the actions.
        derivative_error: (), mean norm of the error of the first differences, in units of the
            whitened Jacobian's Frobenius norm; 0 where none are matched.
        curvature_error: (), mean norm of the error of the second differences, in units of z'Hz
            for z of n whitened coordinates, uniform on the sphere of radius sqrt(n); 0 in a loss
            of first order.
        moved_error: (), mean norm of the action error at the moved states, in units of the
            actions; 0 where these answers are not matched as labels.
    """

    loss: Tensor
    action_error: Tensor
    derivative_error: Tensor
    curvature_error: Tensor
    moved_error: Tensor


def taylor_loss(
    student: Network,
    batch: Minibatch,
    stencil: Stencil | None,
    weights: Weights,
    units: Tensor | None = None,
) -> TaylorLoss:
    """Compare a student with the expert's answers (TaSIL, equation 5, p = 0, 1, 2; appendix).

    Student and expert are differenced on the same float32 points, so the loss is zero at the
    expert whatever the radius and however rough the expert. All norms are unsquared, as in the
    paper's experiments.

    Args:
        student: (B, n) -> (B, m).
        batch: B states with k probes each.
        stencil: How the expert was differenced; None without probes (p = 0).
        weights: Of the terms.
        units: (m,) that actions are measured in; None for their own.

    Example:
        >>> batch = Minibatch(torch.zeros(2, 3), torch.ones(2, 3))
        >>> taylor_loss(torch.nn.Identity(), batch, None, Weights(0.0)).loss
        tensor(1.7321)
    """
    probes = batch.probes
    if stencil is None or probes is None:
        action = _mean_norm(student(batch.observations) - batch.actions, units)
        zero = torch.zeros_like(action)
        return TaylorLoss(action, action, zero, zero, zero)
    errors = _exact_errors if stencil.exact else _asked_errors
    found = errors(student, batch, probes, stencil, weights)
    count, gains = probes.displacements.shape[1], probes.gains[..., None]
    action = _mean_norm(found.action, units)
    total, zero = action, torch.zeros_like(action)
    derivative = curvature = moved = zero
    if weights.derivative is not None:
        derivative = _mean_norm(gains * found.first, units) / count**0.5
        total = total + weights.derivative * derivative
    if weights.curvature is not None:
        curvature = _mean_norm(gains**2 * found.second, units) / count**0.5
        total = total + weights.curvature * curvature
    if weights.moved is not None:
        moved = _mean_norm(found.moved, units) / (count * len(stencil.offsets)) ** 0.5
        total = total + weights.moved * moved
    return TaylorLoss(total, action, derivative, curvature, moved)


class _Errors(NamedTuple):
    """A student's errors; any of them stand where a loss has no use for some.

    Attributes:
        action: (B, m) at the states.
        moved: (B, k, p, m) at the moved states.
        first: (B, k, m) of the first differences or derivatives.
        second: (B, k, m) of the second ones.
    """

    action: Tensor
    moved: Tensor
    first: Tensor
    second: Tensor


def _asked_errors(
    student: Network, batch: Minibatch, probes: ProbeBatch, stencil: Stencil, weights: Weights
) -> _Errors:
    (rows, n), values = batch.observations.shape, probes.values
    # Numbers, not tensors of them: a tensor would wait for the GPU at every step.
    moved = torch.stack([offset * probes.displacements for offset in stencil.offsets], dim=2)
    points = batch.observations[:, None, None, :] + moved
    # One forward pass over all points: a stencil must see one and the same function.
    answers = student(torch.cat([batch.observations, points.reshape(-1, n)]))
    action_error = answers[:rows] - batch.actions
    value_errors = answers[rows:].reshape(values.shape) - values

    # The difference of errors is the error of the difference: both are linear.
    def difference(weights: tuple[float, ...], centre: float) -> Tensor:
        total = centre * action_error[:, None, :]
        for weight, errors in zip(weights, value_errors.unbind(dim=2), strict=True):
            total = total + weight * errors
        return total

    first = second = value_errors
    if weights.derivative is not None:
        first = difference(stencil.weights, stencil.centre)
    if weights.curvature is not None and stencil.second is not None:
        *around, centre = stencil.second
        second = difference(tuple(around), centre)
    return _Errors(action_error, value_errors, first, second)


def _exact_errors(
    student: Network, batch: Minibatch, probes: ProbeBatch, stencil: Stencil, weights: Weights
) -> _Errors:
    directions, values = probes.displacements, probes.values
    count, actions = directions.shape[1], batch.actions.shape[1]
    # A direction costs three rows of the network and their gradient, a row of the Jacobian one.
    if weights.curvature is None and 2 * count > actions:
        answers, jacobian = _jacobian(student, batch.observations)
        derivatives = [torch.einsum("mbn,bkn->bkm", jacobian, directions)]
    else:
        along = _derivative_along if weights.curvature is None else _second_derivative_along
        states = batch.observations.repeat_interleave(count, dim=0)
        answers, *flat = along(student, states, directions.flatten(0, 1))
        answers, derivatives = answers[::count], [d.unflatten(0, (-1, count)) for d in flat]
    action_error = answers - batch.actions
    errors = [found - values[:, :, order] for order, found in enumerate(derivatives)]
    return _Errors(action_error, action_error, errors[0], errors[-1])


def _jacobian(student: Network, states: Tensor) -> tuple[Tensor, Tensor]:
    """Return f(x), (B, m), and its Jacobian, (m, B, n), differentiable."""
    states = states.detach().requires_grad_()
    answers = student(states)
    each = torch.eye(answers.shape[1], device=states.device)[:, None].expand(-1, *answers.shape)
    (jacobian,) = torch.autograd.grad(
        answers, states, each, create_graph=True, is_grads_batched=True
    )
    return answers, jacobian


def _derivative_along(
    student: Network, states: Tensor, directions: Tensor
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


def _second_derivative_along(
    student: Network, states: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return f(x), J u and u'H u, each (B, m), differentiable."""

    def both(x: Tensor) -> tuple[Tensor, Tensor]:
        answers, slopes, *_ = torch.func.jvp(student, (x,), (directions,))
        return answers, slopes

    (answers, slopes), (_, curvatures), *_ = torch.func.jvp(both, (states,), (directions,))
    return answers, slopes, curvatures


def _mean_norm(errors: Tensor, units: Tensor | None) -> Tensor:
    """Return the mean over (B, ..., m) errors of a state's norm, in units (m,)."""
    errors = errors if units is None else errors / units
    return torch.linalg.vector_norm(errors.flatten(1), dim=-1).mean()
