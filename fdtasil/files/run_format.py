"""What makes a folder a run's: a format number and a maker in its configuration."""

import os
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdtasil.errors import StorageError, shown, warn
from fdtasil.files.lock import was_locked
from fdtasil.files.names import check_no_links, inside
from fdtasil.files.reading import from_json, read_plain
from fdtasil.files.storage import COMING, LOCK, MANIFEST, is_written, to_json

__all__ = [
    "CARD",
    "CHECKPOINTS",
    "COMMAND",
    "CONFIG",
    "FREE",
    "MODEL",
    "PROGRESS",
    "REPORT",
    "STATES",
    "WEIGHTS",
    "begun_over",
    "check_finished",
    "check_free",
    "check_run",
    "stamped",
    "unstamped",
]

FORMAT = 1
"""Number of the files' layout: one more whenever older files can't be read any longer."""
CONFIG, CHECKPOINTS, COMMAND = "config.json", "checkpoints", "command.json"
WEIGHTS, MODEL = "student.safetensors", "student.onnx"
STATES, PROGRESS, REPORT = "demonstrations.npz", "progress.csv", "report.json"
CARD = "README.md"
"""What people complete by hand: a licence, whom to ask."""
_STAMP = {"format": FORMAT, "made_by": "fdtasil"}
_OURS_LIMIT = 2**24
FREE = ("max_queries", "reason", "made", "opened", "force")
"""Parts of a configuration that may be others when a run goes on: what it may ask changes none of
its bytes, nor does a gate; words say what a fingerprint, and the expert's own answers, tell."""
_SURROUNDINGS = ("versions", "device", "expert")  # which may be others too, with a warning
_UNFINISHED_FILE = re.compile(r"\.[\w.]+\.\d+\.[0-9a-f]{8}\.tmp", re.ASCII)


def stamped(values: Mapping[str, Any]) -> bytes:
    """Return JSON that says which format it has, and who made it."""
    return to_json({**_STAMP, **values})


def unstamped(data: bytes, source: object, *, older: bool = False) -> dict[str, Any]:
    """Return what `stamped` was given.

    Args:
        data: The JSON.
        source: Where it was, for the error.
        older: Whether it may be from the time before there was a format number.

    Raises:
        ValueError: If it is no JSON object.
        StorageError: If it is of another format.
    """
    values = from_json(data)
    if not isinstance(values, dict):
        raise ValueError("no JSON object")
    number = values.get("format")
    known = type(number) is int and number == FORMAT
    if not known and not (older and number is None):
        raise _another_format(number, values, source)
    return {name: value for name, value in values.items() if name not in _STAMP}


def _another_format(number: object, values: Mapping[str, Any], source: object) -> StorageError:
    versions = values.get("versions")
    writer = versions.get("fdtasil") if isinstance(versions, dict) else None
    by = f"fdtasil {shown(writer)}" if writer else "another fdtasil"
    newer = isinstance(number, int) and number > FORMAT
    return StorageError(
        f"{source} was written by {'a newer' if newer else 'an older'} fdtasil: "
        f"{'no format number' if number is None else f'format {shown(number)}'}",
        f"format {FORMAT}",
        f"go on with {by}, which wrote it, or start anew in another folder",
    )


def check_run(folder: Path) -> None:
    """Refuse what is no folder of a finished run, before any of it is read.

    Raises:
        StorageError: If it is another thing.
    """
    if not folder.is_dir():
        raise StorageError(
            f"{folder} is a file" if folder.exists() else f"there is no folder {folder}",
            "the folder of a finished run, from save() or out= (--out)",
            "check the path",
        )
    check_finished(folder)


def check_finished(folder: Path) -> None:
    """Refuse the folder of a run that has not ended; warn of one in the place of a finished run.

    Raises:
        StorageError: If it is one.
    """
    if is_written(folder):
        if begun_over(folder):
            warn(
                f"{folder} holds a finished run, and another one that has not ended and will "
                "replace it: the finished one is read"
            )
        return
    if not (folder / CHECKPOINTS).is_dir():
        return
    again = f"fdtasil distill --resume {shlex.quote(str(folder))}"
    raise StorageError(
        f"{folder} holds a run that has not ended",
        "a finished run",
        f'go on with it: resume="{folder}" and else the same ({again})',
    )


def begun_over(folder: Path) -> bool:
    """Whether another run has begun in the folder of a finished one.

    What is left of checkpoints may be the finished one's own.
    """
    now, left = (_what_it_is(folder, name) for name in (CONFIG, f"{CHECKPOINTS}/{CONFIG}"))
    return None not in (now, left) and now != left


def _what_it_is(folder: Path, name: str) -> dict[str, Any] | None:
    """Return a configuration without what may be another when a run goes on, or None."""
    values = _values(folder, name)
    return values and {k: v for k, v in values.items() if k not in (*FREE, *_SURROUNDINGS)}


def _values(folder: Path, name: str) -> dict[str, Any] | None:
    try:
        values = from_json(read_plain(inside(folder, name), _OURS_LIMIT, follow=False))
    except (OSError, ValueError):
        return None
    return values if isinstance(values, dict) else None


def check_free(folder: Path) -> None:
    """Refuse a folder that is neither missing, nor empty, nor a run's: it is somebody's own.

    A run's is known by what is in its files, never by their names alone. What a killed process
    has left of a run that had not begun yet counts as empty.

    Raises:
        StorageError: If something else is there, or a link.
    """
    try:
        names = set(os.listdir(folder))
    except OSError:
        return  # missing, or no folder: whoever writes it says so
    check_no_links(folder)
    foreign = names - {LOCK} - {name for name in names if _is_left_over(folder, name)}
    if not foreign:
        return
    if CHECKPOINTS in foreign and not _is_ours(folder, f"{CHECKPOINTS}/{CONFIG}"):
        raise _not_free(folder, f"{CHECKPOINTS}/ that is no run's")
    known = (CONFIG, f"{CHECKPOINTS}/{CONFIG}", f"{COMING}/{CONFIG}", COMMAND)
    if not any(_is_ours(folder, name) for name in known):
        raise _not_free(folder, shown(", ".join(sorted(foreign)[:5])))


def _is_ours(folder: Path, name: str) -> bool:
    values = _values(folder, name)
    if values is None:
        return False
    return values.get("made_by") == _STAMP["made_by"] or _is_of_the_time_before(values)


def _is_of_the_time_before(values: dict[str, Any]) -> bool:
    """Whether a finished run has no format number yet: it may be replaced all the same."""
    versions = values.get("versions")
    fields = {"expert_sha256", "fit", "env", "seed"} <= values.keys()
    return fields and isinstance(versions, dict) and "fdtasil" in versions


def _is_left_over(folder: Path, name: str) -> bool:
    """Whether a killed process has left this of a write that never counted."""
    path = folder / name
    if path.is_file():
        return bool(_UNFINISHED_FILE.fullmatch(name))
    if name not in (COMING, CHECKPOINTS) or not was_locked(folder):
        return False
    left = [Path(place, file) for place, _, files in os.walk(path) for file in files]
    return not (path / MANIFEST).exists() and all(
        _UNFINISHED_FILE.fullmatch(file.name) for file in left
    )


def _not_free(folder: Path, found: str) -> StorageError:
    free = next(
        path
        for path in (folder / f"run{number}" for number in ("", *range(2, 10**6)))
        if not path.exists()
    )
    return StorageError(
        f"{folder} holds {found}",
        "a folder that is missing, empty, or a run's: others are not written into",
        f'choose another, for example out="{free}" (--out {free})',
    )
