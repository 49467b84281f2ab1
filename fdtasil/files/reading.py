"""Reading a file that somebody else made: a plain one, and not more of it than there may be."""

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

from fdtasil.errors import ExpertError, first_line

__all__ = ["FILE_LIMIT", "check_unpacked", "from_json", "read_limited", "read_plain"]

FILE_LIMIT = 2**34
"""Bytes that a file of ours may have."""
_JSON_LIMIT = 2**25  # a hundred times the longest report; parsed it takes fifty times as much
_SMALL, _RATIO = 2**26, 100


def read_plain(path: Path, limit: int = FILE_LIMIT, *, follow: bool = True) -> bytes:
    """Read a plain file of at most `limit` bytes.

    A named pipe or a device may be waited for without end, so it is not even begun.

    Args:
        path: The file.
        limit: The most that it may have.
        follow: Whether the path itself may be a link.

    Raises:
        OSError: If it is larger, no plain file, or can't be read.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    if not follow:
        flags |= getattr(os, "O_NOFOLLOW", 0)
        if path.is_symlink():
            raise OSError(errno.ELOOP, "it is a link")
    with open(os.open(path, flags | getattr(os, "O_CLOEXEC", 0)), "rb") as file:
        about = os.fstat(file.fileno())
        if stat.S_ISDIR(about.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "it is no plain file")
        if about.st_size > limit:
            raise OSError(errno.EFBIG, f"it has {about.st_size:,} bytes, of at most {limit:,}")
        # Not to the limit: Python takes memory for as much as may come.
        data = file.read(about.st_size + 1)
    if len(data) > about.st_size:
        raise OSError(errno.EBUSY, "it grew while it was read")
    return data


def check_unpacked(packed: int, unpacked: int) -> None:
    """Refuse what unpacks to more than 64 MiB and a hundred times its size.

    A few kilobytes can unpack to gigabytes, so the sizes are looked at before.

    Args:
        packed: Bytes that it has.
        unpacked: Bytes that it will have.

    Raises:
        ValueError: If it is refused.
    """
    if unpacked > min(FILE_LIMIT, max(_SMALL, _RATIO * packed)):
        raise ValueError(f"it unpacks from {packed:,} to {unpacked:,} bytes")


def from_json(data: bytes) -> Any:
    """Return what JSON says.

    Raises:
        ValueError: If it is none, too long, or too deep.
    """
    if len(data) > _JSON_LIMIT:
        raise ValueError(f"{len(data):,} bytes of JSON, of at most {_JSON_LIMIT:,}")
    try:
        return json.loads(data)
    except (RecursionError, MemoryError) as error:
        raise ValueError(f"JSON that is too deep: {first_line(error)}") from error


def read_limited(path: Path, limit: int, what: str, next_step: str = "check the path") -> bytes:
    """Read a plain file of 1 to `limit` bytes.

    Args:
        path: The file.
        limit: The most that it may have.
        what: What it should be, for the error.
        next_step: What to do where it can't be read.

    Raises:
        ExpertError: If it is larger, empty, no plain file, or can't be read.
    """
    try:
        size = path.stat().st_size
        if path.is_file() and not 0 < size <= limit:
            raise ExpertError(
                f"{path} has {size:,} bytes",
                f"1 to {limit:,} bytes",
                "check that this is the right file",
            )
        return read_plain(path, limit)
    except OSError as error:
        raise ExpertError(
            f"{path.absolute()} can't be read: {error.strerror}",
            f"{what} (relative paths start at {Path.cwd()})",
            next_step,
        ) from error
