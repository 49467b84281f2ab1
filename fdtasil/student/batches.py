"""The minibatches of a training: which states, and which of their probes."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from fdtasil.demonstrations.states import Demonstrations
from fdtasil.probes.answers import Answers
from fdtasil.probes.source import Probes
from fdtasil.student.loss import Minibatch, ProbeBatch

__all__ = ["Batches"]


class Batches:
    """Training data on the device, dealt out so that every epoch visits each state once.

    Args:
        demonstrations: N labelled states.
        probes: The derivative source; None for plain behaviour cloning.
        answers: Number of the sample -> the expert's answers; None without probes.
        random: Name of a stream -> its generator; an epoch's order depends on its number only.
        device: Where the data and the minibatches are.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        probes: Probes | None,
        answers: Callable[[int], Answers] | None,
        random: Callable[[str], torch.Generator],
        device: torch.device,
    ) -> None:
        self._observations = _floats(demonstrations.observations).to(device)
        self._actions = _floats(demonstrations.actions).to(device)
        self._random, self._device = random, device
        self._dealer: _Dealer | None = None
        if probes is not None and answers is not None:
            self._dealer = _Dealer(probes, answers, len(demonstrations), random("offset"), device)

    def epoch(self, number: int, rows: Tensor, batches: int) -> Iterator[Minibatch]:
        """Deal out each of `rows` once, in `batches` minibatches of (almost) equal size."""
        order = torch.randperm(len(rows), generator=self._random(f"epoch {number}"))
        if self._dealer is not None:
            self._dealer.load(number)
        for part in rows[order].to(self._device, non_blocking=True).tensor_split(batches):
            yield self.visit(part, number)

    def visit(self, rows: Tensor, number: int) -> Minibatch:
        """Return the minibatch of some states, given on the device, at their visit `number`."""
        seen, said = self._observations[rows], self._actions[rows]
        return Minibatch(seen, said, self._dealer and self._dealer.deal(rows, number))


class _Dealer:
    """The expert's answers around each state; a visit of the state uses the next of them."""

    def __init__(
        self,
        probes: Probes,
        answers: Callable[[int], Answers],
        states: int,
        random: torch.Generator,
        device: torch.device,
    ) -> None:
        self._probes, self._ask, self._device = probes, answers, device
        # Each state begins with another of its probes, so that a minibatch mixes all of them.
        self._offset = torch.randint(2**31, (states, 1), generator=random).to(device)
        self._fill(0)

    def load(self, visit: int) -> None:
        """Ask anew where a visit needs answers that the sample in use does not have."""
        if self._probes.resample:
            number = visit * self._used // self._numbers.shape[1]
            if number != self._number:
                self._fill(number)

    def deal(self, rows: Tensor, visit: int) -> ProbeBatch:
        """Return the probes (B, used) of the states' visit."""
        turns = visit * self._used + torch.arange(self._used, device=self._device)
        columns = (self._offset[rows] + turns) % self._numbers.shape[1]
        rows = rows[:, None]
        along = self._numbers[rows, columns]
        return ProbeBatch(self._bank[along], self._values[rows, columns], self._gains[along])

    def _fill(self, number: int) -> None:
        answers = self._ask(number)
        self._number = number
        self._gains = _floats(answers.gains).to(self._device)
        self._bank = _floats(answers.displacements).to(self._device)
        numbers = np.array(answers.numbers)  # a view of one row can't be written, as torch wants
        self._numbers = torch.from_numpy(numbers).to(self._device)
        self._values = _floats(answers.values).to(self._device)
        self._used = self._probes.used_per_visit(answers.numbers.shape[1])


def _floats(array: np.ndarray) -> Tensor:
    """Return an array of anybody's, of doubles or a reversed view too, as torch takes it."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))
