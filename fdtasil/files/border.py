"""The border: whatever reads a file that somebody else may have made ends in an error of ours."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from fdtasil.errors import FdtasilError, StorageError, first_line

__all__ = ["reads"]

Arguments = ParamSpec("Arguments")
Content = TypeVar("Content")
_NOT_OURS = (KeyboardInterrupt, SystemExit, GeneratorExit)


def reads(
    what: str,
    expected: str,
    next_step: str,
    error: type[FdtasilError] = StorageError,
    *,
    passes: type[FdtasilError] | None = None,
) -> Callable[[Callable[Arguments, Content]], Callable[Arguments, Content]]:
    """Let a reader end in its content or in an error of ours, whatever is in the file.

    Libraries that read damaged bytes raise nearly anything: MemoryError, RecursionError,
    NotImplementedError, zlib.error, the panics of a Rust library, which are no Exception.

    Args:
        what: What the content should be.
        expected: What would have been right.
        next_step: What to do now.
        error: The kind of error that it becomes.
        passes: The errors that are left as they are; None for `error` alone.

    Example:
        >>> @reads("a number", "digits", "write 5")
        ... def number(data):
        ...     return int(data)
        >>> number("five")
        Traceback (most recent call last):
        fdtasil.errors.StorageError: not a number: ValueError invalid literal for int() ...
          expected: digits
          next step: write 5
    """

    def decorate(read: Callable[Arguments, Content]) -> Callable[Arguments, Content]:
        @functools.wraps(read)
        def guarded(*positional: Arguments.args, **named: Arguments.kwargs) -> Content:
            try:
                return read(*positional, **named)
            except BaseException as fault:
                if isinstance(fault, (passes or error, *_NOT_OURS)):
                    raise
                found = f"not {what}: {type(fault).__name__} {first_line(fault)}"
                raise error(found, expected, next_step) from fault

        return guarded

    return decorate
