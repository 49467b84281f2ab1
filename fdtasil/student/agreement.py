"""Whether a file that a student was written as answers as the student does."""

import numpy as np

from fdtasil.errors import ExportError
from fdtasil.student.plain import PlainPolicy

__all__ = ["check_agreement"]

_ROUNDED = 4  # of float32's steps at an action's size


def check_agreement(
    file: str, answers: np.ndarray, policy: PlainPolicy, states: np.ndarray, most: float = 1e-5
) -> None:
    """Refuse a file whose answers are others.

    Args:
        file: What to call it.
        answers: (B, m) of the file.
        policy: Whose answers it must give.
        states: (B, n) observations.
        most: How far they may be apart, in halves of an action's range, beside what float32
            rounds away of the actions themselves.

    Raises:
        ExportError: If they are farther apart, or no numbers.
    """
    expected = policy(states)
    rounding = _ROUNDED * np.spacing(np.abs(expected))
    beyond = np.maximum(np.abs(answers - expected) - rounding, 0.0)  # a NaN stays one
    apart = float((beyond / policy.half).max())
    if not apart <= most:
        raise ExportError(
            f"the {file} file and the student differ by {apart:.1e} of half the range",
            f"at most {most:g} on {len(states)} states",
            "look for weights of very different sizes",
        )
