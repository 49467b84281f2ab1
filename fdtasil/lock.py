"""One process writes a folder at a time."""

import os
import socket
import time
from contextlib import suppress
from pathlib import Path
from types import ModuleType, TracebackType

from fdtasil.errors import StorageError
from fdtasil.storage import explain

try:
    import fcntl as _fcntl
except ImportError:  # Windows has no such lock; unique temporary names still keep files whole
    _unix: ModuleType | None = None
else:
    _unix = _fcntl

__all__ = ["FolderLock"]

_NAME = ".lock"


class FolderLock:
    """The right to write a folder, until the block or the process ends, however it ends.

    The kernel holds the lock, so that a killed process leaves none behind. Where the file system
    has no locks there is none, and two processes are not told of each other.

    Args:
        folder: Made if it is not there, which shows at once whether it can be written.

    Raises:
        StorageError: If another process has it, or it can't be written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / _NAME
        try:
            self._made = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            while not self._is_taken():
                os.close(self._file)
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            os.ftruncate(self._file, 0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            holder = f"process {os.getpid()} on {socket.gethostname()} since {since}"
            os.pwrite(self._file, holder.encode(), 0)
        except StorageError:
            raise
        except OSError as error:
            raise explain(error, folder, "a folder that can be written") from error

    def _is_taken(self) -> bool:
        """Take the lock; False where the file was removed by its last holder meanwhile."""
        if _unix is None:
            return True
        try:
            _unix.flock(self._file, _unix.LOCK_EX | _unix.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(self._file, 500, 0).decode(errors="replace")
            os.close(self._file)
            raise StorageError(
                f"{self._path.parent} is written by {holder or 'another process'}",
                "a folder that no other run writes",
                "wait for it to end, or choose another folder",
            ) from None
        except OSError:
            return True  # a file system without locks
        with suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._file), self._path.stat())
        return False

    def __enter__(self) -> "FolderLock":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with suppress(OSError):  # a full or read-only disk is no reason to hide the error
            self._path.unlink()
        os.close(self._file)
        if self._made:
            with suppress(OSError):  # only a folder that nothing was written to is empty
                self._path.parent.rmdir()
