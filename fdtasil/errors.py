"""The library's errors and warnings: what was found, what was expected, and the next step."""

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
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
    "heard_warnings",
    "in_one_line",
    "printable",
    "shown",
    "warn",
    "without_secrets",
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
        # Whatever a file, a server or a user's code put into it: a terminal must not obey it.
        parts = [printable(part) for part in (found, expected, next_step)]
        # All three go to Exception.args, so that the error survives pickling between processes.
        super().__init__(*parts)
        self.found, self.expected, self.next_step = parts

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


def warn(message: str, *, of_result: bool = True) -> None:
    """Warn with the line of the caller's own code that led here, however deep that is.

    It is shown each time, where the caller's filters let it.

    Args:
        message: What is said.
        of_result: Whether a result should be read with it: `heard_warnings` hears it then.
    """
    message = printable(message)
    for heard in _HEARD.get() if of_result else ():
        heard.append(message)
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OURS):
        frame = frame.f_back
    module = frame.f_globals.get("__name__")
    warnings.warn_explicit(
        message, FdtasilWarning, frame.f_code.co_filename, frame.f_lineno, module
    )


@contextlib.contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Keep the library's warnings of this thread in a list, besides showing them."""
    heard: list[str] = []
    token = _HEARD.set((*_HEARD.get(), heard))
    try:
        yield heard
    finally:
        _HEARD.reset(token)


_HEARD: ContextVar[tuple[list[str], ...]] = ContextVar("heard", default=())


def first_line(error: BaseException) -> str:
    """Return the start of an error's message, or its type, for a message of ours."""
    lines = _text(error).strip().splitlines() or [type(error).__name__]
    return shown(lines[0])


def shown(value: object) -> str:
    """Return what came from outside as one short printable line, for a message of ours.

    Everything passes here that is not ours: texts of files, of servers and of environments, names,
    exceptions of a user's code. They may hold line breaks, megabytes, and the control characters
    of a terminal; the text of an object may even raise.
    """
    line = "".join(c if c.isprintable() else "?" for c in _text(value)[:201])
    return line if len(line) <= 200 else f"{line[:197]}..."


def in_one_line(value: object) -> str:
    """Return what came from outside with all its lines as one; see `shown`."""
    return shown(" ".join(_text(value).split()))


def printable(text: str) -> str:
    """Return a text with "?" for what a terminal would obey; its lines stay lines."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def without_secrets(address: str) -> str:
    """Return an address without user, password, query and fragment, however malformed it is.

    Args:
        address: A URL, or any other text, which is returned as it is.

    Example:
        >>> without_secrets("https://me:word@host/act?api_key=1")
        'https://host/act'
    """
    found = re.match(r"(?is)\s*(https?:/*)(.*)", address)
    if found is None:
        return address
    plain = re.split(r"[?#]", found[2], maxsplit=1)[0].rpartition("@")[2]
    # A password may hold what ends a host: what does not look like a host is not shown.
    host = re.match(r"(\[[\w:.%]*\]?|[^:/]*)(:\d*)?(/|$)", plain)
    return found[1] + (plain if host else "...")


def _text(value: object) -> str:
    try:
        return str(value)
    except Exception as error:  # an exception of a user's code whose text raises
        return f"{type(value).__name__} (its text raises {type(error).__name__})"
