"""A run's folder while the run goes on: its configuration, its checkpoints, and going on."""

import os
import re
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fdtasil.errors import FdtasilError, SettingError, StorageError, warn
from fdtasil.files.lock import locked
from fdtasil.files.names import check_no_links, inside
from fdtasil.files.reading import read_plain
from fdtasil.files.run_format import (
    CHECKPOINTS,
    CONFIG,
    FREE,
    begun_over,
    check_free,
    stamped,
    unstamped,
)
from fdtasil.files.storage import (
    explain,
    is_written,
    remove_folder,
    remove_if_empty,
    verify,
    write_bytes,
    write_folder,
)
from fdtasil.rollouts.trials import other_environment

__all__ = ["CHECKPOINT_SECONDS", "KEPT", "RunFolder", "open_run_folder"]

CHECKPOINT_SECONDS = 20.0
"""Time between two checkpoints inside a stage; when they are taken changes no byte."""

KEPT = "what is done is kept"
"""How the note begins that says how to go on."""
_CONFIG_LIMIT = 2**24
_FINGERPRINT = "fingerprint"


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
        StorageError: If the folder can't be written, another process writes it, it is no run's,
            or of another format.
    """
    folder = RunFolder(path, config)
    if path is None:
        yield folder
        return
    if resume:
        check_no_links(path)
    else:
        check_free(path)
    before = _read_config(path) if resume else None
    flag = f"--resume {shlex.quote(str(path))}"
    going_on = f'go on with resume="{path}" in the place of out=, else the same ({flag})'
    with locked(path):
        if before is not None:
            _check_same(before, config, path, finished=folder.finished)
        elif folder.begun:
            _read_config(path)  # of another format, it can't be gone on with
            raise SettingError(
                f"{path} holds a run that has not ended",
                "an empty folder, or a finished run (which is replaced)",
                f"{going_on}, or choose another folder",
            )
        elif folder.finished:
            told = f"{path} holds a finished run, which this one replaces when it ends"
            warn(told, of_result=False)
        try:
            yield folder
        except BaseException as error:
            if folder.begun:
                error.add_note(f"{KEPT}: {going_on}")
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
        if self._path is None:
            return False
        try:
            return any((self._path / CHECKPOINTS).glob("*/*"))
        except OSError as error:  # such as too many open files
            raise explain(error, self._path, "a folder that can be read") from error

    @property
    def finished(self) -> bool:
        """Whether the folder holds a finished run."""
        if self._path is None or self.begun or not is_written(self._path):
            return False
        return not begun_over(self._path)

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
        config = inside(self._path, f"{CHECKPOINTS}/{CONFIG}")
        if not config.exists():
            try:
                write_bytes(config, stamped(self._config))
            except BaseException:
                remove_if_empty(config.parent)  # without it nobody could tell whose it is
                raise
        name = f"{CHECKPOINTS}/{round_}/{stage}-{number}"
        write_folder(inside(self._path, name), files())
        for older in _numbered(self._path, round_, stage):
            if older.name != f"{stage}-{number}":
                _drop(older)
        self._saved = time.monotonic()

    def load(self, round_: int, stage: str) -> dict[str, bytes] | None:
        """Return the newest whole checkpoint of a stage, or None."""
        if self._path is None:
            return None
        for folder in _numbered(self._path, round_, stage):
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
        if self._path is None:
            return
        checkpoints = inside(self._path, CHECKPOINTS)
        for round_ in sorted(checkpoints.glob("*/")):
            _drop(round_)  # first: without their configuration they would be nobody's
        _drop(checkpoints)


def _drop(folder: Path) -> None:
    with suppress(StorageError):  # it is of no use any more, and does no harm
        remove_folder(folder)


def asked_anew(path: Path) -> bool | None:
    """Return whether the run that was begun in a folder asks anew; None if that can't be read."""
    try:
        probes = _read_config(path)["probes"]
    except (FdtasilError, KeyError):
        return None  # which is said when the folder is opened
    return isinstance(probes, str) and "resample" in probes.split(",")


def _read_config(path: Path) -> dict[str, Any]:
    """Return the configuration of the run in a folder, the unfinished one if there are two."""
    unfinished = inside(path, f"{CHECKPOINTS}/{CONFIG}")
    config = unfinished if os.path.exists(unfinished) else inside(path, CONFIG)
    try:
        return unstamped(
            read_plain(config, _CONFIG_LIMIT, follow=False),
            config,
            older=not os.path.exists(path / CHECKPOINTS),
        )
    except StorageError:
        raise
    except (OSError, ValueError) as error:
        raise SettingError(
            f"{path} holds no run to resume ({type(error).__name__})",
            f"a folder with a {CONFIG}",
            "check the path; where the run ended before anything was kept, start it again with "
            "out= (--out)",
        ) from error


def _check_same(
    before: dict[str, Any], now: dict[str, Any], path: Path, *, finished: bool
) -> None:
    left_out: dict[str, None] = dict.fromkeys((*FREE, _FINGERPRINT))
    if before.get("expert_sha256") is not None and before["expert_sha256"] == now["expert_sha256"]:
        left_out["expert"] = None  # the same file, wherever it lies now
    changed = _differences({**before, **left_out}, {**now, **left_out})
    surroundings = [change for change in changed if change.startswith(("versions.", "device "))]
    settings = [change for change in changed if change not in surroundings]
    other = other_environment(before.get(_FINGERPRINT), now.get(_FINGERPRINT))
    # Another version of a simulator may well compute something else.
    (surroundings if any("versions." in one for one in surroundings) else settings).extend(
        f"env: {one}" for one in other
    )
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
    return [] if before == now else [f"{name} was {_short(before)}, is {_short(now)}"]


def _short(value: Any) -> str:
    """Return a value as a message shows it: of a sha256 the beginning."""
    is_hash = isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value)
    return f"{value[:12]}..." if is_hash else repr(value)


def _numbered(path: Path, round_: int, stage: str) -> list[Path]:
    """Return the folders of a stage, the newest first."""
    place, name = inside(path, f"{CHECKPOINTS}/{round_}"), re.compile(rf"{stage}-([0-9]{{1,18}})")
    found = [(name.fullmatch(folder.name), folder.name) for folder in place.glob(f"{stage}-*")]
    numbers = [(int(match[1]), text) for match, text in found if match]
    return [inside(place, text) for _, text in sorted(numbers, reverse=True)]
