"""The library's errors and warnings: what was found, what was expected, and the next step."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

__all__ = [
    "EnvironmentFault",
    "ExpertError",
    "ExportError",
    "FdtasilError",
    "FdtasilWarning",
    "FitError",
    "SettingError",
    "StorageError",
    "first_line",
    "shown",
    "warn",
]

# Frames that are no caller's: the library's own, and those of its context managers.
_OURS = (str(Path(__file__).parent) + os.sep, contextlib.__file__)


class FdtasilError(Exception):
    """A failure that the caller can act on.

    Args:
        found: What was found, naming the argument or the file.
        expected: What would have been right.
        next_step: What to do now.

    Example:
        >>> print(FdtasilError("probes=-1", "an integer of at least 0", "write probes=10"))
        probes=-1
          expected: an integer of at least 0
          next step: write probes=10
    """

    def __init__(self, found: str, expected: str, next_step: str) -> None:
        # All three go to Exception.args, so that the error survives pickling between processes.
        super().__init__(found, expected, next_step)
        self.found, self.expected, self.next_step = found, expected, next_step

    def __str__(self) -> str:
        return f"{self.found}\n  expected: {self.expected}\n  next step: {self.next_step}"


class SettingError(FdtasilError, ValueError):
    """An argument has a value that can't be used."""


class EnvironmentFault(FdtasilError):
    """An environment can't be used, or misbehaved while it was stepped."""


class ExpertError(FdtasilError):
    """An expert can't be opened, or failed a check."""


class FitError(FdtasilError):
    """The optimisation of the student went wrong."""


class ExportError(FdtasilError):
    """A student or an agent can't be written as ONNX, or the file disagrees with its source."""


class StorageError(FdtasilError, OSError):
    """A file can't be read or written."""

    def __str__(self) -> str:  # OSError formats its first two arguments as an errno pair
        return FdtasilError.__str__(self)


class FdtasilWarning(UserWarning):
    """Something that did not stop the work, and that the result should be read with."""


def warn(message: str) -> None:
    """Warn with the line of the caller's own code that led here, however deep that is."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OURS):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, FdtasilWarning, stacklevel=level)


def first_line(error: Exception) -> str:
    """Return the start of an error's message, for a message of ours."""
    return shown((str(error).strip().splitlines() or [type(error).__name__])[0])


def shown(text: object) -> str:
    """Return text from a file as one short printable line, for a message of ours.

    A file may hold line breaks, megabytes, and the control characters of a terminal.
    """
    line = "".join(character if character.isprintable() else "?" for character in str(text)[:201])
    return line if len(line) <= 200 else f"{line[:197]}..."
