"""One process writes a folder at a time."""

import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from fdtasil.errors import StorageError, shown
from fdtasil.files.names import inside
from fdtasil.files.storage import LOCK, explain, make_folder, remove_file, remove_if_empty

try:
    import fcntl as _fcntl
except ImportError:  # Windows has no such lock; unique temporary names still keep files whole
    _unix: ModuleType | None = None
else:
    _unix = _fcntl

__all__ = ["locked", "was_locked"]

_HOLDER = "process "  # how the text in a lock begins
_PAUSE = 0.02  # seconds between two looks at a lock that is waited for


@contextmanager
def locked(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Have the right to write a folder, until the block or the process ends, however it ends.

    The kernel holds the lock, so that a killed process leaves none behind. Where the file system
    has no locks there is none, and two processes are not told of each other.

    Args:
        folder: Made if it is not there, which shows at once whether it can be written.
        patience: Seconds to wait for another process.

    Raises:
        StorageError: If another process has it, or it can't be written.
    """
    path = inside(folder, LOCK)
    made = not os.path.exists(folder)  # Path's own raises where a name is too long
    file = _wait_for(path, time.monotonic() + patience)
    _OWN.add(file)
    try:
        yield
    finally:
        if file in _OWN:  # a fork of this process has none
            _OWN.remove(file)
            _give_back(file, path)
        if made:
            remove_if_empty(folder)  # only a folder that nothing was written to is empty


_OWN: set[int] = set()
"""Descriptors of the locks that this process holds."""


def _let_go() -> None:
    """Close the locks of the parent in a forked child, which would hold them after its death."""
    for file in tuple(_OWN):
        os.close(file)
    _OWN.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


def was_locked(folder: Path) -> bool:
    """Return whether a process of ours that was killed has left its lock in a folder."""
    try:
        file = _open(inside(folder, LOCK), os.O_RDONLY)
    except OSError:
        return False
    try:
        return _holder(file).startswith(_HOLDER)
    finally:
        os.close(file)


def _give_back(file: int, path: Path) -> None:
    if _unix is None:
        os.close(file)  # Windows removes no file that is open
        remove_file(path)
        return
    remove_file(path)  # while it is held: the next holder's file is another one
    os.close(file)


def _wait_for(path: Path, end: float) -> int:
    """Open and lock the file, and write into it who holds it; return its descriptor."""
    while True:
        make_folder(path.parent)  # again: the last holder may have removed what it had made
        try:
            file = _open(path, os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:
            continue
        except StorageError:
            raise
        except OSError as error:
            raise explain(error, path.parent, "a folder that can be written") from error
        try:
            taken = _is_taken(file, path)
        except BlockingIOError:
            holder = _holder(file)
            os.close(file)
            if time.monotonic() >= end:
                raise _held(path.parent, holder) from None
            time.sleep(_PAUSE)
            continue
        if taken:
            _sign(file)
            return file
        os.close(file)


def _open(path: Path, how: int) -> int:
    """Open a plain file that nothing else leads to: it is going to be written into."""
    flags = how | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
    file = os.open(path, flags | getattr(os, "O_CLOEXEC", 0), 0o644)
    about = os.fstat(file)
    if stat.S_ISREG(about.st_mode) and about.st_nlink <= 1:
        return file
    os.close(file)
    raise StorageError(
        f"{path} is no plain file, or has a second name",
        "a lock that fdtasil made",
        f"look at it, and remove it: {path}",
    )


def _sign(file: int) -> None:
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    holder = f"{_HOLDER}{os.getpid()} on {socket.gethostname()} since {since}"
    try:
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, holder.encode())
    except OSError:
        pass  # a full disk; the lock itself is held


def _holder(file: int) -> str:
    os.lseek(file, 0, os.SEEK_SET)
    return shown(os.read(file, 200).decode(errors="replace"))


def _held(folder: Path, holder: str) -> StorageError:
    return StorageError(
        f"{folder} is written by {holder or 'another process'}",
        "a folder that no other run writes",
        "wait for it to end, or choose another folder",
    )


def _is_taken(file: int, path: Path) -> bool:
    """Take the lock; False where the file was removed by its last holder meanwhile.

    Raises:
        BlockingIOError: If another process has it.
    """
    if _unix is None:
        return True
    try:
        _unix.flock(file, _unix.LOCK_EX | _unix.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return True  # a file system without locks
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), path.lstat())
    return False
