"""Where an expert has no answer: a planner without a solution, a law that is not defined there."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from fdtasil.errors import ExpertError

__all__ = ["MOST", "Silence", "check_answered"]

MOST = 0.5
"""Share of the states asked about that may have no answer; more of them make an expert useless."""


@dataclass
class Silence:
    """What is known of an expert's silence.

    Attributes:
        rows: Without an answer so far, by purpose.
        answered: (1, n) an observation that had one: asked again where a whole batch has none.
        reason: What was said instead of the last of them.
    """

    rows: Counter[str] = field(default_factory=Counter)
    answered: np.ndarray | None = None
    reason: str = "NaN"


def check_answered(name: str, silence: Silence, none: int, asked: int, what: str) -> None:
    """Refuse an expert that has no answer at most states.

    Args:
        name: Of the expert.
        silence: Its own.
        none: States without an answer.
        asked: Of how many.
        what: Which states these were.

    Raises:
        ExpertError: If it has none at more than the share `MOST`.
    """
    if none > MOST * asked:
        raise ExpertError(
            f"{name} has no answer at {none:,} of {asked:,} {what}; it said {silence.reason}",
            f"an answer at {1 - MOST:.0%} of them at least",
            "look at what it makes of such a state"
            + (", or pass a smaller radius" if "moved" in what else ""),
        )
