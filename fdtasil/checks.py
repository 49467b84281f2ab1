"""Arguments that are looked at in one way everywhere, so that they are refused with one text."""

import math
import os
from collections.abc import Collection
from contextlib import suppress
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from fdtasil.errors import SettingError, in_one_line, shown

__all__ = [
    "check_choice",
    "check_count",
    "check_flag",
    "check_number",
    "check_path",
    "check_share",
    "check_suffix",
    "spelt",
]

_MOST = 2**53  # beyond it a float is no whole number any more, and nobody waits so long


def check_count(name: str, value: object, least: int = 1, most: int | None = None) -> int:
    """Return a whole number as a plain int; numpy's are as good as Python's.

    Args:
        name: What the caller calls it.
        value: What was given.
        least: The smallest that can be used.
        most: The largest, or None.

    Raises:
        SettingError: If it is no integer from `least` to `most`.

    Example:
        >>> import numpy as np
        >>> check_count("episodes", np.int64(5))
        5
    """
    number = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if number is not None and least <= number <= (_MOST if most is None else most):
        return number
    expected = "a positive integer" if least == 1 else f"an integer of at least {least}"
    if most is not None:
        expected = f"an integer from {least} to {most}"
    example = max(least, 5) if most is None else min(max(least, 5), most)
    raise SettingError(spelt(name, value), expected, _example(name, value, example))


def check_number(
    name: str, value: object, *, positive: bool = False, example: float = 1.0
) -> float:
    """Return a finite number of at least 0 as a plain float.

    Args:
        name: What the caller calls it.
        value: What was given; a text is no number, also where it looks like one.
        positive: Whether 0 is refused too.
        example: A number that can be used.

    Raises:
        SettingError: If it can't be used.
    """
    number = _number(value)
    if number is not None and (number > 0 or (number == 0 and not positive)) and number < math.inf:
        return number
    expected = "a positive number" if positive else "a number of at least 0"
    raise SettingError(spelt(name, value), expected, _example(name, value, example))


def check_share(name: str, value: object, *, whole: bool = True) -> float:
    """Return a share from 0 to 1 as a plain float.

    Args:
        name: What the caller calls it.
        value: What was given.
        whole: Whether 1 itself is a share that can be used.

    Raises:
        SettingError: If it can't be used.
    """
    number = _number(value)
    if number is not None and (0 <= number < 1 or (number == 1 and whole)):
        return number
    expected = "a share from 0 to 1" if whole else "a share from 0 to below 1"
    raise SettingError(spelt(name, value), expected, _example(name, value, 0.2))


def check_flag(name: str, value: object) -> bool:
    """Return True or False; a text such as "False" is neither.

    Raises:
        SettingError: If it is something else.
    """
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise SettingError(spelt(name, value), "True or False", f"write {name}=True, or leave it out")


def check_choice(name: str, value: object, choices: Collection[str]) -> str:
    """Return one of some texts.

    Raises:
        SettingError: If it is another, or no text.
    """
    if isinstance(value, str) and value in choices:
        return value
    raise SettingError(spelt(name, value), f"one of {', '.join(choices)}", "choose one of these")


def check_path(name: str, value: object) -> Path:
    """Return a path of a file system.

    Raises:
        SettingError: If it is neither a text nor a path, or holds a NUL.
    """
    if isinstance(value, str | os.PathLike):
        with suppress(TypeError):  # a path of bytes
            path = Path(value)
            if "\0" not in str(path):
                return path
    example = f'write for example {name}="runs/latest"'
    raise SettingError(spelt(name, value), "a text, or a pathlib.Path", example)


def check_suffix(path: Path, *suffixes: str) -> Path:
    """Return the path of a file to write, whose name says what is written.

    Raises:
        SettingError: If it ends with another suffix.
    """
    if path.suffix.lower() in suffixes:
        return path
    listed = " or ".join(suffixes)
    advice = f"write {path.stem or 'file'}{suffixes[0]}"  # a folder has no name of a file
    raise SettingError(f"the file {path.name!r}", f"a name that ends with {listed}", advice)


def spelt(name: str, value: object) -> str:
    """Return `name=value` for a message, whatever the value is."""
    try:
        return in_one_line(f"{name}={value!r}")  # an array's has several
    except Exception as error:  # a class of the caller's, or an int of 5,000 digits
        return shown(f"{name}: a {type(value).__name__} ({type(error).__name__} when printed)")


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    with suppress(OverflowError, ValueError, TypeError):
        return float(value)
    return None


def _example(name: str, value: object, usual: float) -> str:
    """Return what to write: what was meant, where a configuration file made a text of it."""
    if isinstance(value, str):
        with suppress(ValueError, OverflowError):  # is infinite
            number = float(value)
            meant = int(number) if number.is_integer() and isinstance(usual, int) else number
            return f"write {name}={meant}, a number and no text (YAML reads 1e-3 as a text)"
    return f"write for example {name}={usual}"
