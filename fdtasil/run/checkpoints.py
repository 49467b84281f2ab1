"""The stages of a round, each kept before the next begins, and taken up after an interruption."""

import io
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from fdtasil.demonstrations.dataset import Dataset, check_shapes
from fdtasil.files.arrays import array_from_bytes
from fdtasil.files.border import reads
from fdtasil.files.reading import from_json
from fdtasil.files.run_format import STATES, WEIGHTS
from fdtasil.files.storage import to_json
from fdtasil.probes.calibration import Calibration
from fdtasil.run.account import Account, check_account
from fdtasil.run.asking import Asking
from fdtasil.run.folder import RunFolder
from fdtasil.student.fit_state import check_history
from fdtasil.student.policy import Student

__all__ = [
    "ADDED",
    "ASKED",
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
        counts: Clipped actions, physics resets, falls and replaced episodes in them.
    """

    dataset: Dataset
    episodes: int
    counts: Mapping[str, int]

    def __add__(self, later: "Collected") -> "Collected":
        """Join what a later round adds, which counts what happened in all."""
        old, new = self.dataset, later.dataset
        answers = new.answers
        if old.answers is not None and answers is not None:
            answers = old.answers + answers
        states = old.demonstrations + new.demonstrations
        return replace(later, dataset=replace(new, demonstrations=states, answers=answers))


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


_STAGE = reads(
    "a stage of this run", "a checkpoint of the same run", "start the run anew in another folder"
)


def _count(about: dict[str, Any], name: str) -> int:
    if type(about[name]) is not int or about[name] < 0:
        raise TypeError(f"{name} of {about[name]!r}")
    return about[name]


def _write_collected(now: Collected) -> Files:
    about = {"episodes": now.episodes, "counts": dict(now.counts)}
    return {_ABOUT: to_json(about), STATES: now.dataset.to_bytes()}


@_STAGE
def _read_collected(files: Files) -> Collected:
    about = from_json(files[_ABOUT])
    counts = {name: _count(about["counts"], name) for name in about["counts"]}
    dataset = Dataset.from_bytes(files[STATES])
    check_shapes(dataset)
    return Collected(dataset, _count(about, "episodes"), Counter(counts))


def _write_values(values: np.ndarray) -> Files:
    target = io.BytesIO()
    np.save(target, values, allow_pickle=False)
    return {"values.npy": target.getvalue()}


@_STAGE
def _read_values(files: Files) -> np.ndarray:
    values = array_from_bytes(files["values.npy"])
    if values.dtype != np.float32 or values.ndim != 4:
        raise ValueError(f"answers of {values.dtype} and shape {values.shape}")
    return values


def _write_halfway(now: Halfway) -> Files:
    return {_ABOUT: to_json({"sample": now.sample}), "fit.safetensors": now.fit}


@_STAGE
def _read_halfway(files: Files) -> Halfway:
    return Halfway(files["fit.safetensors"], _count(from_json(files[_ABOUT]), "sample"))


def _write_trained(now: Trained) -> Files:
    about = {"history": now.history, "steps": now.steps}
    return {_ABOUT: to_json(about), WEIGHTS: now.student.to_bytes()}


@_STAGE
def _read_trained(files: Files) -> Trained:
    about = from_json(files[_ABOUT])
    check_history(about["history"])
    if not about["history"]:
        raise ValueError("a history without an entry")
    student = Student.from_bytes(files[WEIGHTS])
    return Trained(student, about["history"], _count(about, "steps"))


@_STAGE
def _read_run(files: Files) -> tuple[Calibration | None, dict[str, Any]]:
    """Return the calibration and the account that every checkpoint keeps."""
    run = from_json(files[_RUN])
    check_account(run["account"])
    found = run["calibration"]
    return (None if found is None else Calibration.from_json(found)), run["account"]


RECORDED = Stage("recorded", _write_collected, _read_collected)
"""A round's own episodes, labelled, before the probes around them are asked."""
ASKED = Stage("asked", _write_values, _read_values)
"""Answers to the first of a round's probes."""
ADDED = Stage("added", _write_collected, _read_collected)
"""What a round adds to what is learnt from: its labelled states, and the answers around them."""
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
        calibration, account = _read_run(files)
        content = stage.read(files)
        if calibration is not None:
            self.asking.take_up(calibration)
        self.account.take_up(account)
        return content

    def once(self, round_: int, stage: Stage[Content], do: Callable[[], Content]) -> Content:
        """Return what was kept of a stage, or do it and keep it."""
        found = self.take_up(round_, stage)
        if found is None:
            found = done = do()
            self.keep(round_, stage, lambda: done)
        return found
