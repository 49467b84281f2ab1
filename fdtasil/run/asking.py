"""Asking the probes of a run: how far is found first, the budget holds, nothing is asked twice."""

from dataclasses import dataclass

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.probes.answers import FROM_THE_START, Answers, Beginning, ask_probes
from fdtasil.probes.calibration import Calibration, calibrate
from fdtasil.probes.scales import Scales
from fdtasil.probes.source import Probes
from fdtasil.run.account import Account
from fdtasil.run.configuration import Configuration
from fdtasil.seeding import generator

__all__ = ["Asking", "Samples"]


class Asking:
    """Asks the expert around states, along named streams of directions.

    Args:
        run: The configuration.
        expert: Who answers; None where nothing has to be asked.
        account: What it has cost so far.

    Attributes:
        source: The derivative source, with what the calibration found filled in; kept, for filling
            it in warns of a radius that misleads. None for plain behaviour cloning.
        calibration: What was found about the expert, or None.
    """

    def __init__(self, run: Configuration, expert: Expert | None, account: Account) -> None:
        self._run, self._expert, self._account = run, expert, account
        self.source = run.probes
        self.calibration: Calibration | None = None

    def calibrate(self, states: np.ndarray, scales: Scales) -> None:
        """Find what the source leaves open, once, on (N, n) states of the first round."""
        run, expert = self._run, self._expert
        if run.calibrated and self.calibration is None and expert is not None:
            random = generator(run.seed, "calibration")
            self.take_up(calibrate(expert, states, scales, random, run.usual_radius, run.ladder))

    def take_up(self, found: Calibration | None) -> None:
        """Fill in what a calibration found, unless it was filled in before."""
        if found is not None and self.calibration is None and self._run.probes is not None:
            self.calibration, self.source = found, found.complete(self._run.probes)

    def ask(
        self,
        observations: np.ndarray,
        scales: Scales,
        *stream: int,
        beginning: Beginning = FROM_THE_START,
    ) -> Answers:
        """Ask the probes around (N, n) states, along the directions of a named stream.

        Raises:
            SettingError: If there is nobody to ask, or the budget does not allow it.
            ExpertError: As `ask_probes`.
        """
        source, _ = self._askable()
        known = 0 if beginning.known is None else len(beginning.known)
        moving = int(scales.probed(source.space).sum())
        due = source.queries(len(observations) - known, moving, visits=1)
        self._account.check_budget(due, self._run.max_queries)
        return self._ask(observations, scales, stream, beginning)

    def ask_again(self, observations: np.ndarray, scales: Scales, *stream: int) -> Answers:
        """Ask what the interrupted run had asked already, and has counted."""
        with self._account.asked_before():
            return self._ask(observations, scales, stream, FROM_THE_START)

    def _ask(
        self,
        observations: np.ndarray,
        scales: Scales,
        stream: tuple[int, ...],
        beginning: Beginning,
    ) -> Answers:
        source, expert = self._askable()
        random = generator(self._run.seed, "probes", *stream)
        order = self._run.order
        return ask_probes(expert, observations, source, scales, random, order, beginning)

    def _askable(self) -> tuple[Probes, Expert]:
        assert self.source is not None, "plain behaviour cloning asks no probes"
        if self._expert is None:
            raise SettingError(
                f"probes={self.source.describe()!r} without an expert to ask",
                "an expert, or a dataset with stored answers",
                "pass the expert, or probes=0 for plain behaviour cloning",
            )
        return self.source, self._expert


@dataclass
class Samples:
    """The expert's answers in a round's training: those stored, then those of new directions.

    Attributes:
        asking: Asks for new ones.
        stored: The answers of sample 0.
        observations: (N, n) the states.
        scales: Of the states.
        round: The round.
        asked_before: Number of the sample that the interrupted run had asked for last, or -1.
        number: Of the sample in use.
    """

    asking: Asking
    stored: Answers
    observations: np.ndarray
    scales: Scales
    round: int
    asked_before: int = -1
    number: int = 0

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
        return ask(self.observations, self.scales, self.round, number)
