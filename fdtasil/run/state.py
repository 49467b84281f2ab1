"""What grows from round to round of a run: how it is kept, and taken up again."""

import io
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.files.storage import to_json
from fdtasil.probes.answers import UNFOLLOWED, Answers, Asking, ask_probes
from fdtasil.probes.calibration import Calibration, calibrate
from fdtasil.probes.scales import Scales, measure_scales
from fdtasil.probes.source import Probes
from fdtasil.rollouts.episodes import Episodes
from fdtasil.run.account import Account
from fdtasil.run.configuration import Configuration
from fdtasil.run.folder import RunFolder
from fdtasil.seeding import generator
from fdtasil.student.network import Student
from fdtasil.student.view import StudentObservation, View

__all__ = ["RunState"]

# Files of a checkpoint.
_STATE, _STATES, _STUDENT = "state.json", "demonstrations.npz", "student.safetensors"
_VALUES = "values.npy"


@dataclass
class RunState:
    """What grows from round to round.

    Attributes:
        run: The configuration.
        expert: Who labels and answers probes; None where nothing has to be asked.
        student_obs: What the student sees; None for everything.
        folder: Where every stage is kept.
        account: What it has cost so far.
        dataset: All labelled states so far and the answers around them.
        student: The last round's.
        history: Entries of all rounds.
        steps: Gradient steps of all rounds.
        episodes: Number of episodes recorded so far.
        counts: Clipped actions, physics resets and falls of the recorded episodes.
        calibration: What was found about the expert in the first round, or None.
        source: The derivative source, with what the calibration found filled in; kept, for filling
            it in warns of a radius that misleads.
    """

    run: Configuration
    expert: Expert | None
    student_obs: StudentObservation | None
    folder: RunFolder
    account: Account
    dataset: Dataset | None = None
    student: Student | None = None
    history: list[dict[str, float]] = field(default_factory=list)
    steps: int = 0
    episodes: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    calibration: Calibration | None = None
    source: Probes | None = field(init=False)

    def __post_init__(self) -> None:
        self.source = self.run.probes

    @property
    def data(self) -> Dataset:
        """The dataset; the first round has made it, or it was given."""
        assert self.dataset is not None
        return self.dataset

    @property
    def trained(self) -> Student:
        """The last round's student."""
        assert self.student is not None, "every run has a round"
        return self.student

    @property
    def view(self) -> View:
        """What the student sees."""
        states = self.data.demonstrations
        return View.of(self.student_obs, states.observations[states.round == 0][:256])

    @property
    def scales(self) -> Scales:
        """Scales of all states so far: the first episode may be a fall of three steps."""
        return measure_scales(self.data.demonstrations.observations, self.view.seen)

    def count(self, recorded: Episodes) -> None:
        """Count newly recorded episodes, and what happened in them."""
        self.episodes += len(recorded.valid)
        self.counts["clipped_actions"] += recorded.clipped_actions
        self.counts["physics_resets"] += int(recorded.physics_resets.sum())
        self.counts["terminated_episodes"] += int(recorded.terminated.sum())

    def calibrate(self) -> None:
        """Find what the source leaves open, once, on the states of the first round."""
        run, expert = self.run, self.expert
        if not run.calibrated or self.calibration is not None or expert is None:
            return
        assert run.probes is not None
        found = calibrate(
            expert,
            self.data.demonstrations.observations,
            self.scales,
            generator(run.seed, "calibration"),
            run.usual_radius,
            run.ladder,
        )
        self.calibration, self.source = found, found.complete(run.probes)

    def ask_collected(
        self, observations: np.ndarray, round_: int, move: Callable[[int], None]
    ) -> Answers:
        """Ask the probes around a round's states, in the first one after a calibration.

        The answers are kept on the way.

        Args:
            observations: (N, n) the states.
            round_: The round.
            move: Told of the states that are done.
        """
        known = self._restore_asked(round_)
        self.calibrate()
        self.check_budget(len(observations) - (0 if known is None else len(known)))

        def told(values: np.ndarray, states: int) -> None:
            move(states)
            if self.folder.due:
                self.keep(round_, "asked", {}, lambda: {_VALUES: _npy(values)}, len(values))

        return self.ask(observations, round_, 0, asking=Asking(known, told))

    def _restore_asked(self, round_: int) -> np.ndarray | None:
        """Take up the answers of an asking that was interrupted, if there are any."""
        kept = self.take_up(round_, "asked")
        if kept is None:
            return None
        return np.load(io.BytesIO(kept[0][_VALUES]), allow_pickle=False)

    def check_budget(self, states: int) -> None:
        """Refuse to ask the probes of some states where the budget does not allow it.

        Raises:
            SettingError: If it does not.
        """
        if self.source is not None and self.expert is not None:
            moving = int(self.scales.probed(self.source.space).sum())
            due = self.source.queries(states, moving, 1)
            self.account.check_budget(due, self.run.max_queries)

    def ask(self, observations: np.ndarray, *path: int, asking: Asking = UNFOLLOWED) -> Answers:
        """Ask the probes around states, along the directions of a named stream.

        Raises:
            SettingError: If there is nobody to ask.
            ExpertError: As `ask_probes`.
        """
        probes, expert = self.source, self.expert
        assert probes is not None
        if expert is None:
            raise SettingError(
                f"probes={probes.describe()!r} without an expert to ask",
                "an expert, or demonstrations with stored answers",
                "pass the expert, or probes=0 for plain behaviour cloning",
            )
        scales = self.scales
        random, order = generator(self.run.seed, "probes", *path), self.run.order
        return ask_probes(expert, observations, probes, scales, random, order, asking)

    def keep(
        self,
        round_: int,
        stage: str,
        about: dict[str, Any],
        files: Callable[[], dict[str, bytes]],
        number: int = 0,
    ) -> None:
        """Keep a stage of a round, and with it the account and the calibration.

        Args:
            round_: The round.
            stage: Its name.
            about: What else `take_up` returns of it, as plain JSON values.
            files: Called for its files, where there is a folder.
            number: How far the stage has come.
        """
        calibration = self.calibration.to_json() if self.calibration else None
        state = {**about, "calibration": calibration, **self.account.to_json()}
        self.folder.save(round_, stage, number, lambda: {**files(), _STATE: to_json(state)})

    def take_up(self, round_: int, stage: str) -> tuple[dict[str, bytes], dict[str, Any]] | None:
        """Return the files of a stage that the interrupted run kept and what it said of them.

        Its account and calibration go on from there. None where it kept nothing.
        """
        files = self.folder.load(round_, stage)
        if files is None:
            return None
        state: dict[str, Any] = json.loads(files[_STATE])
        if state["calibration"] and self.calibration is None and self.run.probes is not None:
            self.calibration = Calibration.from_json(state["calibration"])
            self.source = self.calibration.complete(self.run.probes)
        self.account.take_up(state)  # last: it knows the warnings that completing repeats
        return files, state

    def keep_recorded(self, round_: int, new: Dataset) -> None:
        """Keep what a round has recorded, before its probes are asked."""
        about = {"episodes": self.episodes, "counts": self.counts}
        self.keep(round_, "recorded", about, lambda: {_STATES: new.to_bytes()})

    def restore_recorded(self, round_: int) -> Dataset | None:
        """Take up what a round of the interrupted run recorded, if it did."""
        return self._restore_states(round_, "recorded")

    def keep_collected(self, round_: int) -> None:
        """Keep what a round has recorded and asked."""
        about = {"episodes": self.episodes, "counts": self.counts}
        self.keep(round_, "collected", about, lambda: {_STATES: self.data.to_bytes()})

    def restore_collected(self, round_: int) -> bool:
        """Take up what a round of the interrupted run kept; return whether there was any."""
        found = self._restore_states(round_, "collected")
        if found is not None:
            self.dataset = found
        return found is not None

    def _restore_states(self, round_: int, stage: str) -> Dataset | None:
        kept = self.take_up(round_, stage)
        if kept is None:
            return None
        files, about = kept
        self.episodes, self.counts = about["episodes"], Counter(about["counts"])
        return Dataset.from_bytes(files[_STATES])

    def keep_trained(self, round_: int) -> None:
        """Keep a round's student."""
        about = {"history": self.history, "steps": self.steps}
        self.keep(round_, "trained", about, lambda: {_STUDENT: self.trained.to_bytes()})

    def restore_trained(self, round_: int) -> bool:
        """Take up a round's student; return whether there was one."""
        kept = self.take_up(round_, "trained")
        if kept is None:
            return False
        files, about = kept
        self.student = Student.from_bytes(files[_STUDENT])
        self.history, self.steps = about["history"], about["steps"]
        return True


def _npy(values: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, values, allow_pickle=False)
    return target.getvalue()
