"""Experts with a memory: what they carry from step to step are further columns of an observation.

What is carried depends on what was observed, not on who acts. So an expert with a memory is one
without, of longer observations, in an environment that says what it would remember.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fdtasil.errors import ExpertError, first_line
from fdtasil.rollouts.behaviours import Policy, largest_action

__all__ = [
    "Memory",
    "OnColumns",
    "Step",
    "beginning_problem",
    "begins_elsewhere",
    "other_beginning",
    "stateless",
]

Step = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(B, n) observations and (B, k) memories -> (B, m) actions, and the memories after them."""


@dataclass(frozen=True)
class Memory:
    """What an expert carries along an episode, from zeros at its start.

    Attributes:
        size: k, how many numbers.
        step: What it does with them.
        begin: (B, n) -> (B, m) its first answers of episodes, where it has a beginning of its own.
    """

    size: int
    step: Step
    begin: Policy | None = None

    def after(self, observation: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Return the memory (k,) after one observation (n,)."""
        _, memories = self.step(observation[None].astype(np.float32), memory[None])
        return memories[0]


def begins_elsewhere(memory: Memory, observations: np.ndarray) -> bool:
    """Whether first answers at (B, n) observations are others than those to a memory of zeros."""
    if memory.begin is None:
        return False
    nothing = np.zeros((len(observations), memory.size), np.float32)
    # A copy: who answers may write its next answer into the array of the last.
    zeros = _rows(np.array(memory.step(observations.copy(), nothing)[0]))
    begun = _rows(memory.begin(observations.copy()))
    least = 1e-4 * largest_action(np.concatenate([zeros, begun]))
    return not np.allclose(begun, zeros, rtol=1e-3, atol=least, equal_nan=True)


def _rows(answers: np.ndarray) -> np.ndarray:
    """Return (B, m) answers; one choice a row may come as (B,)."""
    return np.reshape(answers, (len(answers), -1))


def beginning_problem(memory: Memory, observations: np.ndarray, name: str) -> ExpertError | None:
    """Return what is wrong with a memory's beginning, or None.

    Args:
        memory: Of the expert.
        observations: (B, n) where episodes begin. A law that is at a bound shows nothing there.
        name: Of the expert.
    """
    try:
        elsewhere = begins_elsewhere(memory, observations)
    except Exception as error:
        problem = ExpertError(
            f"{name} raised {type(error).__name__} where episodes begin: {first_line(error)}",
            "actions and a state",
            "mend it, or let it answer NaN where it can't",
        )
        problem.__cause__ = error
        return problem
    return other_beginning(name) if elsewhere else None


def other_beginning(name: str) -> ExpertError:
    """Return what is said of an expert whose memory does not begin with zeros."""
    return ExpertError(
        f"{name} begins an episode with another memory than zeros",
        "a memory of zeros at the start",
        "wrap it: let its state be the difference to the first one, or hold a flag that is 0 "
        "until the first step",
    )


def stateless(step: Step, observation_size: int) -> Policy:
    """Return the expert as a function of observations with the memory behind them."""
    return _Stateless(step, observation_size)


@dataclass(frozen=True)
class _Stateless:
    step: Step
    observation_size: int

    def __call__(self, rows: np.ndarray) -> Any:
        n = self.observation_size
        return self.step(rows[:, :n], rows[:, n:])[0]


class OnColumns(torch.nn.Module):
    """A module that is given some columns of an observation.

    Args:
        module: The module.
        columns: Which.
    """

    def __init__(self, module: torch.nn.Module, columns: Sequence[int]) -> None:
        super().__init__()
        self.module, self.columns = module, list(columns)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """(B, n) -> (B, m)."""
        return self.module(rows[:, self.columns])
