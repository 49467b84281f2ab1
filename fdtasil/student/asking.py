"""What a student is asked by a caller, and scores that nothing can be chosen from."""

from typing import Any

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.rollouts.spaces import Layout, to_numpy

__all__ = ["as_numbers", "check_choosing"]


def as_numbers(observation: Any, expected: str, step: str) -> np.ndarray:
    """Return an observation as float32, whatever it comes in.

    Args:
        observation: Numbers: an array, a tensor on whatever device, a list.
        expected: Instead of something else.
        step: What to do then.

    Raises:
        SettingError: If it is something else, or some of it is masked.
    """
    found = f"an observation that is a {type(observation).__name__}"
    try:
        if np.ma.is_masked(observation):
            found = "an observation of which some numbers are masked"
            raise ValueError
        return np.asarray(to_numpy(observation), np.float32)
    except (RuntimeError, TypeError, ValueError):  # torch's of a gradient, numpy's
        raise SettingError(found, expected, step) from None


def check_choosing(actions: np.ndarray, layout: Layout) -> None:
    """Refuse scores that are no numbers: the first of them would pass for the best.

    Args:
        actions: (B, m) of a student.
        layout: Of the environment's actions.

    Raises:
        SettingError: If a choice has such scores.
    """
    if any(np.isnan(actions[:, start:end]).any() for start, end in layout.choices):
        raise SettingError(
            "an observation that is NaN or infinite, of which nothing is the best choice",
            "finite numbers",
            "look at the sensor, and decide there what is done without it",
        )
