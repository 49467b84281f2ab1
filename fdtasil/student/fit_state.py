"""Where a training stands: what it needs to go on with the same bytes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fdtasil.errors import FitError
from fdtasil.files.border import reads
from fdtasil.files.plain import from_plain
from fdtasil.files.tensors import tensors_from_bytes, tensors_to_bytes
from fdtasil.student.loss import TaylorLoss

__all__ = ["FitState", "check_history"]

_ENTRY = "fit"


class FitState:
    """Weights, optimiser, history and best weights of a training.

    Args:
        student: The student in training.
        optimiser: Its AdamW.

    Attributes:
        step: Gradient steps done.
        history: Entries so far.
        stale: Validations since the best one.
    """

    def __init__(self, student: nn.Module, optimiser: torch.optim.Optimizer) -> None:
        self._student, self._optimiser = student, optimiser
        self.step = 0
        self.history: list[dict[str, float]] = []
        self.stale = 0
        self._recent: list[Tensor] = []
        self._best_loss = math.inf
        self._best: dict[str, Tensor] = {}

    def count(self, losses: Tensor) -> None:
        """Count one step, with the numbers of its `TaylorLoss`."""
        self.step += 1
        self._recent.append(losses)

    def check_finite(self, held_out: float | None = None) -> None:
        """Refuse to go on from, or to keep, what is not finite: it never becomes so again.

        Args:
            held_out: The held-out loss, where there is one.

        Raises:
            FitError: Naming the first step with such a loss, if the losses show it.
        """
        # Read in one piece: each reading waits for the device.
        recent = torch.stack(self._recent).tolist() if self._recent else []
        bad = [not all(map(math.isfinite, losses)) for losses in recent]
        if any(bad):
            first = bad.index(True)
            step = self.step - len(bad) + first + 1
            found = f"the loss became {recent[first][0]} at step {step}"
        elif not self._finite_weights():
            found = f"the student's weights are not finite after step {self.step}"
        elif held_out is not None and not math.isfinite(held_out):
            found = f"the loss of the held-out episodes became {held_out} at step {self.step}"
        else:
            return
        raise FitError(
            found,
            "finite numbers",
            "begin another run with a lower learning_rate, or check the expert's answers for "
            "outliers",
        )

    def _finite_weights(self) -> bool:
        parts = [torch.isfinite(weights).all() for weights in self._student.parameters()]
        return bool(torch.stack(parts).all())

    def log(self, held_out: float | None) -> dict[str, float]:
        """Make an entry of the steps since the last one, and keep the weights if they are best.

        Raises:
            FitError: If losses or weights are not finite.
        """
        self.check_finite(held_out)
        means = torch.stack(self._recent).mean(dim=0).tolist()
        self._recent = []
        entry: dict[str, float] = {
            "step": self.step,
            **dict(zip(TaylorLoss._fields, means, strict=True)),
        }
        if held_out is not None:
            entry["validation_loss"] = held_out
            self.stale += 1
            if held_out < self._best_loss:
                self.stale, self._best_loss = 0, held_out
                self._best = {k: v.clone() for k, v in self._student.state_dict().items()}
        self.history.append(entry)
        return entry

    def keep_best(self) -> None:
        """Put the best validated weights back, if there are any."""
        if self._best:
            self._student.load_state_dict(self._best)

    def to_bytes(self) -> bytes:
        """Return the state as a safetensors file.

        Raises:
            FitError: If losses or weights are not finite: an earlier file is worth more.
        """
        self.check_finite()
        groups = {
            "student": self._student.state_dict(),
            "best": self._best,
            "recent": {"losses": torch.stack(self._recent)} if self._recent else {},
        }
        for number, moments in self._optimiser.state_dict()["state"].items():
            groups[f"optimiser.{number}"] = moments
        tensors = {
            f"{group}/{name}": tensor.detach().clone()
            for group, members in groups.items()
            for name, tensor in members.items()
        }
        numbers = {
            "step": self.step,
            "stale": self.stale,
            "best_loss": None if math.isinf(self._best_loss) else self._best_loss,
            "history": self.history,
        }
        return tensors_to_bytes(tensors, numbers, _ENTRY)

    @reads(
        "the state of this training",
        "a checkpoint of the same run",
        "start the run anew in another folder",
    )
    def restore(self, data: bytes) -> None:
        """Take over the state that `to_bytes` wrote.

        Raises:
            StorageError: If it is not such a state, or of another student.
        """
        tensors, numbers = tensors_from_bytes(data, _ENTRY, "the state of a training")
        whole = from_plain(_Numbers, numbers)
        check_history(list(whole.history))
        self._student.load_state_dict(_group(tensors, "student"))
        self._load_moments(tensors)
        self.step, self.stale, self.history = whole.step, whole.stale, list(whole.history)
        self._best_loss = math.inf if whole.best_loss is None else whole.best_loss
        device, shapes = next(self._student.parameters()).device, self._student.state_dict()
        best = _group(tensors, "best")
        if best and {k: v.shape for k, v in best.items()} != {
            k: v.shape for k, v in shapes.items()
        }:
            raise ValueError("best weights of another student")
        self._best = {k: v.to(device) for k, v in best.items()}
        recent = _group(tensors, "recent").get("losses")
        if recent is not None and (recent.ndim, recent.shape[-1]) != (2, len(TaylorLoss._fields)):
            raise ValueError(f"losses of shape {tuple(recent.shape)}")
        self._recent = [] if recent is None else list(recent.to(device))

    def _load_moments(self, tensors: dict[str, Tensor]) -> None:
        whole = self._optimiser.state_dict()
        numbers = whole["param_groups"][0]["params"]
        weights = list(self._student.parameters())
        whole["state"] = {number: _group(tensors, f"optimiser.{number}") for number in numbers}
        for number, moments in whole["state"].items():  # a fused step would read beyond others
            shapes = {name: moment.shape for name, moment in moments.items()}
            like = weights[number].shape
            if shapes != {"step": torch.Size(), "exp_avg": like, "exp_avg_sq": like}:
                raise ValueError(f"moments of shapes {shapes}")
        self._optimiser.load_state_dict(whole)


@dataclass(frozen=True)
class _Numbers:
    """What a state says beside its tensors; see `FitState`."""

    step: int
    stale: int
    best_loss: float | None
    history: tuple[dict, ...]


def check_history(history: object) -> None:
    """Refuse what is no list of entries of numbers by name.

    Raises:
        TypeError: If it is none.
    """
    entries = history if isinstance(history, list) else [None]
    for entry in entries:
        numbers = entry.values() if isinstance(entry, dict) else [None]
        if not all(type(number) in (int, float) for number in numbers):
            raise TypeError("a history that is none")


def _group(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {
        key.removeprefix(f"{name}/"): tensor
        for key, tensor in tensors.items()
        if key.startswith(f"{name}/")
    }
