"""Labelled states with their probes, on disk and apart from the run that made them."""

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdtasil.checks import check_path
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError, StorageError, shown, warn
from fdtasil.files.arrays import arrays_from_bytes
from fdtasil.files.border import reads
from fdtasil.files.plain import as_kind
from fdtasil.files.reading import from_json, read_plain
from fdtasil.files.run_format import STATES, check_finished
from fdtasil.files.storage import is_written, verify
from fdtasil.probes.answers import Answers
from fdtasil.probes.source import Probes
from fdtasil.probes.spread import Spread
from fdtasil.rollouts.history import past_size
from fdtasil.rollouts.spaces import Spaces

__all__ = [
    "Dataset",
    "DatasetLike",
    "check_dataset",
    "check_shapes",
    "form_of",
    "in_form",
    "load_dataset",
    "warn_of_bounds",
    "warn_of_cut_actions",
]

_VERSION = 2


@dataclass(frozen=True, repr=False)
class Dataset:
    """Everything that a student can be trained from without one new query.

    Attributes:
        demonstrations: The labelled states.
        probes: The source of `answers`, or None.
        answers: The expert's answers around each state, or None.
        low: (m,) lower action bounds; -inf where there is none.
        high: (m,) upper action bounds.
        environment: What the environment is called.
        spaces: Of the environment, where they are no plain boxes.
        history: How many observations the student sees; behind the environment's own stand those
            before it, with the actions then.
        remembered: Length of what the expert remembered there, which stands last.
        spread: How far coordinates were said to go that hardly move in the states; the answers
            are of probes that go so far, and a student's normaliser divides by it.
    """

    demonstrations: Demonstrations
    probes: Probes | None
    answers: Answers | None
    low: np.ndarray
    high: np.ndarray
    environment: str
    spaces: Spaces | None = None
    history: int = 1
    remembered: int = 0
    spread: Spread = field(default_factory=lambda: Spread({}))

    def __repr__(self) -> str:
        """Return a line, not the arrays."""
        (n, m), states = self.sizes, self.demonstrations
        return (
            f"Dataset({self.environment}: {len(states):,} states of {states.episodes} episodes, "
            f"{n} observations, {m} actions, probes "
            f"{self.probes.describe() if self.probes else 'none'})"
        )

    @property
    def sizes(self) -> tuple[int, int]:
        """(n, m), the lengths of an observation and of an action."""
        states = self.demonstrations
        return states.observations.shape[1], states.actions.shape[1]

    @property
    def choices(self) -> tuple[tuple[int, int], ...]:
        """First score of each choice, and the one after its last."""
        return self.spaces.actions.choices if self.spaces else ()

    @property
    def own_size(self) -> int:
        """Length of the environment's own observation, which past and memory stand behind."""
        n, m = self.sizes
        return (n - self.remembered - (self.history - 1) * m) // self.history

    def around(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where some states were moved to by their first probe, and what was said there.

        Args:
            chosen: (S,) numbers of the states.

        Returns:
            (S, n) and (S, m); both are empty where nothing was asked, or the answers are
            derivatives.
        """
        probes, answers, states = self.probes, self.answers, self.demonstrations
        if answers is None or probes is None or probes.stencil is None or probes.exact:
            return states.observations[:0], states.actions[:0]
        steps = answers.displacements[answers.numbers[chosen, 0]]
        points = states.observations[chosen] + probes.stencil.offsets[0] * steps
        return points.astype(np.float32), answers.values[chosen, 0, 0]

    def to_bytes(self) -> bytes:
        """Return the dataset as an npz file.

        Schema, version 2, all little-endian and without pickles: `observations` (N, n) float32,
        `actions` (N, m) float32 (the expert's), `episode` (N,) and `round` (N,) int32, `taken`
        (N, m) float32, `rewards` (N,) float64 and `terminated` (N,) bool as in `Demonstrations`,
        `low` and `high` (m,) float32; with probes also `displacements` (P, n) float32, `numbers`
        (N, k) int32, `values` (N, k, p, m) float32 and `gains` (P,) float64 as in `Answers` (one
        `gain` () in version 1); and
        `about`, JSON text as bytes: version, environment, probes, and where they are not the
        usual ones spaces, history, remembered and spread.
        """
        arrays: dict[str, Any] = dict(vars(self.demonstrations))
        arrays |= {"low": self.low, "high": self.high}
        if self.answers is not None:
            arrays |= vars(self.answers)
        about: dict[str, Any] = {
            "version": _VERSION,
            "environment": self.environment,
            "probes": self.probes.describe() if self.probes else "none",
            **form_of(self),
        }
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
        target = io.BytesIO()
        np.savez(target, **arrays)
        return target.getvalue()

    @staticmethod
    @reads(
        "demonstrations",
        "a demonstrations.npz written by fdtasil",
        "check the path, or save again; of arrays: fdtasil.from_arrays(observations, actions)",
    )
    def from_bytes(data: bytes) -> "Dataset":
        """Read what `to_bytes` wrote; nothing is unpickled.

        Raises:
            StorageError: If it is not such a file, or of a later version.
        """
        return _read(arrays_from_bytes(data))


def form_of(dataset: Dataset) -> dict[str, Any]:
    """Return what the numbers of a dataset are, as JSON values, where it is not the usual."""
    form: dict[str, Any] = {}
    if dataset.spaces is not None:
        form["spaces"] = dataset.spaces.to_json()
    if dataset.history > 1 or dataset.remembered:
        form |= {"history": dataset.history, "remembered": dataset.remembered}
    if (spread := dataset.spread.to_json()) is not None:
        form["spread"] = spread
    return form


def in_form(dataset: Dataset, form: Mapping[str, Any]) -> Dataset:
    """Return a dataset whose numbers are what `form_of` said.

    Raises:
        KeyError, TypeError, ValueError: If they can't be, or it has not said that.
    """
    spaces = Spaces.from_json(form["spaces"]) if "spaces" in form else None
    history, remembered = (
        as_kind(int, form.get(name, usual), name)
        for name, usual in (("history", 1), ("remembered", 0))
    )
    n, m = dataset.sizes
    spread = Spread.from_json(form.get("spread"), n)
    about = {"spaces": spaces, "history": history, "remembered": remembered, "spread": spread}
    found = replace(dataset, **about)
    good = history >= 1 and remembered >= 0 and found.own_size >= 1
    if not good or n != found.own_size + past_size(history, found.own_size, m) + remembered:
        raise ValueError(f"{n} observations with history {history} and memory {remembered}")
    if spaces and spaces.actions.size != m:
        raise ValueError("actions of another size than their space")
    return found


DatasetLike = Dataset | str | Path


def load_dataset(source: DatasetLike) -> Dataset:
    """Open demonstrations: a `Dataset`, a run folder, or its demonstrations.npz.

    Raises:
        StorageError: If there are none.
        SettingError: If they are empty, of shapes that do not go together, or not finite.
    """
    if isinstance(source, Dataset):
        return check_dataset(source)
    if not isinstance(source, str | os.PathLike):
        raise SettingError(
            f"dataset is a {type(source).__name__}",
            "a Dataset, a run folder, or its demonstrations.npz",
            "of arrays: fdtasil.from_arrays(observations, actions, episode_ends=...)",
        )
    path = check_path("dataset", source)
    file = path / STATES if path.is_dir() else path
    check_finished(path)
    try:
        if path.is_dir() and is_written(path):
            data = verify(path, [file.name])[file.name]
        else:
            data = read_plain(file)
        return check_dataset(Dataset.from_bytes(data))
    except OSError as error:
        if isinstance(error, StorageError):
            error.add_note(f"read from {file}")
            raise
        raise StorageError(
            f"{file} can't be read: {error.strerror}",
            "a run folder, or its demonstrations.npz",
            "check the path",
        ) from error


def check_dataset(dataset: Dataset) -> Dataset:
    """Return a dataset that a student can be trained from: one NaN in it makes all weights NaN.

    Raises:
        SettingError: If it is empty, of shapes that do not go together, or not finite.
    """
    arrays = check_shapes(dataset)
    _check_bounds(dataset.low, dataset.high)
    for name in (
        "observations",
        "actions",
        "taken",
        "displacements",
        "values",
        "gains",
        "rewards",
    ):
        if name in arrays and not np.isfinite(arrays[name]).all():
            bad = np.flatnonzero([not np.isfinite(row).all() for row in arrays[name]])
            raise SettingError(
                f"demonstrations whose {name} are not finite in {len(bad)} of "
                f"{len(arrays[name])} rows, the first of them row {bad[0]}",
                "finite numbers",
                "drop these rows, and find out what made them",
            )
    return dataset


def warn_of_bounds(dataset: Dataset) -> None:
    """Warn of recorded actions that no student reaches."""
    actions = dataset.demonstrations.actions
    ends = [np.where(np.isfinite(end), np.abs(end), 0.0) for end in (dataset.low, dataset.high)]
    beyond = np.maximum(actions - dataset.high, dataset.low - actions)
    outside = int((beyond > _ROUNDED * np.maximum(*ends)).any(axis=1).sum())
    if outside:
        warn(
            f"{outside:,} of {len(actions):,} actions lie beyond low and high, by up to "
            f"{beyond.max():.2g}: a student stays within them; check that they are the bounds of "
            "the environment that the actions are for"
        )


def warn_of_cut_actions(dataset: Dataset) -> None:
    """Warn of actions without bounds that were cut off at some: a student would go beyond."""
    states, free = dataset.demonstrations, ~np.isfinite(dataset.low) & ~np.isfinite(dataset.high)
    if not (free & _often_at_its_ends(states.actions)).any():
        return
    # Where every episode is the same, each action is met again in all of them.
    _, one_each = np.unique(states.observations, axis=0, return_index=True)
    actions = states.actions[one_each]
    cut = free & _often_at_its_ends(actions)
    for j in np.flatnonzero(cut)[:1]:
        warn(
            f"{int(cut.sum())} of {len(cut)} actions have no bounds, and seem to be cut off "
            f"(action {j} at {actions[:, j].min():g} and {actions[:, j].max():g}): a student goes "
            "beyond; pass low= and high= to from_arrays, or the environment to distill"
        )


def _often_at_its_ends(actions: np.ndarray) -> np.ndarray:
    """Return (m,) whether each action meets both its ends again and again, and is between them."""
    met = [(actions == end).sum(axis=0) for end in (actions.min(axis=0), actions.max(axis=0))]
    between = len(actions) - sum(met)  # few of them: choices, or a switch
    return np.minimum(np.minimum(*met), between) >= max(_MET, _MET_SHARE * len(actions))


_MET, _MET_SHARE = 3, 0.01  # times, and of the states, that the end of a cut action is met

_ROUNDED = 1e-5  # of an action's larger bound: what float32 and files round


def check_shapes(dataset: Dataset) -> dict[str, np.ndarray]:
    """Return the arrays of a dataset by name, which go together.

    Raises:
        SettingError: If it is empty, or of types or shapes that do not.
    """
    states, answers = dataset.demonstrations, dataset.answers
    arrays = dict(vars(states)) | {"low": dataset.low, "high": dataset.high}
    shapes = {"observations": "Nn", "actions": "Nm", "taken": "Nm", "low": "m", "high": "m"}
    shapes |= dict.fromkeys(("episode", "round", "rewards", "terminated"), "N")
    if answers is not None:
        arrays |= vars(answers)
        shapes |= {"displacements": "Pn", "numbers": "Nk", "values": "Nkpm", "gains": "P"}
    sizes: dict[str, int] = {}
    for name in shapes:
        _check_kind(name, arrays[name])
    for name, letters in shapes.items():
        shape = arrays[name].shape
        agrees = len(shape) == len(letters) and all(
            sizes.setdefault(letter, size) == size
            for letter, size in zip(letters, shape, strict=True)
        )
        if not agrees or sizes["N"] == 0:
            expected = ", ".join(f"{letter}={sizes.get(letter, 'any')}" for letter in letters)
            raise SettingError(
                f"demonstrations whose {name} have the shape {shape}",
                f"({', '.join(letters)}) with {expected}, and N at least 1",
                "record at least one episode, one row of each array for each state",
            )
    if answers is not None:
        _check_numbers(answers)
    return arrays


def _check_kind(name: str, array: object) -> None:
    """Refuse what numpy would turn into numbers that were never meant."""
    good = isinstance(array, np.ndarray) and array.dtype.kind in "biuf"
    if good and not np.ma.is_masked(array):
        return
    what = f"an array of {array.dtype}" if isinstance(array, np.ndarray) else type(array).__name__
    raise SettingError(
        f"demonstrations whose {name} are {'masked' if good else what}",
        "a numpy array of plain numbers",
        f"drop the masked rows, or write numpy.asarray({name}, numpy.float32)",
    )


def _check_bounds(low: np.ndarray, high: np.ndarray) -> None:
    if (low < high).all():
        return
    first = int((~(low < high)).argmax())
    raise SettingError(
        f"demonstrations whose action {first} has the bounds {low[first]:g} to {high[first]:g}",
        "lower bounds below upper bounds; -inf and inf where there is none",
        "take low and high from the environment's action_space",
    )


def _check_numbers(answers: Answers) -> None:
    numbers, rows = answers.numbers, len(answers.displacements)
    if numbers.size and not (numbers.min() >= 0 and numbers.max() < rows):
        raise SettingError(
            f"answers along the displacements {numbers.min()} to {numbers.max()}, of {rows}",
            f"numbers from 0 to {rows - 1}",
            "save the demonstrations again, with all displacements",
        )


_KINDS: dict[str, Any] = {
    **dict.fromkeys(("observations", "actions", "taken", "low", "high"), np.float32),
    **dict.fromkeys(("displacements", "values"), np.float32),
    **dict.fromkeys(("episode", "round", "numbers"), np.int32),
    **dict.fromkeys(("rewards", "gain", "gains"), np.float64),
    "terminated": np.bool_,
}
"""Types of the arrays, by name; those of others are turned into these where nothing is lost."""


def _as_kind(name: str, array: np.ndarray) -> np.ndarray:
    kind = np.dtype(_KINDS[name])
    flags = kind == np.bool_ and array.dtype.kind in "iu" and ((array == 0) | (array == 1)).all()
    if not flags and not np.can_cast(array.dtype, kind, "same_kind"):
        raise ValueError(f"{name} of the type {array.dtype}")
    if kind.kind == "i" and array.size:
        room = np.iinfo(kind)
        if int(array.min()) < room.min or int(array.max()) > room.max:
            raise ValueError(f"{name} beyond {kind}")
    with np.errstate(over="ignore"):  # infinite then, which is refused as such
        # Ours keep the order of their axes in memory, which is written again.
        return np.asarray(array, kind, order="K" if array.dtype == kind else "C")


def _read(arrays: Mapping[str, np.ndarray]) -> Dataset:
    if "about" not in arrays:
        raise StorageError(
            f"an npz file that fdtasil did not write, with {shown(', '.join(arrays))}",
            "a demonstrations.npz of a run",
            "of arrays: fdtasil.from_arrays(observations, actions, episode_ends=...)",
        )
    about = from_json(arrays["about"].tobytes())
    if about["version"] > _VERSION:
        raise ValueError(f"version {about['version']} is newer than this fdtasil")
    spec, environment = about["probes"], about["environment"]
    if not isinstance(spec, str) or not isinstance(environment, str):
        raise TypeError("texts in about that are none")
    typed = {name: _as_kind(name, array) for name, array in arrays.items() if name in _KINDS}
    demonstrations = Demonstrations(*(typed[field.name] for field in fields(Demonstrations)))
    answers = None
    if "values" in typed:
        bank, numbers, values = (typed[name] for name in ("displacements", "numbers", "values"))
        gains = typed["gains"] if "gains" in typed else np.full(len(bank), typed["gain"])
        if not ((gains > 0) & (gains < np.inf)).all():
            raise ValueError("gains that are not positive numbers")
        answers = Answers(bank, numbers, values, gains)
    bounds = typed["low"], typed["high"]
    found = Dataset(demonstrations, _probes(spec, answers), answers, *bounds, environment)
    return in_form(found, about)


def _probes(spec: str, answers: Answers | None) -> Probes | None:
    """Read the source that answers are of; there is one where there are answers."""
    probes = Probes.parse(spec)
    if (probes is None) != (answers is None):
        raise ValueError(f"probes {spec!r} {'without' if answers is None else 'with'} answers")
    if probes is not None and answers is not None and answers.values.ndim == 4:
        stencil, points = probes.stencil, answers.values.shape[2]
        if stencil is not None and not stencil.exact and points != len(stencil.offsets):
            raise ValueError(f"{points} answers along each probe of {spec!r}")
    return probes
