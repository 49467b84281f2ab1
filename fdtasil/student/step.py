"""One gradient step; on a GPU its kernels are recorded once and launched together."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fdtasil.student.loss import Minibatch, ProbeBatch, TaylorLoss

__all__ = ["Step", "copy_of", "gradient_step", "tensors_of"]

Step = Callable[[Minibatch, float], Tensor]
"""Takes a step on a minibatch at a learning rate, and returns its `TaylorLoss` as one tensor."""

# Steps before the first recording, on its stream: AdamW's moments and cuBLAS's workspace must be
# there, for what is made while recording belongs to that one recording.
_EAGER = 3


def gradient_step(
    student: nn.Module,
    optimiser: torch.optim.Optimizer,
    loss_of: Callable[[Minibatch], TaylorLoss],
    max_gradient_norm: float | None,
    device: torch.device,
) -> Step:
    """Return how the weights are changed once.

    Args:
        student: Whose weights are changed.
        optimiser: Of these weights, "capturable" on a GPU.
        loss_of: What is minimised, and its parts.
        max_gradient_norm: Longer gradients are scaled to this norm; None leaves them.
        device: Where student and minibatches are.
    """

    def step(batch: Minibatch, rate: float | Tensor) -> Tensor:
        optimiser.param_groups[0]["lr"] = rate
        losses = torch.stack(loss_of(batch))
        optimiser.zero_grad(set_to_none=True)
        losses[0].backward()
        if max_gradient_norm is not None:
            torch.nn.utils.clip_grad_norm_(student.parameters(), max_gradient_norm)
        optimiser.step()
        return losses.detach()

    return _Replayed(step, device) if device.type == "cuda" else step


@dataclass(frozen=True)
class _Recording:
    """The kernels of a step, and the tensors that they read and write."""

    graph: torch.cuda.CUDAGraph
    batch: Minibatch
    losses: Tensor


class _Replayed:
    """A step whose kernels are recorded, as a CUDA graph, for each shape of a minibatch.

    The kernels of a small network take less time than launching them one by one.

    Args:
        step: The step to record; its rate is a tensor () on the device.
        device: Where it runs.
    """

    def __init__(self, step: Callable[[Minibatch, Tensor], Tensor], device: torch.device) -> None:
        self._step, self._rate = step, torch.zeros((), device=device)
        self._stream = torch.cuda.Stream(device)
        self._eager = _EAGER
        self._recordings: dict[object, _Recording] = {}

    def __call__(self, batch: Minibatch, rate: float) -> Tensor:
        self._rate.fill_(rate)
        if self._eager:
            self._eager -= 1
            return self._aside(batch)
        key = tuple(tensor.shape for tensor in tensors_of(batch))
        if key not in self._recordings:
            self._recordings[key] = self._record(batch)
        recording = self._recordings[key]
        for theirs, tensor in zip(tensors_of(recording.batch), tensors_of(batch), strict=True):
            theirs.copy_(tensor)
        recording.graph.replay()
        return recording.losses.clone()

    def _aside(self, batch: Minibatch) -> Tensor:
        """Take the step on the recordings' stream: gradients belong to the one they began on."""
        usual = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(usual)
        with torch.cuda.stream(self._stream):
            losses = self._step(batch, self._rate)
        usual.wait_stream(self._stream)
        return losses

    def _record(self, batch: Minibatch) -> _Recording:
        inputs, graph = copy_of(batch), torch.cuda.CUDAGraph()
        # What other threads of the caller do with the GPU meanwhile is none of the recording's.
        with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
            losses = self._step(inputs, self._rate)
        return _Recording(graph, inputs, losses)


def tensors_of(batch: Minibatch) -> tuple[Tensor, ...]:
    """Return all tensors of a minibatch, in an order that its kind alone decides."""
    probes = batch.probes
    around = () if probes is None else (probes.displacements, probes.values, probes.gains)
    return batch.observations, batch.actions, *around


def copy_of(batch: Minibatch) -> Minibatch:
    """Return a minibatch with tensors of its own."""
    probes = batch.probes
    if probes is not None:
        copies = (probes.displacements, probes.values, probes.gains)
        probes = ProbeBatch(*(tensor.clone() for tensor in copies))
    return Minibatch(batch.observations.clone(), batch.actions.clone(), probes)
