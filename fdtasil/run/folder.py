"""A run's folder while the run goes on: its configuration, its checkpoints, and going on."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fdtasil.errors import SettingError, StorageError, warn
from fdtasil.files.lock import locked
from fdtasil.files.storage import is_written, to_json, verify, write_bytes, write_folder

__all__ = ["CHECKPOINT_SECONDS", "RunFolder", "open_run_folder"]

CHECKPOINT_SECONDS = 20.0
"""Time between two checkpoints inside a stage; when they are taken changes no byte."""

_CONFIG = "config.json"
_CHECKPOINTS = "checkpoints"
_FREE = "max_queries"  # what a run is allowed to ask changes none of its bytes


@contextmanager
def open_run_folder(
    path: Path | None, config: dict[str, Any], *, resume: bool
) -> Iterator["RunFolder"]:
    """Keep a run in a folder that no other process writes inside the block.

    An error that leaves the block says how to go on.

    Args:
        path: The folder, or None to keep nothing.
        config: The run's configuration as plain JSON, with versions.
        resume: Whether the folder holds this run's beginning.

    Raises:
        SettingError: If there is nothing to resume, the folder's run has another configuration
            (other versions and another device are warned of), or a new run would overwrite an
            unfinished one.
        StorageError: If the folder can't be written, or another process writes it.
    """
    folder = RunFolder(path, config)
    if path is None:
        yield folder
        return
    before = _read_config(path) if resume else None
    going_on = f'go on with resume="{path}" (--resume {path})'
    with locked(path):
        if before is not None:
            _check_same(before, config, path, finished=folder.finished)
        elif folder.begun:
            raise SettingError(
                f"{path} holds an unfinished run",
                "an empty folder, or a finished run (which is replaced)",
                f"{going_on}, or remove the folder",
            )
        try:
            yield folder
        except BaseException as error:
            if folder.begun:
                error.add_note(f"what is done is kept: {going_on}")
            raise


class RunFolder:
    """Where a run keeps what it must not lose. Without a path it keeps nothing.

    Checkpoints are folders `checkpoints/<round>/<stage>-<number>/`, each with a manifest as its
    last file: one that has none, or does not verify, never counts.

    Args:
        path: The folder, or None.
        config: The run's configuration as plain JSON, with versions.
    """

    def __init__(self, path: Path | None, config: dict[str, Any]) -> None:
        self._path, self._config = path, config
        self._saved = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether enough would be lost by now to be worth a checkpoint."""
        return self._path is not None and time.monotonic() - self._saved >= CHECKPOINT_SECONDS

    @property
    def begun(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return self._path is not None and any((self._path / _CHECKPOINTS).glob("*/*"))

    @property
    def finished(self) -> bool:
        """Whether the folder holds a finished run."""
        if self._path is None or (self._path / _CHECKPOINTS).exists():
            return False
        return is_written(self._path)

    def save(
        self, round_: int, stage: str, number: int, files: Callable[[], dict[str, bytes]]
    ) -> None:
        """Write a checkpoint, then drop the older ones of its stage.

        `files` is called only where there is a folder: making them copies all data of the run.
        """
        if self._path is None:
            return
        # Not beside the files of a finished run, which stay whole until this one is saved, and
        # not before there is something to go on from.
        config = self._path / _CHECKPOINTS / _CONFIG
        if not config.exists():
            write_bytes(config, to_json(self._config))
        stages = self._path / _CHECKPOINTS / str(round_)
        write_folder(stages / f"{stage}-{number}", files())
        for older in _numbered(stages, stage):
            if older.name != f"{stage}-{number}":
                shutil.rmtree(older, ignore_errors=True)
        self._saved = time.monotonic()

    def load(self, round_: int, stage: str) -> dict[str, bytes] | None:
        """Return the newest whole checkpoint of a stage, or None."""
        if self._path is None:
            return None
        for folder in _numbered(self._path / _CHECKPOINTS / str(round_), stage):
            if not is_written(folder):
                continue  # the run ended while it was written
            try:
                return verify(folder)
            except StorageError as error:
                message = f"{error.found}: an earlier checkpoint is used"
                warn(message)
        return None

    def close(self) -> None:
        """Drop the checkpoints of a run that is saved."""
        if self._path is not None:
            shutil.rmtree(self._path / _CHECKPOINTS, ignore_errors=True)


def _read_config(path: Path) -> dict[str, Any]:
    unfinished, finished = path / _CHECKPOINTS / _CONFIG, path / _CONFIG
    try:
        return json.loads((unfinished if unfinished.exists() else finished).read_bytes())
    except (OSError, ValueError) as error:
        raise SettingError(
            f"{path} holds no run to resume ({type(error).__name__})",
            f"a folder with a {_CONFIG}",
            "check the path, or start the run with out= (--out)",
        ) from error


def _check_same(
    before: dict[str, Any], now: dict[str, Any], path: Path, *, finished: bool
) -> None:
    changed = _differences({**before, _FREE: None}, {**now, _FREE: None})
    surroundings = [change for change in changed if change.startswith(("versions.", "device "))]
    settings = [change for change in changed if change not in surroundings]
    if settings:
        shown = "; ".join(settings[:8]) + (f"; and {len(settings) - 8} more" * (len(settings) > 8))
        raise SettingError(
            f"{path} was begun with another configuration: {shown}",
            "the same arguments as at the beginning",
            "repeat them, or start anew in another folder",
        )
    if surroundings and not finished:
        found = "; ".join(surroundings)
        message = f"resumed with other versions or on another device, so bytes may differ: {found}"
        warn(message)


def _differences(before: Any, now: Any, name: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        return [
            change
            for key in sorted({*before, *now})
            for change in _differences(
                before.get(key), now.get(key), f"{name}.{key}" if name else key
            )
        ]
    return [] if before == now else [f"{name} was {before!r}, is {now!r}"]


def _numbered(stages: Path, stage: str) -> list[Path]:
    """Return the folders of a stage, the newest first."""
    found = [folder for folder in stages.glob(f"{stage}-*") if folder.name[-1].isdigit()]
    return sorted(found, key=lambda folder: -int(folder.name.rpartition("-")[2]))
