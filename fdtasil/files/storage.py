"""Files that are either whole or not there: unique temporary name, flush, rename, manifest.

A folder changes as one: its new files are made in a hidden folder inside it, whose manifest, the
last of them, makes them count; then they are moved into place. Whoever reads a folder whose move
was cut short finds the new files where they are, and whoever reads during a move reads again.

Nobody else in the house writes or removes a file.
"""

import contextlib
import errno
import hashlib
import json
import os
import secrets
import shutil
import stat
import time
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from fdtasil.errors import StorageError
from fdtasil.files.names import inside, stays_inside
from fdtasil.files.reading import FILE_LIMIT, from_json, read_plain

__all__ = [
    "add_to_folder",
    "explain",
    "is_written",
    "make_folder",
    "remove_file",
    "remove_folder",
    "remove_if_empty",
    "sha256",
    "stays_inside",
    "to_json",
    "verify",
    "write_bytes",
    "write_folder",
]

MANIFEST = "manifest.json"
COMING, LOCK = ".coming", ".lock"
_MANIFEST_LIMIT = 2**20
# Seconds to wait before a folder is read again that somebody was moving files into.
_PAUSES = (0.0, 0.0, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.1, 0.2, 0.2, 0.3)


def sha256(data: bytes) -> str:
    """Return the hexadecimal sha256 of `data`."""
    return hashlib.sha256(data).hexdigest()


def to_json(value: Any) -> bytes:
    """Return `value` as indented JSON, refusing the NaN and infinity that JSON does not have."""
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def write_bytes(path: Path, data: bytes, *, private: bool = False) -> None:
    """Write a whole file or nothing.

    Where `path` is a link, what it leads to is written; a device is written through. Nobody but
    its owner may read a file that is `private`.

    Raises:
        StorageError: If the disk is full, the folder is read-only, `path` is a folder, a pipe or
            the like, or anything else of the kind; whatever stood at `path` is then still there,
            whole.
    """
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if _kind(path) == stat.S_IFCHR:
        _write_through(path, data)
        return
    _write(path, data, private=private)
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
    _move_in(folder)
    old = _written_by_us(folder)
    _change(folder, files, {})
    for name in old - files.keys():
        with contextlib.suppress(OSError):  # what is new is whole, and that is what counts
            inside(folder, name).unlink()


def add_to_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write further files into a folder that `write_folder` made, or some of its files anew.

    Raises:
        StorageError: As `write_folder`; also if there is no manifest.
    """
    _move_in(folder)
    _change(folder, files, _manifest(folder))


def _change(folder: Path, files: Mapping[str, bytes], kept: Mapping[str, str]) -> None:
    """Make files in the hidden folder, then move them into place under a new manifest.

    Args:
        folder: Where.
        files: Content by name.
        kept: sha256 by name of the files that stay as they are.
    """
    for name in files:
        inside(folder, name)
    coming = inside(folder, COMING)
    remove_folder(coming)
    for name, data in files.items():
        _write(inside(coming, name), data)
    for place in {(coming / name).parent for name in files}:
        _flush_names(place)
    manifest = {**kept, **{name: sha256(data) for name, data in files.items()}}
    _write(coming / MANIFEST, to_json(dict(sorted(manifest.items()))))
    _flush_names(coming)
    _move_in(folder)


def _written_by_us(folder: Path) -> set[str]:
    """Return the files that an earlier call wrote and nobody has changed."""
    found = set[str]()
    with contextlib.suppress(StorageError):
        for name in _manifest(folder):
            with contextlib.suppress(StorageError):
                found |= _verified(folder, [name]).keys()
    return found


def verify(
    folder: Path, names: Collection[str] | None = None, *, edited: Collection[str] = ()
) -> dict[str, bytes]:
    """Read the files of a folder that `write_folder` made, checking each against the manifest.

    A reader that meets another process in the middle of a move reads again.

    Args:
        folder: Where.
        names: Which files; None for all of them.
        edited: Which of them somebody may have changed since.

    Returns:
        Content by name.

    Raises:
        StorageError: If the manifest or a file is missing, or a file is not the one written.
    """
    for pause in _PAUSES:
        before = _moment(folder)
        try:
            return _verified(folder, names, edited)
        except StorageError:
            # Whoever moves files has the lock; a move that was cut short is not waited for.
            if before == _moment(folder) and not os.path.lexists(folder / LOCK):
                raise
        time.sleep(pause)
    return _verified(folder, names, edited)


def _moment(folder: Path) -> tuple[object, object]:
    """Return what tells one state of a folder from the next: its manifest, and one that comes."""
    found = []
    for path in (folder / MANIFEST, folder / COMING / MANIFEST):
        try:
            about = path.lstat()
            found.append((about.st_ino, about.st_mtime_ns, about.st_size))
        except OSError:
            found.append(None)
    return found[0], found[1]


def _verified(
    folder: Path, names: Collection[str] | None, edited: Collection[str] = ()
) -> dict[str, bytes]:
    manifest = _manifest(folder)
    wanted = manifest if names is None else names
    if missing := set(wanted) - manifest.keys():
        raise _unreadable(folder, f"{MANIFEST} does not name {', '.join(sorted(missing))}")
    files, room = dict[str, bytes](), FILE_LIMIT
    try:
        for name in wanted:
            files[name] = read_plain(_path_of(folder, name), room, follow=False)
            room -= len(files[name])
    except StorageError:
        raise
    except OSError as error:
        raise _unreadable(folder, error) from error
    changed = [
        name
        for name, data in files.items()
        if name not in edited and sha256(data) != manifest[name]
    ]
    if changed:
        raise StorageError(
            f"{folder}: {', '.join(changed)} changed after writing",
            f"the sha256 recorded in {MANIFEST}",
            "restore the files from a copy, or run distill again",
        )
    return files


def _manifest(folder: Path) -> dict[str, str]:
    """Return sha256 by name, of names that stay in the folder."""
    try:
        return _parsed(read_plain(_path_of(folder, MANIFEST), _MANIFEST_LIMIT, follow=False))
    except StorageError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(folder, error) from error


def _parsed(data: bytes) -> dict[str, str]:
    manifest = from_json(data)
    # Nothing but what we write: a manifest that was changed must not pass for a shorter one.
    if not isinstance(manifest, dict) or to_json(manifest) != data:
        raise ValueError(f"{MANIFEST} changed after writing")
    if not all(isinstance(hash_, str) for hash_ in manifest.values()):
        raise ValueError(f"{MANIFEST} changed after writing")
    if not all(map(stays_inside, manifest)):
        raise StorageError(
            f"{MANIFEST} names a file outside of the folder",
            "names of files below the folder",
            "do not use the folder: somebody has changed it",
        )
    return manifest


def _unreadable(folder: Path, problem: object) -> StorageError:
    text = problem.strerror or str(problem) if isinstance(problem, OSError) else str(problem)
    if isinstance(problem, OSError) and problem.filename is not None:
        text = f"{text}: {Path(problem.filename).name}"
    return StorageError(
        f"{folder}: {text}",
        "the folder of a finished run, from save() or out= (--out)",
        "check the path, or save again",
    )


def is_written(folder: Path) -> bool:
    """Return whether a folder has a manifest: everything else was there before it."""
    return _path_of(folder, MANIFEST).exists()


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, unless it is there.

    Raises:
        StorageError: If it can't be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise explain(error, folder, "a folder that can be written") from error


def remove_file(path: Path) -> None:
    """Remove a file, if it is there and can be removed."""
    with contextlib.suppress(OSError):
        path.unlink()


def remove_folder(folder: Path) -> None:
    """Remove a folder with all that is in it, if it is there; links in it are not followed.

    Raises:
        StorageError: If it can't be removed.
    """
    try:
        if folder.is_symlink() or folder.exists():
            shutil.rmtree(folder)  # which refuses a link
    except OSError as error:
        raise explain(error, folder, "a folder that can be removed") from error


def remove_if_empty(folder: Path) -> None:
    """Remove a folder that has nothing in it."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _write(path: Path, data: bytes, *, private: bool = False) -> None:
    """Write a file of which a power failure may still lose the name."""
    if (kind := _kind(path)) not in (None, stat.S_IFREG):
        what = {stat.S_IFDIR: "a folder", stat.S_IFLNK: "a link"}.get(kind, "no plain file")
        raise StorageError(
            f"can't write {path}: it is {what}", "a plain file, or none", "choose another name"
        )
    # A name of its own for every write: two processes that share one lose files to each other.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        mode = 0o600 if private else 0o666
        with open(temporary, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise explain(error, path, f"room and permission for {len(data):,} bytes") from error


def _kind(path: Path) -> int | None:
    """Return what stands at a path, as the constants of `stat` say it; None for nothing."""
    try:
        return stat.S_IFMT(path.lstat().st_mode)
    except OSError:
        return None  # what is wrong is found when it is written


def _write_through(device: Path, data: bytes) -> None:
    try:
        with device.open("wb") as file:
            file.write(data)
    except OSError as error:
        raise explain(error, device, "a device that takes what is written") from error


def _path_of(folder: Path, name: str) -> Path:
    """Return where a file of a folder is, which is not yet in place if a move was cut short."""
    coming = inside(folder, COMING)
    # Without its manifest, what is coming does not count; the manifest is the last to be moved.
    if (coming / MANIFEST).exists() and inside(coming, name).exists():
        return coming / name
    return inside(folder, name)


def _move_in(folder: Path) -> None:
    """Move the files that are coming into place, if they are all there."""
    coming = inside(folder, COMING)
    try:
        names = _parsed(read_plain(inside(coming, MANIFEST), _MANIFEST_LIMIT, follow=False))
    except StorageError:
        raise
    except (OSError, ValueError):
        return  # not all there, or not by us
    moves = [(inside(coming, name), inside(folder, name)) for name in (*names, MANIFEST)]
    try:
        for new, place in moves:
            place.parent.mkdir(parents=True, exist_ok=True)
            if new.exists():
                new.replace(place)
        _flush_moves(folder, names)
        shutil.rmtree(coming)
    except OSError as error:
        raise explain(error, folder, "permission to move files") from error


def _flush_moves(folder: Path, names: Iterable[str]) -> None:
    for place in {(folder / name).parent for name in names} | {folder}:
        _flush_names(place)


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
        errno.EMFILE: "close files that are open, or allow more of them: ulimit -n 1024",
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
