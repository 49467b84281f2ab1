"""What grows from round to round of a run: how it is kept, and taken up again."""

import io
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fdtasil.account import Account
from fdtasil.answers import Answers, Asking, ask_probes
from fdtasil.calibration import Calibration, calibrate
from fdtasil.configuration import Configuration
from fdtasil.datasets import Dataset
from fdtasil.errors import SettingError
from fdtasil.experts import Expert
from fdtasil.probes import Probes
from fdtasil.recording import Episodes
from fdtasil.runfolder import RunFolder
from fdtasil.scales import Statistics, statistics
from fdtasil.seeding import generator
from fdtasil.storage import to_json
from fdtasil.student import Student
from fdtasil.views import StudentObservation, View

__all__ = ["RunState"]


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
    def scales(self) -> Statistics:
        """Scales of all states so far: the first episode may be a fall of three steps."""
        return statistics(self.data.demonstrations.observations, self.view.seen)

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
                about = {"calibration": self._calibration_json(), **self.account.to_json()}
                self.folder.save(
                    round_,
                    "asked",
                    len(values),
                    lambda: {"values.npy": _npy(values), "state.json": to_json(about)},
                )

        return self.ask(observations, round_, 0, asking=Asking(known, told))

    def _restore_asked(self, round_: int) -> np.ndarray | None:
        """Take up the answers of an asking that was interrupted, if there are any."""
        files = self.folder.load(round_, "asked")
        if files is None:
            return None
        state: dict[str, Any] = json.loads(files["state.json"])
        self._restore_calibration(state["calibration"])
        self.account.take_up(state)
        return np.load(io.BytesIO(files["values.npy"]), allow_pickle=False)

    def _calibration_json(self) -> dict[str, Any] | None:
        return self.calibration.to_json() if self.calibration else None

    def _restore_calibration(self, kept: dict[str, Any] | None) -> None:
        if kept and self.calibration is None and self.run.probes is not None:
            self.calibration = Calibration.from_json(kept)
            self.source = self.calibration.complete(self.run.probes)

    def check_budget(self, states: int) -> None:
        """Refuse to ask the probes of some states where the budget does not allow it.

        Raises:
            SettingError: If it does not.
        """
        if self.source is not None and self.expert is not None:
            moving = int(self.scales.probed(self.source.space).sum())
            due = self.source.queries(states, moving, 1)
            self.account.check_budget(due, self.run.max_queries)

    def ask(self, observations: np.ndarray, *path: int, asking: Asking | None = None) -> Answers:
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

    def keep_recorded(self, round_: int, new: Dataset) -> None:
        """Keep what a round has recorded, before its probes are asked."""
        about = {"episodes": self.episodes, "counts": self.counts, **self.account.to_json()}
        self.folder.save(
            round_,
            "recorded",
            0,
            lambda: {"demonstrations.npz": new.to_bytes(), "state.json": to_json(about)},
        )

    def restore_recorded(self, round_: int) -> Dataset | None:
        """Take up what a round of the interrupted run recorded, if it did."""
        files = self.folder.load(round_, "recorded")
        if files is None:
            return None
        state: dict[str, Any] = json.loads(files["state.json"])
        self.episodes, self.counts = state["episodes"], Counter(state["counts"])
        self.account.take_up(state)
        return Dataset.from_bytes(files["demonstrations.npz"])

    def keep_collected(self, round_: int) -> None:
        """Keep what a round has recorded and asked."""
        about = {
            "episodes": self.episodes,
            "counts": self.counts,
            "calibration": self._calibration_json(),
            **self.account.to_json(),
        }
        self.folder.save(
            round_,
            "collected",
            0,
            lambda: {"demonstrations.npz": self.data.to_bytes(), "state.json": to_json(about)},
        )

    def restore_collected(self, round_: int) -> bool:
        """Take up what a round of the interrupted run kept; return whether there was any."""
        files = self.folder.load(round_, "collected")
        if files is None:
            return False
        state: dict[str, Any] = json.loads(files["state.json"])
        self.dataset = Dataset.from_bytes(files["demonstrations.npz"])
        self.episodes, self.counts = state["episodes"], Counter(state["counts"])
        self._restore_calibration(state["calibration"])
        self.account.take_up(state)
        return True

    def keep_trained(self, round_: int) -> None:
        """Keep a round's student."""
        about = {"history": self.history, "steps": self.steps, **self.account.to_json()}
        self.folder.save(
            round_,
            "trained",
            0,
            lambda: {"student.safetensors": self.trained.to_bytes(), "state.json": to_json(about)},
        )

    def restore_trained(self, round_: int) -> bool:
        """Take up a round's student; return whether there was one."""
        files = self.folder.load(round_, "trained")
        if files is None:
            return False
        state: dict[str, Any] = json.loads(files["state.json"])
        self.student = Student.from_bytes(files["student.safetensors"])
        self.history, self.steps = state["history"], state["steps"]
        self.account.take_up(state)
        return True


def _npy(values: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, values, allow_pickle=False)
    return target.getvalue()
