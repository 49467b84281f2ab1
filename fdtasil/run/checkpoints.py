"""The stages of a round, each kept before the next begins, and taken up after an interruption."""

import io
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.files.storage import to_json
from fdtasil.probes.calibration import Calibration
from fdtasil.run.account import Account
from fdtasil.run.asking import Asking
from fdtasil.run.folder import RunFolder
from fdtasil.student.policy import Student

__all__ = [
    "ASKED",
    "COLLECTED",
    "RECORDED",
    "TRAINED",
    "TRAINING",
    "Checkpoints",
    "Collected",
    "Halfway",
    "Stage",
    "Trained",
]

Content = TypeVar("Content")
Files = dict[str, bytes]


@dataclass(frozen=True)
class Stage(Generic[Content]):
    """A stage of a round: how far it came is kept as files.

    Attributes:
        name: Of its folder.
        write: Content -> files.
        read: Files -> content.
    """

    name: str
    write: Callable[[Content], Files]
    read: Callable[[Files], Content]


@dataclass(frozen=True)
class Collected:
    """What the run has to learn from.

    Attributes:
        dataset: Labelled states, and the answers around them.
        episodes: How many were recorded so far.
        counts: Clipped actions, physics resets and falls in them.
    """

    dataset: Dataset
    episodes: int
    counts: Mapping[str, int]


@dataclass(frozen=True)
class Halfway:
    """Where a training stands.

    Attributes:
        fit: The bytes of its `FitState`.
        sample: Number of the answers in use.
    """

    fit: bytes
    sample: int


@dataclass(frozen=True)
class Trained:
    """What a round's training came to.

    Attributes:
        student: The round's.
        history: Entries of all rounds.
        steps: Gradient steps of all rounds.
    """

    student: Student
    history: list[dict[str, float]]
    steps: int


_ABOUT = "about.json"
_RUN = "run.json"


def _write_collected(now: Collected) -> Files:
    about = {"episodes": now.episodes, "counts": dict(now.counts)}
    return {_ABOUT: to_json(about), "demonstrations.npz": now.dataset.to_bytes()}


def _read_collected(files: Files) -> Collected:
    about = json.loads(files[_ABOUT])
    dataset = Dataset.from_bytes(files["demonstrations.npz"])
    return Collected(dataset, about["episodes"], Counter(about["counts"]))


def _write_values(values: np.ndarray) -> Files:
    target = io.BytesIO()
    np.save(target, values, allow_pickle=False)
    return {"values.npy": target.getvalue()}


def _read_values(files: Files) -> np.ndarray:
    return np.load(io.BytesIO(files["values.npy"]), allow_pickle=False)


def _write_halfway(now: Halfway) -> Files:
    return {_ABOUT: to_json({"sample": now.sample}), "fit.safetensors": now.fit}


def _read_halfway(files: Files) -> Halfway:
    return Halfway(files["fit.safetensors"], json.loads(files[_ABOUT])["sample"])


def _write_trained(now: Trained) -> Files:
    about = {"history": now.history, "steps": now.steps}
    return {_ABOUT: to_json(about), "student.safetensors": now.student.to_bytes()}


def _read_trained(files: Files) -> Trained:
    about = json.loads(files[_ABOUT])
    student = Student.from_bytes(files["student.safetensors"])
    return Trained(student, about["history"], about["steps"])


RECORDED = Stage("recorded", _write_collected, _read_collected)
"""A round's own episodes, labelled, before the probes around them are asked."""
ASKED = Stage("asked", _write_values, _read_values)
"""Answers to the first of a round's probes."""
COLLECTED = Stage("collected", _write_collected, _read_collected)
"""All that a round learns from."""
TRAINING = Stage("training", _write_halfway, _read_halfway)
"""A training on its way."""
TRAINED = Stage("trained", _write_trained, _read_trained)
"""A round's student."""


@dataclass(frozen=True)
class Checkpoints:
    """Keeps stages in the run's folder, and with them the account and the calibration.

    Attributes:
        folder: Where; one without a path keeps nothing.
        account: What the run has cost.
        asking: Knows the calibration.
    """

    folder: RunFolder
    account: Account
    asking: Asking

    @property
    def due(self) -> bool:
        """Whether enough would be lost by now to be worth a checkpoint."""
        return self.folder.due

    def keep(
        self,
        round_: int,
        stage: Stage[Content],
        content: Callable[[], Content],
        number: int = 0,
    ) -> None:
        """Keep a stage of a round.

        Args:
            round_: The round.
            stage: The stage.
            content: Called for what is kept, where there is a folder.
            number: How far the stage has come.
        """

        def files() -> Files:
            found = self.asking.calibration
            run = {
                "calibration": found.to_json() if found else None,
                "account": self.account.to_json(),
            }
            return {**stage.write(content()), _RUN: to_json(run)}

        self.folder.save(round_, stage.name, number, files)

    def take_up(self, round_: int, stage: Stage[Content]) -> Content | None:
        """Return what the interrupted run kept of a stage, and go on from its account.

        None where it kept nothing.
        """
        files = self.folder.load(round_, stage.name)
        if files is None:
            return None
        run = json.loads(files[_RUN])
        if run["calibration"] is not None:
            self.asking.take_up(Calibration.from_json(run["calibration"]))
        self.account.take_up(run["account"])
        return stage.read(files)

    def once(self, round_: int, stage: Stage[Content], do: Callable[[], Content]) -> Content:
        """Return what was kept of a stage, or do it and keep it."""
        found = self.take_up(round_, stage)
        if found is None:
            found = done = do()
            self.keep(round_, stage, lambda: done)
        return found
