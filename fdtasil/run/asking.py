"""Asking the probes of a run: how far is found first, the budget holds, nothing is asked twice."""

from dataclasses import replace

import torch

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.probes.answers import FROM_THE_START, Answers, Beginning, ask_probes
from fdtasil.probes.calibration import Calibration, calibrate
from fdtasil.probes.derivatives import check_derivatives, comparison_rows
from fdtasil.probes.device_twin import DeviceTwin
from fdtasil.probes.scales import Scales, action_units
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.account import Account
from fdtasil.run.configuration import Configuration
from fdtasil.seeding import generator

__all__ = ["Asking"]


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

    def calibrate(self, dataset: Dataset, scales: Scales) -> None:
        """Find what the source leaves open, once, on the states of the first round."""
        run, expert = self._run, self._expert
        if run.calibrated and self.calibration is None and expert is not None:
            states, random = dataset.demonstrations, generator(run.seed, "calibration")
            units = action_units(dataset.low, dataset.high, states.actions, dataset.choices)
            about = scales, random, run.usual_radius, run.ladder, units
            self.take_up(calibrate(expert, states.observations, *about))

    def take_up(self, found: Calibration | None) -> None:
        """Fill in what a calibration found, unless it was filled in before."""
        if found is not None and self.calibration is None and self._run.probes is not None:
            self.calibration, self.source = found, found.complete(self._run.probes)

    def around(
        self, states: Demonstrations, scales: Scales, *, again: bool = False
    ) -> Surroundings:
        """Return where the source probes around labelled states; see `Surroundings.of`.

        Raises:
            SettingError: If there is nobody to ask, or as `Surroundings.of`.
        """
        assert self.source is not None, "plain behaviour cloning asks no probes"
        self._askable()
        found = Surroundings.of(states.observations, self.source, scales, again=again)
        return replace(found, actions=states.actions)

    def twin(self, around: Surroundings, said: Answers, device: torch.device) -> DeviceTwin | None:
        """Return who answers on a GPU in the expert's place; see `DeviceTwin.of`."""
        if device.type != "cuda":
            return None
        return DeviceTwin.of(self._askable(), around, said, device)

    def ask(
        self,
        around: Surroundings,
        *stream: int,
        beginning: Beginning = FROM_THE_START,
        twin: DeviceTwin | None = None,
    ) -> Answers:
        """Ask the probes, along the directions of a named stream.

        Args:
            around: Where.
            stream: Round and sample.
            beginning: What is there already.
            twin: Who answers instead of the expert.

        Raises:
            SettingError: If the budget does not allow it.
            ExpertError: As `ask_probes`.
        """
        known = 0 if beginning.known is None else len(beginning.known)
        new = len(around.observations) - known
        due = around.probes.queries(new, len(around.live), visits=1)
        # The expert's own derivatives are compared with differences once, before the first answer.
        compares = self._run.own_derivatives and stream == (0, 0) and not known
        if self._run.own_derivatives:
            due = new + (comparison_rows(around.observations.shape[1]) if compares else 0)
        self._account.check_budget(due, self._run.max_queries, self._run.asked_at_the_end)
        if compares:
            check_derivatives(self._askable(), around.observations)
        return self._ask(around, stream, beginning, twin)

    def ask_again(
        self, around: Surroundings, *stream: int, twin: DeviceTwin | None = None
    ) -> Answers:
        """Ask what the interrupted run had asked already, and has counted."""
        with self._account.asked_before():
            return self._ask(around, stream, FROM_THE_START, twin)

    def _ask(
        self,
        around: Surroundings,
        stream: tuple[int, ...],
        beginning: Beginning,
        twin: DeviceTwin | None,
    ) -> Answers:
        random = generator(self._run.seed, "probes", *stream)
        asked = twin and twin.values
        return ask_probes(self._askable(), around, random, self._run.order, beginning, asked)

    def _askable(self) -> Expert:
        if self._expert is None:
            raise SettingError(
                f"probes {self._run.probes and self._run.probes.describe()} without an expert",
                "an expert to ask, or a dataset with stored answers",
                "pass the expert, or probes=0 for plain behaviour cloning",
            )
        return self._expert
