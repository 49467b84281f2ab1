"""Minibatch optimisation of a student; knows no environment and no expert."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, count, islice

import numpy as np
import torch
from torch import Tensor

from fdtasil.batches import Batches
from fdtasil.demonstrations import Answers, Demonstrations
from fdtasil.errors import FitError, SettingError
from fdtasil.loss import taylor_loss
from fdtasil.probes import Probes
from fdtasil.student import Student

__all__ = ["Fit", "Progress", "fit"]

_LOG_EVERY = 100  # steps between two entries of the history; reading a loss waits for the device


@dataclass(frozen=True)
class Fit:
    """How a student is optimised.

    Attributes:
        steps: Gradient steps, or None to count epochs.
        epochs: Visits of each state, or None to count steps; one of the two is set.
        batch_size: States in a minibatch; fewer where there are fewer states.
        learning_rate: Peak rate of AdamW, with cosine decay to zero.
        weight_decay: Decoupled weight decay.
        epsilon: AdamW's epsilon.
        weight: lambda_1, the weight of the derivative error.
    """

    steps: int | None
    epochs: int | None
    batch_size: int
    learning_rate: float
    weight_decay: float
    epsilon: float
    weight: float

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.epochs is None):
            raise SettingError(
                f"steps={self.steps}, epochs={self.epochs}", "one of the two", "leave one out"
            )
        for name in ("steps", "epochs", "batch_size"):
            value = getattr(self, name)
            if value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise SettingError(f"{name}={value!r}", "a positive integer", "raise it")
        for name in ("learning_rate", "weight_decay", "epsilon", "weight"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise SettingError(
                    f"{name}={getattr(self, name)!r}", "a number of at least 0", "raise it"
                )

    def steps_an_epoch(self, states: int) -> int:
        """Return the minibatches that visit each of `states` states once."""
        return max(1, states // self.batch_size)

    def total_steps(self, states: int) -> int:
        """Return the gradient steps of a training on `states` states."""
        if self.steps is not None:
            return self.steps
        return (self.epochs or 0) * self.steps_an_epoch(states)

    def visits(self, states: int) -> int:
        """Return how often each state is visited, the last incomplete epoch counted whole."""
        return -(-self.total_steps(states) // self.steps_an_epoch(states))


Progress = Callable[[int], None]
"""Told the number of gradient steps just done."""


def fit(
    student: Student,
    demonstrations: Demonstrations,
    probes: Probes | None,
    answers: Callable[[int], Answers] | None,
    settings: Fit,
    random: torch.Generator,
    on_steps: Progress = lambda count: None,
) -> list[dict[str, float]]:
    """Optimise a student in place.

    Every epoch visits each state once, and a visit uses the next one (`probes.per_step`) of the
    state's stored probes: the cost of a step does not grow with their number.

    Args:
        student: Changed in place.
        demonstrations: N labelled states.
        probes: The derivative source; None for plain behaviour cloning.
        answers: Number of the pool -> the expert's answers; asked for pool 0, and for the next
            one when the answers are used up, if the source resamples. None without probes.
        settings: How.
        random: Draws the minibatches.
        on_steps: Told of progress.

    Returns:
        One entry for each 100 steps: step, loss, action_error, derivative_error (means since the
        last entry).

    Raises:
        FitError: If the loss is not finite; the student is of no use then.
    """
    batches = Batches(demonstrations, probes, answers, random, student.mean.device)
    steps = settings.total_steps(len(demonstrations))
    optimiser = torch.optim.AdamW(
        student.parameters(),
        lr=settings.learning_rate,
        weight_decay=settings.weight_decay,
        eps=settings.epsilon,
        fused=True,
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    per_epoch = settings.steps_an_epoch(len(demonstrations))
    stencil = probes.stencil if probes else None
    history: list[dict[str, float]] = []
    recent: list[Tensor] = []
    student.train()
    epochs = (batches.epoch(number, per_epoch) for number in count())
    for step, batch in enumerate(islice(chain.from_iterable(epochs), steps)):
        loss = taylor_loss(student, batch, stencil, settings.weight, batches.gain)
        optimiser.zero_grad(set_to_none=True)
        loss.total.backward()
        optimiser.step()
        schedule.step()
        recent.append(torch.stack([loss.total, loss.action, loss.derivative]).detach())
        if (step + 1) % _LOG_EVERY == 0 or step + 1 == steps:
            history.append(_entry(step + 1, recent))
            on_steps(len(recent))
            recent = []
    student.eval()
    return history


def _entry(step: int, recent: list[Tensor]) -> dict[str, float]:
    total, action, derivative = torch.stack(recent).mean(dim=0).tolist()
    if not np.isfinite(total):
        raise FitError(
            f"the loss became {total} near step {step}",
            "finite numbers",
            "lower learning_rate, or check the expert's answers for outliers",
        )
    return {"step": step, "loss": total, "action_error": action, "derivative_error": derivative}
