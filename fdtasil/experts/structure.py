"""Experts in environments of any spaces: they are given what the environment gives, in a batch."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.compute import ask_module
from fdtasil.errors import ExpertError
from fdtasil.experts.expert import Expert
from fdtasil.rollouts.spaces import Layout, Mismatch, Part, Spaces

__all__ = ["in_spaces"]


def in_spaces(expert: Expert, spaces: Spaces | None) -> Expert:
    """Return an expert that is asked about flat observations, and answers with flat actions.

    Functions, objects with `predict` and torch modules are given the environment's own form:
    dictionaries, tuples or stacks of arrays whose first axis is the batch's. Others take flat
    observations. Of a choice, the scores are its actions, centred: a number added to all scores
    changes no choice, and so is nothing to be learnt. Who answers with the choices alone has ones
    and zeros for scores.

    Args:
        expert: The expert.
        spaces: Of the environment; None, or plain boxes, leave the expert as it is.

    Raises:
        ExpertError: If it has workers, and takes what they are not sent.
    """
    if spaces is None or spaces.plain or expert.spaces is not None:
        return expert
    structured = expert.own_form and not spaces.observations.plain
    if structured and expert.workers is not None:
        raise ExpertError(
            f"{expert.name} with workers, in an environment of more than one array",
            "a function of flat observations (B, n), whose layout is that of the environment",
            "wrap the environment in FlattenObservation, or leave workers= out",
        )
    module = expert.module
    if module is not None and not _answers_in_numbers(module, spaces, structured=structured):
        ask = partial(ask_module, module.eval()) if expert.own_form else expert.answer
        expert, module = replace(expert, answer=ask, module=None), None
    if module is not None:
        module = _Shaped(module, spaces.observations if structured else None, spaces.actions)
    if structured and module is not None:
        answer: Callable[[np.ndarray], np.ndarray] = partial(ask_module, module.eval())
    elif expert.workers is not None:
        return _with_scores(expert, spaces, module)
    else:
        seen = spaces.observations if structured else None
        answer = _InSpaces(expert.answer, expert.name, seen, spaces.actions)
    jacobian = None if structured or spaces.actions.choices else expert.jacobian
    return replace(expert, answer=answer, module=module, jacobian=jacobian, spaces=spaces)


def _answers_in_numbers(module: nn.Module, spaces: Spaces, *, structured: bool) -> bool:
    """Whether a module returns (B, m) floats: scores, not choices, and no dictionary of them."""
    rows = torch.zeros((2, spaces.observations.size))
    like = next(module.parameters(), rows)
    rows = rows.to(like.device, like.dtype)
    try:
        with torch.no_grad():
            found = module(_tensors(spaces.observations, rows) if structured else rows)
    except Exception:  # of the user's; the gate will show it
        return True
    if not isinstance(found, Tensor):
        return False
    return found.is_floating_point() and found.flatten(1).shape == (2, spaces.actions.size)


def _with_scores(expert: Expert, spaces: Spaces, module: nn.Module | None) -> Expert:
    if spaces.actions.choices:
        raise ExpertError(
            f"{expert.name} with workers, in an environment of choices",
            "a function that is asked in this process, or one of continuous actions",
            "leave workers= out",
        )
    return replace(expert, module=module, spaces=spaces)


@dataclass(frozen=True)
class _InSpaces:
    """Asks a policy in the environment's own form.

    Attributes:
        ask: The policy.
        name: What to call it.
        seen: Of the observations; None where it takes them flat.
        actions: Of its answers.
    """

    ask: Callable[[Any], Any]
    name: str
    seen: Layout | None
    actions: Layout

    def __call__(self, rows: np.ndarray) -> Any:
        answer = self.ask(rows if self.seen is None else self.seen.values(rows))
        if self.actions.plain:
            return answer
        nested = self.actions.parts[0].path
        if (
            isinstance(answer, tuple)
            and len(answer) == 2
            and answer[1] is None
            and not (nested and isinstance(nested[0], int))
        ):
            answer = answer[0]  # stable-baselines3's predict
        flat = not nested or not isinstance(answer, dict | tuple | list)
        try:
            if flat and nested:
                found = _whole(answer, self.actions, len(rows))
            else:
                found = self.actions.rows(answer)
        except Mismatch as mismatch:
            raise ExpertError(
                f"{self.name} answered {len(rows)} observations with actions of {mismatch}",
                _promise(self.actions, len(rows)),
                "return one action for each observation, or the scores of each choice",
            ) from None
        return self.actions.centred(found)


def _whole(answer: Any, actions: Layout, rows: int) -> np.ndarray:
    """Return actions of several parts that are given as (B, m) numbers."""
    found = np.asarray(answer, np.float64)
    if found.shape != (rows, actions.size):
        raise Mismatch(f"the shape {found.shape}")
    return found


def _promise(actions: Layout, rows: int) -> str:
    if len(actions.parts) == 1 and actions.parts[0].kind == "choice":
        shape = (rows, *actions.parts[0].shape)
        return f"{shape} choices, or ({rows}, {actions.size}) scores of them"
    return f"({rows}, {actions.size}) finite numbers"


class _Shaped(nn.Module):
    """A module between flat observations and flat actions.

    Args:
        module: The module.
        seen: Of what it takes; None for flat observations.
        actions: Of what it returns, whose scores are centred.
    """

    def __init__(self, module: nn.Module, seen: Layout | None, actions: Layout) -> None:
        super().__init__()
        self.module, self._seen, self._actions = module, seen, actions

    def forward(self, rows: Tensor) -> Tensor:
        """(B, n) -> (B, m)."""
        answer = self.module(rows if self._seen is None else _tensors(self._seen, rows))
        answer = answer.flatten(1)
        if not self._actions.choices:
            return answer
        parts = [answer[:, a:b] for a, b in self._actions.choices]
        if len(parts) > 1 or parts[0].shape != answer.shape:  # numbers beside choices
            means = torch.zeros_like(answer)
            for (a, b), part in zip(self._actions.choices, parts, strict=True):
                means[:, a:b] = part.mean(dim=1, keepdim=True)
            return answer - means
        return answer - answer.mean(dim=1, keepdim=True)


def _tensors(layout: Layout, rows: Tensor) -> Any:
    """Return (B, n) in the environment's own form, as tensors."""
    pairs = [
        (part.path, _tensor(part, rows[:, start : start + part.size]))
        for part, start in zip(layout.parts, layout.starts, strict=True)
    ]
    return layout.joined(pairs)


def _tensor(part: Part, rows: Tensor) -> Tensor:
    if part.kind != "choice":
        return rows.reshape(len(rows), *part.shape)
    found, start = [], 0
    for size, first in zip(part.sizes, part.first, strict=True):
        found.append(first + rows[:, start : start + size].argmax(dim=1))
        start += size
    return torch.stack(found, dim=1).reshape(len(rows), *part.shape)
