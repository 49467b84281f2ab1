"""Files that are either whole or not there: unique temporary name, flush, rename, manifest."""

import errno
import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdtasil.errors import StorageError

__all__ = ["MANIFEST", "sha256", "to_json", "verify", "write_bytes", "write_folder"]

MANIFEST = "manifest.json"


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
        temporary.unlink(missing_ok=True)
        raise _explain(error, path, len(data)) from error


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files, then a manifest with their sha256 as the last one.

    Args:
        folder: Where; made if it is not there.
        files: Content by name relative to `folder`.

    Raises:
        StorageError: As `write_bytes`.
    """
    for name, data in files.items():
        write_bytes(folder / name, data)
    manifest = {name: sha256(data) for name, data in sorted(files.items())}
    write_bytes(folder / MANIFEST, to_json(manifest))


def verify(folder: Path) -> dict[str, bytes]:
    """Read the files of a folder that `write_folder` made, checking each against the manifest.

    Returns:
        Content by name.

    Raises:
        StorageError: If the manifest or a file is missing, or a file is not the one written.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        files = {name: (folder / name).read_bytes() for name in manifest}
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


def _explain(error: OSError, path: Path, size: int) -> StorageError:
    next_steps = {
        errno.ENOSPC: "free some space and run again; what was there before is whole",
        errno.EROFS: "choose a folder on a writable file system",
        errno.EACCES: "choose a folder that you may write to",
    }
    return StorageError(
        f"can't write {path}: {error.strerror}",
        f"room and permission for {size:,} bytes",
        next_steps.get(error.errno or 0, "check the path and run again"),
    )
