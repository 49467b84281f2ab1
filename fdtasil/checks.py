"""Arguments that are looked at in one way everywhere, so that they are refused with one text."""

import math
from numbers import Integral, Real

from fdtasil.errors import SettingError

__all__ = ["check_count", "check_number", "check_share"]


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
    if number is not None and number >= least and (most is None or number <= most):
        return number
    expected = "a positive integer" if least == 1 else f"an integer of at least {least}"
    if most is not None:
        expected = f"an integer from {least} to {most}"
    raise SettingError(f"{name}={value!r}", expected, f"write for example {name}={max(least, 5)}")


def check_number(name: str, value: object, *, positive: bool = False) -> float:
    """Return a finite number of at least 0 as a plain float.

    Args:
        name: What the caller calls it.
        value: What was given; a text is no number, also where it looks like one.
        positive: Whether 0 is refused too.

    Raises:
        SettingError: If it can't be used.
    """
    number = _number(value)
    if number is not None and (number > 0 or (number == 0 and not positive)) and number < math.inf:
        return number
    expected = "a positive number" if positive else "a number of at least 0"
    raise SettingError(f"{name}={value!r}", expected, f"write for example {name}=1.0")


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
    raise SettingError(f"{name}={value!r}", expected, f"write for example {name}=0.2")


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    return float(value)
