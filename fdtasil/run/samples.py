"""The expert's answers in a round's training: those stored, then those asked anew."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from fdtasil.probes.answers import Answers
from fdtasil.probes.device_twin import DeviceTwin
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.asking import Asking
from fdtasil.run.lesson import Lesson

__all__ = ["Samples"]


@dataclass
class Samples:
    """The expert's answers, a sample at a time: the first of all states, others where it trains.

    Attributes:
        asking: Asks for new ones.
        stored: The answers of sample 0.
        lesson: What is learnt, and its scales.
        rows: (S,) the states that are trained on; others are held out, and looked at once.
        round: The round.
        device: Where is trained.
        asked_before: Number of the sample that the interrupted run had asked for last, or -1.
        number: Of the sample in use.
    """

    asking: Asking
    stored: Answers
    lesson: Lesson
    rows: np.ndarray
    round: int
    device: torch.device
    asked_before: int = -1
    number: int = 0

    @cached_property
    def around(self) -> Surroundings:
        """Where the source probes; the same for all samples."""
        states = self.lesson.dataset.demonstrations.at(self.rows)
        return self.asking.around(states, self.lesson.scales, again=True)

    @cached_property
    def twin(self) -> DeviceTwin | None:
        """Who answers on the device, or None where the expert itself is asked."""
        return self.asking.twin(self.around, self.stored.at(self.rows), self.device)

    @property
    def observations(self) -> np.ndarray:
        """(N, n) the states."""
        return self.lesson.dataset.demonstrations.observations

    @property
    def offsets(self) -> tuple[float, ...]:
        """Of the stencil; none where derivatives are exact."""
        source = self.asking.source
        return source.stencil.offsets if source and source.stencil else ()

    def __call__(self, number: int) -> Answers:
        """Return the answers of a sample; what was stored is not asked again."""
        answers = self.stored if number == 0 else self._ask(number)
        self.number = number
        return answers

    def _ask(self, number: int) -> Answers:
        ask = self.asking.ask_again if number == self.asked_before else self.asking.ask
        answers = ask(self.around, self.round, number, twin=self.twin)
        return answers.among(self.rows, len(self.observations))
