"""Minibatch optimisation of a student; knows no environment and no expert."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fdtasil.checks import check_count, check_number, check_share
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError
from fdtasil.probes.answers import Answers
from fdtasil.probes.source import Match, Probes
from fdtasil.student.batches import Batches
from fdtasil.student.fit_state import FitState
from fdtasil.student.loss import Minibatch, TaylorLoss, Weights, taylor_loss
from fdtasil.student.policy import Student
from fdtasil.student.schedule import ANEW, LOG_EVERY, USUAL, Schedule
from fdtasil.student.step import gradient_step

__all__ = ["Fit", "Hooks", "fit", "hold_out"]


_NUMBERS = ("weight_decay", "epsilon", "weight", "curvature_weight", "moved_weight")


@dataclass(frozen=True)
class Fit:
    """How a student is optimised: length, AdamW, the terms of the Taylor loss, validation.

    Attributes:
        steps: Gradient steps of a round. Left out, 4,000 where answers are stored, and 12,000
            where the expert is asked anew. Above 1,500 states, or 5,000 where it is asked anew,
            they grow with the square root of the number of states.
        epochs: Visits of each state in a round, instead of steps.
        batch_size: States in a minibatch at most; an epoch's are of almost equal size.
        learning_rate: Peak learning rate of AdamW, with cosine decay to zero. Left out, 0.001, or
            0.004 where the expert is asked anew.
        weight_decay: Decoupled weight decay.
        epsilon: AdamW's epsilon.
        order: Of the Taylor loss: 1, or 2 to match second differences too (central stencil, or
            "jacobian"). Without probes it is 0.
        weight: lambda_1, the weight of the derivative error. 0.5 holds the student to the
            expert's reaction to deviations of about half a standard deviation.
        curvature_weight: lambda_2, the weight of the error of the second differences, with order
            2.
        moved_weight: Of the action error at the moved states, where a source matches labels.
        max_gradient_norm: Scale longer gradients to this norm; left out, they stay.
        validation: Share of the episodes held out, by which the best weights are chosen; 0 keeps
            the last weights. A round with a single episode holds none out.
        patience: Validations (one each 100 steps) without a better one after which to stop; left
            out, training goes on to the end.

    Raises:
        SettingError: If a value can't be used, or two of them don't go together.

    Example:
        >>> Fit(epochs=10).schedule().total_steps(states=1500)
        150
    """

    steps: int | None = None
    epochs: int | None = None
    batch_size: int = 100
    learning_rate: float | None = None
    weight_decay: float = 0.01
    epsilon: float = 1e-8
    order: int = 1
    weight: float = 0.5
    curvature_weight: float = 0.125
    moved_weight: float = 1.0
    max_gradient_norm: float | None = None
    validation: float = 0.0
    patience: int | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "epochs", "batch_size", "patience"):
            self._check(name, check_count)
        self._check("order", partial(check_count, most=2))
        for name in _NUMBERS:
            usual = Fit.__dataclass_fields__[name].default
            self._check(name, partial(check_number, example=usual))
        rate = partial(check_number, positive=True, example=USUAL.learning_rate)
        self._check("learning_rate", rate)
        self._check("max_gradient_norm", partial(check_number, positive=True))
        self._check("validation", partial(check_share, whole=False))
        if self.steps is not None and self.epochs is not None:
            found = f"steps={self.steps}, epochs={self.epochs}"
            raise SettingError(found, "one of the two", "leave one out")
        if self.patience is not None and self.validation == 0:
            raise SettingError(
                f"patience={self.patience} without validation",
                "held-out episodes to judge by",
                "write for example validation=0.2",
            )

    def _check(self, name: str, check: Callable[[str, object], float]) -> None:
        """Refuse a field that can't be used, and keep the others as plain numbers of Python."""
        value = getattr(self, name)
        if value is not None or Fit.__dataclass_fields__[name].default is not None:
            object.__setattr__(self, name, check(name, value))

    def to_json(self, *, anew: bool = False) -> dict[str, Any]:
        """Return the fields as plain JSON values, and the rule for a length that is left out."""
        whole = self.schedule(anew=anew)
        steps = None if self.epochs else whole.steps
        rule = {"steps": steps, "steps_for": whole.enough, "learning_rate": whole.learning_rate}
        return {**asdict(self), **rule}

    @classmethod
    def from_json(cls, written: Mapping[str, Any], *, anew: bool = False) -> "Fit":
        """Read what `to_json` returned; a usual length and a usual rate are left out again."""
        known = {name: written[name] for name in cls.__dataclass_fields__ if name in written}
        if written.get("steps_for") is not None:
            known["steps"] = None
        if known["learning_rate"] == (ANEW if anew else USUAL).learning_rate:
            known["learning_rate"] = None
        return cls(**known)

    def schedule(self, *, anew: bool = False) -> Schedule:
        """Return the schedule, with what is left out filled in.

        Args:
            anew: Whether the expert is asked anew on the way.
        """
        usual = ANEW if anew else USUAL
        return Schedule(
            usual.steps if self.steps is None else self.steps,
            self.epochs,
            usual.enough if self.steps is None and self.epochs is None else None,
            self.batch_size,
            usual.learning_rate if self.learning_rate is None else self.learning_rate,
        )

    def weights(self, match: Match | None) -> Weights:
        """Return the weights of a loss that holds a student to answers in that way."""
        labels, differences = match in ("labels", "both"), match != "labels"
        return Weights(
            self.weight if differences else None,
            self.curvature_weight if differences and self.order == 2 else None,
            self.moved_weight if labels else None,
        )

    def held_out(self, episodes: int) -> int:
        """Return how many of `episodes` episodes are held out."""
        if self.validation == 0:
            return 0
        return min(max(1, round(self.validation * episodes)), episodes - 1)


@dataclass(frozen=True)
class Hooks:
    """Who is told of a training's progress.

    Attributes:
        begin: Told the number of steps before the first one.
        entry: Told each new entry of the history.
        checkpoint: Told the state at the end of each epoch; must not keep it.
    """

    begin: Callable[[int], None] = field(default=lambda steps: None)
    entry: Callable[[dict[str, float]], None] = field(default=lambda entry: None)
    checkpoint: Callable[[FitState], None] = field(default=lambda state: None)


def fit(
    student: Student,
    demonstrations: Demonstrations,
    probes: Probes | None,
    answers: Callable[[int], Answers] | None,
    settings: Fit,
    random: Callable[[str], torch.Generator],
    *,
    hooks: Hooks | None = None,
    resume: bytes | None = None,
) -> list[dict[str, float]]:
    """Optimise a student in place.

    Every epoch visits each state once, and a visit uses the next one (`probes.per_step`) of the
    state's stored probes: the cost of a step does not grow with their number.

    Args:
        student: Changed in place.
        demonstrations: N labelled states.
        probes: The derivative source; None for plain behaviour cloning.
        answers: Number of the sample -> the expert's answers; asked for sample 0, and for the
            next one when the answers are used up, if the source resamples. None without probes.
        settings: How; the order is that of the answers.
        random: Name of a stream -> its generator.
        hooks: Who is told of progress.
        resume: The bytes of a state given to `hooks.checkpoint` by an earlier call with the same
            arguments; the result is the same as without the interruption, to the byte.

    Returns:
        One entry for each 100 steps: step, loss, action_error, derivative_error,
        curvature_error, moved_error (means since the last entry), and validation_loss where
        states are held out.

    Raises:
        FitError: If a loss or a weight is not finite; the student is of no use then.
    """
    told = hooks or Hooks()
    device = student.mean.device
    batches = Batches(demonstrations, probes, answers, random, device)
    training, held_out = hold_out(demonstrations, settings, random("held out"))
    schedule = settings.schedule(anew=probes is not None and probes.resample)
    per_epoch = schedule.steps_an_epoch(len(training))
    steps, rate = schedule.total_steps(len(training)), schedule.learning_rate
    told.begin(steps)
    optimiser = torch.optim.AdamW(
        student.parameters(),
        lr=rate,
        weight_decay=settings.weight_decay,
        eps=settings.epsilon,
        fused=True,
        capturable=device.type == "cuda",
    )
    weights = settings.weights(probes.match if probes else None)
    stencil = probes.stencil if probes else None
    # Taken once, of the first sample: two validations then differ by the student alone.
    parts = held_out.to(device).split(schedule.batch_size)
    judges = [batches.visit(part, 0) for part in parts if len(part)]
    state = FitState(student, optimiser)
    if resume is not None:
        state.restore(resume)

    # Bounds of +-1, the usual ones, cost nothing.
    units = student.action_units if bool((student.action_units != 1).any()) else None

    def loss_of(batch: Minibatch) -> TaylorLoss:
        return taylor_loss(student.uncut, batch, stencil, weights, units)

    step = gradient_step(student, optimiser, loss_of, settings.max_gradient_norm, device)
    first_epoch = state.step // per_epoch
    dealt = _deal(batches, training, per_epoch, first_epoch)
    student.train()
    for batch in islice(dealt, max(0, steps - state.step)):
        if state.step % per_epoch == 0 and state.step > 0:
            told.checkpoint(state)
        state.count(step(batch, _cosine(rate, state.step, steps)))
        if state.step % LOG_EVERY == 0 or state.step == steps:
            held = _held_out_loss(loss_of, judges)
            told.entry(state.log(held))
            if settings.patience is not None and state.stale >= settings.patience:
                break
    state.keep_best()
    student.eval()
    return state.history


def _deal(batches: Batches, rows: Tensor, per_epoch: int, first_epoch: int) -> Iterator[Minibatch]:
    for number in count(first_epoch):
        yield from batches.epoch(number, rows, per_epoch)


def _held_out_loss(
    loss_of: Callable[[Minibatch], TaylorLoss], judges: Sequence[Minibatch]
) -> float | None:
    """Return the mean loss of all held-out rows, or None where there are none."""
    if not judges:
        return None
    rows = [len(batch.actions) for batch in judges]
    losses = [float(loss_of(batch).loss.detach()) for batch in judges]
    return sum(n * loss for n, loss in zip(rows, losses, strict=True)) / sum(rows)


def hold_out(
    demonstrations: Demonstrations, settings: Fit, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return the rows to train on and those of held-out episodes."""
    everything = torch.arange(len(demonstrations))
    episodes = np.unique(demonstrations.episode)
    held = settings.held_out(len(episodes))
    chosen = episodes[torch.randperm(len(episodes), generator=random)[:held].numpy()]
    outside = torch.from_numpy(np.isin(demonstrations.episode, chosen))
    return everything[~outside], everything[outside]


def _cosine(peak: float, step: int, steps: int) -> float:
    return peak * 0.5 * (1 + math.cos(math.pi * step / steps))
