"""One process writes a folder at a time."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from fdtasil.errors import StorageError
from fdtasil.files.storage import explain

try:
    import fcntl as _fcntl
except ImportError:  # Windows has no such lock; unique temporary names still keep files whole
    _unix: ModuleType | None = None
else:
    _unix = _fcntl

__all__ = ["locked"]

_NAME = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Have the right to write a folder, until the block or the process ends, however it ends.

    The kernel holds the lock, so that a killed process leaves none behind. Where the file system
    has no locks there is none, and two processes are not told of each other.

    Args:
        folder: Made if it is not there, which shows at once whether it can be written.

    Raises:
        StorageError: If another process has it, or it can't be written.
    """
    path = folder / _NAME
    try:
        made = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        file = _take(path)
    except StorageError:
        raise
    except OSError as error:
        raise explain(error, folder, "a folder that can be written") from error
    try:
        yield
    finally:
        with suppress(OSError):  # a full or read-only disk is no reason to hide the error
            path.unlink()
        os.close(file)
        if made:
            with suppress(OSError):  # only a folder that nothing was written to is empty
                folder.rmdir()


def _take(path: Path) -> int:
    """Open and lock the file, and write into it who holds it; return its descriptor."""
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    while not _is_taken(file, path):
        os.close(file)
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    os.ftruncate(file, 0)
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    holder = f"process {os.getpid()} on {socket.gethostname()} since {since}"
    os.pwrite(file, holder.encode(), 0)
    return file


def _is_taken(file: int, path: Path) -> bool:
    """Take the lock; False where the file was removed by its last holder meanwhile."""
    if _unix is None:
        return True
    try:
        _unix.flock(file, _unix.LOCK_EX | _unix.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(file, 500, 0).decode(errors="replace")
        os.close(file)
        raise StorageError(
            f"{path.parent} is written by {holder or 'another process'}",
            "a folder that no other run writes",
            "wait for it to end, or choose another folder",
        ) from None
    except OSError:
        return True  # a file system without locks
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), path.stat())
    return False
