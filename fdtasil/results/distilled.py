"""The result of a distillation, and its run folder."""

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdtasil.checks import check_path
from fdtasil.demonstrations.dataset import Dataset, check_shapes
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import ExportError, SettingError, first_line, warn
from fdtasil.experts.expert import rows_text
from fdtasil.experts.onnx_expert import COLUMNS, FUNCTION, HISTORY
from fdtasil.files.border import reads
from fdtasil.files.lock import locked
from fdtasil.files.plain import as_kind, without_infinities
from fdtasil.files.reading import from_json
from fdtasil.files.run_format import (
    CARD,
    CONFIG,
    MODEL,
    PROGRESS,
    REPORT,
    STATES,
    WEIGHTS,
    check_free,
    check_run,
    stamped,
    unstamped,
)
from fdtasil.files.storage import (
    add_to_folder,
    to_json,
    verify,
    write_bytes,
    write_folder,
)
from fdtasil.probes.answers import Answers
from fdtasil.probes.calibration import Calibration
from fdtasil.results.card import card_of
from fdtasil.results.evaluation import Evaluation, missing_text
from fdtasil.results.figures import FIGURES
from fdtasil.results.page import result_html
from fdtasil.student.exports import SPACES, export, order_of
from fdtasil.student.into_sb3 import agent_of
from fdtasil.student.policy import Student
from fdtasil.student.view import (
    StudentObservation,
    Unseen,
    View,
    describe_view,
    sees_as,
    visible,
)

__all__ = ["Distilled", "given_view", "write_run"]

_PARITY_STATES = 1000
_PATIENCE = 60.0  # seconds that save() waits for another process that saves into the folder


@dataclass(frozen=True, repr=False)
class Distilled:
    """A student, and how it came to be.

    Attributes:
        student: The policy, on the CPU.
        evaluation: Student against expert, from the same starts; None where there was no expert
            or no environment to compare them in.
        history: Training losses, one entry for each 100 steps: round, step, loss, action_error,
            derivative_error, curvature_error, moved_error, and where states are held out
            validation_loss.
        queries: Rows that the expert answered, by purpose: act, label, probe, calibrate, check
            (the gate), evaluate, remember (a memory, carried over given states).
        settings: The exact arguments and what they resolved to, with versions; plain JSON.
        report: What `report.json` holds.
        dataset: The labelled states and the expert's answers around them; give it to
            `distill(dataset=...)` to train another student without asking.
        view: What the student sees of an observation.

    Example:
        >>> import fdtasil, numpy as np
        >>> result = fdtasil.distill(
        ...     lambda x: np.clip(-8 * np.arctan2(x[:, 1:2], x[:, :1]) - 2 * x[:, 2:], -2, 2),
        ...     "Pendulum-v1", probes="sphere:2,forward", episodes=1, horizon=20,
        ...     evaluation_episodes=2, student=fdtasil.Mlp(8), fit=fdtasil.Fit(steps=20),
        ... )
        >>> result.queries["probe"]
        40
    """

    student: Student
    evaluation: Evaluation | None
    history: list[dict[str, float]]
    queries: dict[str, int]
    settings: dict[str, Any]
    report: dict[str, Any]
    dataset: Dataset
    view: View

    def __repr__(self) -> str:
        """Return what a notebook shows of it."""
        lines = [
            f"{self.report['env']}: {len(self.demonstrations):,} states, probes "
            f"{self.report['probes']}, {self.report['steps']:,} steps",
            f"queries: {rows_text(self.queries) or 'none'}",
            missing_text(self.settings) if self.evaluation is None else str(self.evaluation),
        ]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return result_html(self)

    @property
    def steps_seen(self) -> int:
        """How many observations the student sees, the present one among them."""
        past = self.settings.get("past") or 0
        own = self.settings.get("observation_size", 0) - self.settings.get("remembered", 0) - past
        return past // max(1, own + self.student.action_size) + 1 if past > 0 else 1

    @property
    def observation_order(self) -> str:
        """What stands where in what the student sees, "" where it is a plain vector."""
        return order_of(self.student, self._metadata())

    @property
    def demonstrations(self) -> Demonstrations:
        """The labelled states."""
        return self.dataset.demonstrations

    @property
    def answers(self) -> Answers | None:
        """The expert's answers to the probes, or None."""
        return self.dataset.answers

    def export(self, path: str | Path, inputs: str = "flat") -> Path:
        """Write the student as the file that the suffix of a path asks for.

        Args:
            path: Ends with ".onnx" (input `obs` (batch, n), output `actions`, normaliser and
                action bounds inside; `metadata_props` says the rest), ".int8.onnx",
                ".safetensors", ".c" (C99 without malloc; `-DSTUDENT_MAIN` makes it a program of
                lines), ".int8.c" (weights in eight bits) or ".h", the header of both; ".tflite".
                Where actions are choices, the ONNX file has the outputs `scores` and `actions`.
                ".py" is a program that needs numpy alone, and opens the ".safetensors".
            inputs: "flat", or "keys" for an ONNX file with one input for each part of a
                dictionary.

        Raises:
            SettingError: If there is no such target.
            ExportError: If the file's answers on 1,000 of the student's own training states
                differ from torch's by more than 1e-5.
            StorageError: If it can't be written.
        """
        write_bytes(check_path("path", path), self.export_bytes(path, inputs))
        return Path(path)

    def to_onnx(self, path: str | Path) -> Path:
        """Write the student as one ONNX file, whatever its name; see `export`."""
        write_bytes(check_path("path", path), self.export_bytes(MODEL))
        return Path(path)

    def to_sb3(self, env: Any, algorithm: str = "SAC", seed: int = 0) -> Any:
        """Return an agent of stable-baselines3 that acts as the student, to be trained on.

        Its critics are fresh: let them learn before the actor does (`learning_starts`).

        Args:
            env: A gymnasium id or environment.
            algorithm: "SAC" or "TD3" where actions are numbers with bounds, "PPO" where they are
                choices.
            seed: Of the agent.

        Raises:
            SettingError: If there is no such algorithm.
            ExportError: If the student is no actor of it.
        """
        whole = self.view.is_whole or self.view.columns == (*range(self.dataset.own_size),)
        if self.steps_seen > 1 or not whole:
            raise ExportError(
                "a student that sees another thing than the observation as an agent",
                "one that sees the whole observation, as the agent will",
                "go on with the student's own weights",
            )
        return agent_of(self.student, env, algorithm, seed, self._seen())

    def export_bytes(self, name: str | Path, inputs: str = "flat") -> bytes:
        """Return what `export` writes to a file of that name."""
        return export(self.student, self._seen(), self._metadata(), name, inputs)

    def _seen(self) -> np.ndarray:
        """Return states of the training as the student sees them."""
        states = self.demonstrations.observations
        chosen = np.linspace(0, len(states) - 1, min(len(states), _PARITY_STATES)).astype(int)
        return np.asarray(self.view.look(states[chosen]), np.float32)

    def save(self, folder: str | Path) -> Path:
        """Write the run folder.

        Files: config.json, report.json, README.md (a model card), progress.csv,
        demonstrations.npz, student.safetensors, student.onnx, the pictures of `FIGURES` that there
        is something to draw for, and last a manifest. What can't be drawn or exported is left out
        with a warning.

        Args:
            folder: One that is missing, empty, or a run's, which is replaced.

        Raises:
            ExportError: If the student's weights are not finite.
            StorageError: If a file can't be written, or the folder is none of these; finished
                files stay whole.
        """
        self.export_bytes(WEIGHTS)  # what is spoilt is refused before all else
        place = check_path("folder", folder).absolute()
        check_free(place)
        with locked(place, _PATIENCE):
            write_run(self, place)
        return Path(folder)

    @classmethod
    def load(
        cls, folder: str | Path, student_obs: StudentObservation | None = None
    ) -> "Distilled":
        """Read a run folder; nothing in it is run or unpickled.

        Args:
            folder: Where `save` wrote it.
            student_obs: The function that the student sees through, which no file can hold;
                without it a student of one can be asked, but not exported.

        Raises:
            StorageError: If a file is missing, changed since (but for the card), or not one of
                ours.
            SettingError: If the student sees something else.
        """
        read = reads(
            f"a run in {folder}",
            "a run folder written by this version of fdtasil",
            "check the path, or run distill again",
        )
        found = read(cls._read)(check_path("folder", folder))
        if student_obs is None:
            return found
        return replace(found, view=given_view(student_obs, found))

    @classmethod
    def _read(cls, folder: Path) -> "Distilled":
        check_run(folder)
        files = verify(folder, edited=(CARD,))
        settings = unstamped(files[CONFIG], folder / CONFIG, older=True)
        for name in _COUNTS & settings.keys():
            as_kind(int, settings[name], name)
        report = _read_report(files[REPORT])
        dataset = Dataset.from_bytes(files[STATES])
        check_shapes(dataset)
        evaluation = report["evaluation"]
        return cls(
            student=Student.from_bytes(files[WEIGHTS]),
            evaluation=Evaluation.from_json(evaluation) if evaluation else None,
            history=_read_csv(files[PROGRESS]),
            queries=_read_queries(report["queries"]),
            settings=settings,
            report=report,
            dataset=dataset,
            view=_stored(settings["student_obs"], dataset.demonstrations.observations[:256]),
        )

    def _metadata(self) -> Mapping[str, str]:
        low, high = self.student.low.tolist(), self.student.high.tolist()
        metadata = {
            "fdtasil.version": self.report["versions"]["fdtasil"],
            "fdtasil.environment": self.report["env"],
            "fdtasil.observation_size": str(self.student.observation_size),
            "fdtasil.action_low": ",".join(f"{value:g}" for value in low),
            "fdtasil.action_high": ",".join(f"{value:g}" for value in high),
            "fdtasil.expert_sha256": self.report["expert"]["sha256"] or "",
        }
        if self.student.spaces is not None:
            metadata[SPACES] = json.dumps(self.student.spaces.to_json())
        if self.steps_seen > 1:
            metadata[HISTORY] = str(self.steps_seen)
        if self.view.columns is not None:
            metadata[COLUMNS] = ",".join(map(str, self.view.columns))
        elif not self.view.is_whole:
            metadata[FUNCTION] = str(self.settings["student_obs"])
        if self.evaluation is not None:
            for name in ("expert_return", "student_return", "normalized_return"):
                value = getattr(self.evaluation, name)
                metadata[f"fdtasil.{name}"] = "" if value is None else f"{value:.6g}"
        return metadata


def write_run(result: Distilled, folder: Path) -> None:
    """Write a result's folder, whose lock the caller has.

    What was trained is saved before anything is tried that may fail: a picture, an export.

    Raises:
        StorageError: If a file can't be written; finished files stay whole.
    """
    report, places = without_infinities(result.report)
    notes = list[str]()
    if places:
        shown = ", ".join(places[:5]) + (f" and {len(places) - 5} more" * (len(places) > 5))
        _note(notes, f"report.json has null for numbers that are not finite: {shown}")
    core = {
        CONFIG: stamped(result.settings),
        PROGRESS: _csv(result.history),
        STATES: result.dataset.to_bytes(),
        WEIGHTS: result.export_bytes(WEIGHTS),
        **_attempted({MODEL: lambda: result.export_bytes(MODEL)}, notes),
        CARD: card_of(result).encode(),
        REPORT: _with_notes(report, notes),
    }
    write_folder(folder, core)
    said = len(notes)
    drawn = {f"figures/{name}.png": _drawing(draw, result) for name, draw in FIGURES.items()}
    extra = _attempted(drawn, notes)
    if len(notes) > said:
        extra[REPORT] = _with_notes(report, notes)
    if extra:
        add_to_folder(folder, extra)


def _drawing(draw: Callable[[Any], bytes | None], result: Distilled) -> Callable[[], bytes | None]:
    return lambda: draw(result)


def _attempted(
    wanted: Mapping[str, Callable[[], bytes | None]], notes: list[str]
) -> dict[str, bytes]:
    """Make files by name; those that can't be made are warned of."""
    made = {}
    for name, make in wanted.items():
        try:
            data = make()
        except Exception as error:  # fonts, latex, a user's matplotlibrc: they raise anything
            _note(notes, f"{name} is left out: {type(error).__name__}: {first_line(error)}")
            continue
        if data is not None:
            made[name] = data
    return made


def _note(notes: list[str], message: str) -> None:
    notes.append(message)
    warn(message)


def _with_notes(report: Mapping[str, Any], notes: list[str]) -> bytes:
    return to_json({**report, "warnings": [*report["warnings"], *notes]})


def _stored(seen: list[int] | str | None, states: np.ndarray) -> View:
    """Return what a student sees, as a file says it: of a function its name alone."""
    if isinstance(seen, str):
        return View(Unseen(seen), None, 0, np.ones(states.shape[1], bool))
    return View.of(seen, states)


def given_view(student_obs: StudentObservation, run: Distilled) -> View:
    """Return what the student of a run sees, where a caller says it too.

    Args:
        student_obs: What the caller says.
        run: The run. Of a function that no file holds, only how many numbers it makes is known.

    Raises:
        SettingError: If the run says otherwise.
    """
    states, seen = run.demonstrations.observations[:256], run.settings["student_obs"]
    n, expected = states.shape[1], run.student.observation_size
    looked = visible(student_obs, n, run.dataset.remembered)
    view, lost = View.of(looked, states), isinstance(run.view.look, Unseen)
    if view.size != expected or not (lost or sees_as(view, run.view, states)):
        then = "pass the function of then, or " if isinstance(seen, str) else ""
        raise SettingError(
            f"student_obs is {describe_view(looked, n)}: {view.size} numbers",
            f"{'the whole observation' if seen is None else seen}: {expected} numbers, as the "
            "student was trained",
            f"{then}leave student_obs= out",
        )
    return view if lost else run.view


_COUNTS = {"observation_size", "past", "remembered"}
_REPORT = {"env": str, "probes": str, "steps": int, "warnings": tuple[str, ...]}
"""Types of what is used of a report later on."""


def _read_report(data: bytes) -> dict[str, Any]:
    report = from_json(data)
    for name, kind in _REPORT.items():
        as_kind(kind, report[name], name)
    as_kind(str, report["versions"]["fdtasil"], "versions.fdtasil")
    as_kind(str | None, report["expert"]["sha256"], "expert.sha256")
    if report["calibration"] is not None:
        Calibration.from_json(report["calibration"])
    return report


def _read_queries(queries: Any) -> dict[str, int]:
    if not isinstance(queries, dict) or not all(type(rows) is int for rows in queries.values()):
        raise TypeError("queries that are no numbers by purpose")
    return queries


def _csv(history: list[dict[str, float]]) -> bytes:
    target = io.StringIO()
    columns = dict.fromkeys(name for entry in history for name in entry)
    writer = csv.DictWriter(target, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    return target.getvalue().encode()


def _read_csv(data: bytes) -> list[dict[str, float]]:
    integers = {"round", "step"}
    return [
        {
            name: int(value) if name in integers else float(value)
            for name, value in row.items()
            if value
        }
        for row in csv.DictReader(io.StringIO(data.decode()))
    ]
