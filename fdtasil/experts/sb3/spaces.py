"""The two spaces of an agent, from the text that stands beside their pickles."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fdtasil.errors import ExpertError, SettingError, shown
from fdtasil.experts.sb3.trust import ITSELF

__all__ = [
    "LARGEST",
    "Bounds",
    "choice_sizes",
    "given_bounds",
    "no_bounds",
    "read_bounds",
    "read_size",
]

_BOX = re.compile(r"<class '(?:gym|gymnasium)\.spaces\.box\.Box'>")
LARGEST = 10**6
"""A size that no agent reaches: one above it may be there to fill the memory."""
_CHOICE = re.compile(
    r"<class '(?:gym|gymnasium)\.spaces\.(?:multi_)?discrete\.(?:Multi)?Discrete'>"
)


@dataclass(frozen=True)
class Bounds:
    """The action bounds of an agent, (m,) float32 each."""

    low: np.ndarray
    high: np.ndarray


def choice_sizes(record: Mapping[str, Any]) -> tuple[int, ...]:
    """Return how many possibilities each choice of an agent's actions has; () for numbers."""
    entry = record.get("action_space")
    if not isinstance(entry, dict) or not _CHOICE.fullmatch(str(entry.get(":type:"))):
        return ()
    text = str(entry.get("nvec", entry.get("n")))
    sizes = tuple(int(word) for word in re.findall(r"\d+", text)) if len(text) < 10_000 else ()
    return sizes if sizes and all(1 < size <= LARGEST for size in sizes) else ()


def no_bounds(size: int) -> Bounds:
    """Return the bounds of scores, which have none."""
    wide = np.full(size, np.inf, np.float32)
    return Bounds(-wide, wide)


def read_size(record: Mapping[str, Any], name: str, source: str) -> int:
    """Return the length of a flat space, n or m; of choices, the number of their scores.

    Raises:
        ExpertError: If the space is another one.
    """
    sizes_of_choices = choice_sizes(record) if name == "action_space" else ()
    if sizes_of_choices:
        return sum(sizes_of_choices)
    entry = record.get(name)
    if not isinstance(entry, dict):
        raise ExpertError(
            f"{source} has no {name}",
            "what save() of stable-baselines3 wrote",
            "check that this is the right file",
        )
    kind, dtype = str(entry.get(":type:")), str(entry.get("dtype"))
    shape = entry.get("_shape", entry.get("shape"))  # gym called it shape until 0.19
    if _BOX.fullmatch(kind) and (name != "action_space" or "float" in dtype):
        sizes = shape if isinstance(shape, list) else []
        # A stack of frames is laid in a row; of three dimensions, it may be an image.
        usual = 0 < len(sizes) < (2 if name == "action_space" else 3)
        usual = usual and all(isinstance(size, int) and size > 0 for size in sizes)
        if usual and math.prod(sizes) <= LARGEST:
            return math.prod(sizes)
    raise ExpertError(
        shown(f"{source} has the {name} {kind} of shape {shape} and dtype {dtype}"),
        "a Box of floats with one dimension"
        + (", or choices" if name == "action_space" else ", or of frames with two"),
        ITSELF,
    )


def read_bounds(record: Mapping[str, Any], size: int, source: str) -> Bounds:
    """Return the action bounds as printed by numpy: to eight digits.

    Raises:
        ExpertError: If the text is abbreviated or is not bounds.
    """
    low, high = (
        _numbers(str(record["action_space"].get(side)), size, f"{source}: {side} of the actions")
        for side in ("low", "high")
    )
    if not (low <= high).all():
        raise ExpertError(
            f"{source}: action bounds {low} to {high}", "low at most high", "pass them yourself"
        )
    return Bounds(low, high)


def given_bounds(low: ArrayLike | None, high: ArrayLike | None, size: int) -> Bounds | None:
    """Return the caller's own bounds, or None where there are none.

    Raises:
        SettingError: If only one is given, or one has another length.
    """
    if low is None and high is None:
        return None
    try:
        pair = [np.broadcast_to(np.asarray(x, np.float32), (size,)).copy() for x in (low, high)]
    except (TypeError, ValueError):
        pair = []
    if not pair or not (pair[0] <= pair[1]).all():
        raise SettingError(
            f"action_low={low!r}, action_high={high!r}",
            f"{size} numbers each, low at most high",
            "pass env.action_space.low and env.action_space.high",
        )
    return Bounds(*pair)


def _numbers(text: str, size: int, source: str) -> np.ndarray:
    if "..." in text:
        raise ExpertError(
            f"{source} is abbreviated: {text[:60]!r}",
            f"{size} numbers",
            "write action_low=env.action_space.low, action_high=env.action_space.high",
        )
    try:
        values = [float(word) for word in text.strip().strip("[]").split()]
    except ValueError:
        values = []
    if len(values) != size:
        raise ExpertError(
            f"{source} is {text[:60]!r}",
            f"{size} numbers",
            "write action_low=env.action_space.low, action_high=env.action_space.high",
        )
    with np.errstate(over="ignore"):  # becomes infinite, which is judged where it matters
        return np.array(values, np.float32)
