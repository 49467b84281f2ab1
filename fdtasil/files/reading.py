"""Reading a file that somebody else made: a plain one, and not more of it than there may be."""

from pathlib import Path

from fdtasil.errors import ExpertError

__all__ = ["read_limited"]


def read_limited(path: Path, limit: int, what: str, next_step: str = "check the path") -> bytes:
    """Read a file of 1 to `limit` bytes.

    Args:
        path: The file.
        limit: The most that it may have.
        what: What it should be, for the error.
        next_step: What to do where it can't be read.

    Raises:
        ExpertError: If it is larger, empty, or can't be read.
    """
    try:
        size = path.stat().st_size
        if not 0 < size <= limit:
            raise ExpertError(
                f"{path} has {size:,} bytes",
                f"1 to {limit:,} bytes",
                "check that this is the right file",
            )
        return path.read_bytes()
    except OSError as error:
        raise ExpertError(
            f"{path.absolute()} can't be read: {error.strerror}",
            f"{what} (relative paths start at {Path.cwd()})",
            next_step,
        ) from error
