"""Files that are either whole or not there: unique temporary name, flush, rename, manifest.

A folder changes as one: its new files are made in a hidden folder inside it, whose manifest, the
last of them, makes them count; then they are moved into place. Whoever reads a folder whose move
was cut short finds the new files where they are.
"""

import contextlib
import errno
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from fdtasil.errors import StorageError

__all__ = [
    "explain",
    "is_written",
    "sha256",
    "stays_inside",
    "to_json",
    "verify",
    "write_bytes",
    "write_folder",
]

MANIFEST = "manifest.json"
_COMING = ".coming"


def sha256(data: bytes) -> str:
    """Return the hexadecimal sha256 of `data`."""
    return hashlib.sha256(data).hexdigest()


def to_json(value: Any) -> bytes:
    """Return `value` as indented JSON, refusing the NaN and infinity that JSON does not have."""
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def write_bytes(path: Path, data: bytes) -> None:
    """Write a whole file or nothing.

    Raises:
        StorageError: If the disk is full, the folder is read-only, or anything else of the kind;
            whatever stood at `path` is then still there, whole.
    """
    _write(path, data)
    _flush_names(path.parent)


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files and a manifest with their sha256: all of them, or none.

    Args:
        folder: Where; made if it is not there. Files that an earlier call wrote and this one does
            not are removed at the end; other files in it stay.
        files: Content by name relative to `folder`.

    Raises:
        StorageError: As `write_bytes`; the folder then reads as before, or as after where all was
            written and only the move failed.
    """
    coming = folder / _COMING
    _move_in(folder)
    old = _written_by_us(folder)
    try:
        if coming.exists():
            shutil.rmtree(coming)
    except OSError as error:
        raise explain(error, coming, "a folder that can be removed") from error
    for name, data in files.items():
        _write(coming / name, data)
    for inner in {(coming / name).parent for name in files}:
        _flush_names(inner)
    manifest = {name: sha256(data) for name, data in sorted(files.items())}
    write_bytes(coming / MANIFEST, to_json(manifest))
    _move_in(folder)
    for name in old - files.keys():
        with contextlib.suppress(OSError):  # what is new is whole, and that is what counts
            (folder / name).unlink()


def _written_by_us(folder: Path) -> set[str]:
    """Return the files that an earlier call wrote and nobody has changed; none if in doubt."""
    try:
        return set(verify(folder))
    except StorageError:
        return set()


def verify(folder: Path, names: Collection[str] | None = None) -> dict[str, bytes]:
    """Read the files of a folder that `write_folder` made, checking each against the manifest.

    Args:
        folder: Where.
        names: Which files; None for all of them.

    Returns:
        Content by name.

    Raises:
        StorageError: If the manifest or a file is missing, or a file is not the one written.
    """
    try:
        listed = _path_of(folder, MANIFEST).read_bytes()
        manifest = json.loads(listed)
        # Nothing but what we write: a manifest that was changed must not pass for a shorter one.
        if to_json(manifest) != listed or not isinstance(manifest, dict):
            raise ValueError(f"{MANIFEST} changed after writing")
        if not all(map(stays_inside, manifest)):
            raise ValueError(f"{MANIFEST} names a file outside of the folder")
        wanted = manifest if names is None else names
        if missing := set(wanted) - manifest.keys():
            raise ValueError(f"{MANIFEST} does not name {', '.join(sorted(missing))}")
        files = {name: _path_of(folder, name).read_bytes() for name in wanted}
    except (OSError, ValueError) as error:
        raise StorageError(
            f"{folder}: {error}", "a folder written by save()", "check the path, or save again"
        ) from error
    changed = [name for name, data in files.items() if sha256(data) != manifest[name]]
    if changed:
        raise StorageError(
            f"{folder}: {', '.join(changed)} changed after writing",
            f"the sha256 recorded in {MANIFEST}",
            "restore the files from a copy, or run distill again",
        )
    return files


def is_written(folder: Path) -> bool:
    """Return whether a folder has a manifest: everything else was there before it."""
    return _path_of(folder, MANIFEST).exists()


def stays_inside(name: str) -> bool:
    r"""Whether a name is readable and stays in the folder that it is relative to, on any system.

    Example:
        >>> [stays_inside(name) for name in ("a/b.weights", "../b", "/b", "a\0b", "c:b")]
        [True, False, False, False, False]
    """
    path = PurePosixPath(name)
    clean = name.isprintable() and not set("\\:") & set(name)
    return bool(path.parts) and clean and not path.is_absolute() and ".." not in path.parts


def _write(path: Path, data: bytes) -> None:
    """Write a file of which a power failure may still lose the name."""
    # A name of its own for every write: two processes that share one lose files to each other.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise explain(error, path, f"room and permission for {len(data):,} bytes") from error


def _path_of(folder: Path, name: str) -> Path:
    """Return where a file of a folder is, which is not yet in place if a move was cut short."""
    coming = folder / _COMING
    early = coming / name
    # Without its manifest, what is coming does not count; the manifest is the last to be moved.
    return early if (coming / MANIFEST).exists() and early.exists() else folder / name


def _move_in(folder: Path) -> None:
    """Move the files that are coming into place, if they are all there."""
    coming = folder / _COMING
    try:
        names = json.loads((coming / MANIFEST).read_bytes())
    except (OSError, ValueError):
        return
    try:
        for name in [*names, MANIFEST]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if (coming / name).exists():
                (coming / name).replace(folder / name)
        _flush_names(folder)
        shutil.rmtree(coming)
    except OSError as error:
        raise explain(error, folder, "permission to move files") from error


def _flush_names(folder: Path) -> None:
    """Make the renames in a folder outlast a power failure."""
    if os.name != "posix":
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise explain(error, folder, "a disk that takes what is written") from error


def explain(error: OSError, path: Path, expected: str) -> StorageError:
    """Return the error of storage that a failed system call amounts to."""
    next_steps = {
        errno.ENOSPC: "free some space and run again; what was there before is whole",
        errno.EDQUOT: "free some space and run again; what was there before is whole",
        errno.EROFS: "choose a folder on a writable file system",
        errno.EACCES: "choose a folder that you may write to",
        errno.ENAMETOOLONG: "choose a shorter name",
        errno.ENOTDIR: "choose a path that does not lead through a file",
        errno.EEXIST: "choose a folder, not a file",
    }
    return StorageError(
        f"can't write {path}: {error.strerror}",
        expected,
        next_steps.get(error.errno or 0, "check the path and run again"),
    )
