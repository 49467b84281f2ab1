"""What an agent observes: one array, or the parts of a dictionary, from the text of its space."""

import ast
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fdtasil.errors import ExpertError, shown
from fdtasil.experts.sb3.spaces import LARGEST, read_size
from fdtasil.experts.sb3.trust import ITSELF
from fdtasil.rollouts.spaces import Layout

__all__ = ["Observed", "check_parts", "read_observed"]

_DICT = re.compile(r"<class '(?:gym|gymnasium)\.spaces\.dict\.Dict'>")
_LONGEST = 10**6  # letters of the text
_IMAGE = -1  # in the place of a size: stable-baselines3 gives it convolutions
_INSIDE = re.compile(r"(?:OrderedDict\()?[{\[](.*)[}\]]\)?", re.DOTALL)
_NAME = r"""('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")"""
_SPACE = (
    r"(Box\([^()]*, \((?P<shape>[\d, ]*)\), (?P<dtype>\w+)\)"
    r"|(?:Discrete|MultiBinary)\((?P<count>\d+)\)|MultiDiscrete\(\[(?P<counts>[\d\s]+)\]\))"
)
_ENTRY = re.compile(rf"(?:{_NAME}: |\({_NAME}, ){_SPACE}\)?(?:, |$)")


@dataclass(frozen=True)
class Observed:
    """The flat form of an agent's observations, in which its first layer takes them.

    Attributes:
        size: n.
        parts: Name and size of each part of a dictionary, in its order; () of one array.
    """

    size: int
    parts: tuple[tuple[str, int], ...] = ()


def read_observed(record: Mapping[str, Any], source: str) -> Observed:
    """Return what an agent observes.

    Of a dictionary, stable-baselines3's `CombinedExtractor` lays the parts side by side, a choice
    as ones and zeros, which is this library's flat form too.

    Raises:
        ExpertError: If it is something else, or there are images in it.
    """
    entry = record.get("observation_space")
    if not isinstance(entry, dict) or not _DICT.fullmatch(str(entry.get(":type:"))):
        return Observed(read_size(record, "observation_space", source))
    text = str(entry.get("spaces"))
    parts = tuple(_parts(text)) if len(text) < _LONGEST else ()
    sizes = [size for _, size in parts]
    if not sizes or min(sizes) < 1 or sum(sizes) > LARGEST:
        raise ExpertError(
            shown(f"{source} has the observation_space Dict {text[:200]}"),
            "a dictionary of vectors and choices, without images",
            ITSELF + " with probes=0" * (_IMAGE in sizes),
        )
    return Observed(sum(sizes), parts)


def check_parts(parts: tuple[tuple[str, int], ...], layout: Layout, source: str) -> None:
    """Refuse an agent of dictionaries in an environment of others.

    Args:
        parts: Of the agent; () where it knows no dictionary.
        layout: Of the environment's observations.
        source: Name of the zip.

    Raises:
        ExpertError: If parts of other names, sizes or order stand in the flat form.
    """
    theirs = tuple((part.name, part.size) for part in layout.parts)
    if parts and not layout.plain and parts != theirs:
        raise ExpertError(
            f"{source} observes {_text(parts)}",
            f"{_text(theirs)}, as the environment",
            "pass the environment that the agent was trained in",
        )


def _parts(text: str) -> Iterator[tuple[str, int]]:
    """Yield name and size of each part; 0 where the text can't be read, `_IMAGE` of an image."""
    found = _INSIDE.fullmatch(text)
    inside, position = found[1] if found else "", 0
    while position < len(inside):
        entry = _ENTRY.match(inside, position)
        if entry is None:
            yield "", 0
            return
        yield ast.literal_eval(entry[1] or entry[2]), _size(entry)
        position = entry.end()


def _size(entry: re.Match[str]) -> int:
    if entry["shape"] is None:
        return sum(int(word) for word in (entry["count"] or entry["counts"]).split())
    sides = [int(word) for word in entry["shape"].replace(",", " ").split()]
    image = len(sides) == 3 and entry["dtype"] == "uint8"
    return _IMAGE if image else math.prod(sides)


def _text(parts: tuple[tuple[str, int], ...]) -> str:
    return shown(", ".join(f"{name} ({size})" for name, size in parts))
