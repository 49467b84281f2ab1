"""Spaces as vectors: which number of a flat observation or action stands for what.

Inside the library everything is (B, n) and (B, m); this is the one border to dictionaries, tuples,
stacks of frames and choices.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, get_args

import gymnasium
import numpy as np

__all__ = [
    "Layout",
    "Mismatch",
    "Part",
    "Spaces",
    "UnknownSpace",
    "flat_layout",
    "layout_of",
    "to_numpy",
]

Kind = Literal["number", "whole", "flag", "choice"]
"""A float, an integer, a boolean, or one of several: a score (or a one-hot number) for each."""


class UnknownSpace(Exception):
    """A space that has no flat form.

    Args:
        where: Name of the part, or "".
        space: What stands there.
        role: "observations" or "actions".
    """

    def __init__(self, where: str, space: object, role: str) -> None:
        super().__init__(f"{role} {space}" if not where else f"{role} whose {where!r} is {space}")


class Mismatch(Exception):
    """A value that its space does not have; the text says what was found, and what is promised."""


@dataclass(frozen=True)
class Part:
    """One array of a space.

    Attributes:
        path: Keys of dictionaries and numbers of tuples that lead to it; () for the space itself.
        kind: What its numbers are.
        shape: Of the array.
        dtype: Of the array.
        sizes: Of a choice, the number of possibilities of each entry of the array.
        first: Of a choice, the value of the first possibility of each entry.
    """

    path: tuple[str | int, ...]
    kind: Kind
    shape: tuple[int, ...]
    dtype: str
    sizes: tuple[int, ...] = ()
    first: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Its path as a text."""
        return "/".join(map(str, self.path))

    @property
    def size(self) -> int:
        """How many numbers of the flat form it has."""
        return sum(self.sizes) if self.kind == "choice" else math.prod(self.shape)

    def rows(self, values: Any) -> np.ndarray:
        """Return (B, size) float64 of B values; a choice may be given by its scores.

        Raises:
            Mismatch: If they have another shape, or are no numbers.
        """
        given = _numbers(values, self.name)
        flat = given.reshape(len(given), math.prod(given.shape[1:]))
        if self.kind == "choice" and flat.shape == (len(given), len(self.sizes)):
            return self._one_hot(flat)
        # Scores, or numbers that somebody has laid in a row.
        in_a_row = given.shape == flat.shape == (len(given), self.size)
        if not in_a_row and given.shape[1:] != self.shape:
            what = f"{self.name!r} of " if self.path else ""
            raise Mismatch(f"{what}the shape {given.shape[1:]}, where {self.shape} is promised")
        return flat.astype(np.float64, copy=False)

    def values(self, rows: np.ndarray) -> np.ndarray:
        """Return (B, *shape) of (B, size): the best of each choice, numbers in their own type."""
        if self.kind == "choice":
            found, start = np.empty((len(rows), len(self.sizes)), np.int64), 0
            for entry, (size, first) in enumerate(zip(self.sizes, self.first, strict=True)):
                found[:, entry] = first + rows[:, start : start + size].argmax(axis=1)
                start += size
            return found.reshape(len(rows), *self.shape).astype(self.dtype, copy=False)
        if self.kind != "number":
            rows = np.rint(rows)
        return rows.reshape(len(rows), *self.shape).astype(self.dtype, copy=False)

    def _one_hot(self, chosen: np.ndarray) -> np.ndarray:
        hot, start = np.zeros((len(chosen), self.size)), 0
        for entry, (size, first) in enumerate(zip(self.sizes, self.first, strict=True)):
            number = chosen[:, entry] - first
            silent = np.isnan(number)  # no answer stays none
            bad = ~silent & ~np.isin(number, np.arange(size))
            if bad.any():
                last, said = first + size - 1, chosen[bad.argmax(), entry]
                raise Mismatch(f"the choice {said:g}, where {first} to {last} are promised")
            rows = np.flatnonzero(~silent)
            hot[rows, start + number[rows].astype(int)] = 1.0
            hot[silent] = np.nan
            start += size
        return hot


@dataclass(frozen=True)
class Layout:
    """Where the parts of a space stand in its flat form.

    Attributes:
        parts: In their order.

    Example:
        >>> space = gymnasium.spaces.Dict(
        ...     gear=gymnasium.spaces.Discrete(3), goal=gymnasium.spaces.Box(-1, 1, (2,)))
        >>> layout = layout_of(space, "observations")
        >>> layout.size, layout.row({"goal": np.array([0.5, 0.1]), "gear": 2}).tolist()
        (5, [0.0, 0.0, 1.0, 0.5, 0.1])
        >>> layout.columns("goal")
        (3, 4)
    """

    parts: tuple[Part, ...]

    @cached_property
    def size(self) -> int:
        """How many numbers the flat form has."""
        return sum(part.size for part in self.parts)

    @property
    def plain(self) -> bool:
        """Whether the space is its own flat form."""
        only = self.parts[0]
        return not only.path and only.kind == "number" and len(only.shape) == 1

    @property
    def starts(self) -> list[int]:
        """Where each part begins."""
        return [0, *np.cumsum([part.size for part in self.parts])[:-1].tolist()]

    @cached_property
    def choices(self) -> tuple[tuple[int, int], ...]:
        """Start and end of the scores of each choice."""
        found = []
        for part, start in zip(self.parts, self.starts, strict=True):
            ends = start + np.cumsum([0, *part.sizes])
            found += [(int(a), int(b)) for a, b in pairwise(ends)]
        return tuple(found)

    @property
    def order(self) -> str:
        """What stands where in the flat form, "0:2 cart, 2:5 pole"; "" of a single part."""
        if not self.names:
            return ""
        pairs = zip(self.parts, self.starts, strict=True)
        return ", ".join(f"{start}:{start + part.size} {part.name}" for part, start in pairs)

    @property
    def held(self) -> tuple[int, ...]:
        """The numbers that no probe moves, for there is nothing between two of their values."""
        kinds = np.repeat([p.kind == "number" for p in self.parts], [p.size for p in self.parts])
        return tuple(np.flatnonzero(~kinds).tolist())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts; those of an unnamed one are none."""
        return tuple(part.name for part in self.parts if part.path)

    def columns(self, name: str) -> tuple[int, ...]:
        """Return the numbers of a part, or of all parts behind a key.

        Raises:
            KeyError: If there is none of that name.
        """
        found: list[int] = []
        for part, start in zip(self.parts, self.starts, strict=True):
            if part.name == name or part.name.startswith(f"{name}/"):
                found += range(start, start + part.size)
        if not found:
            raise KeyError(name)
        return tuple(found)

    def seen(self, columns: Sequence[int]) -> "Layout":
        """Return the layout of some columns: of whole parts in order, or of plain numbers."""
        kept, found = [], []
        for part, start in zip(self.parts, self.starts, strict=True):
            if start in columns:
                kept.append(part)
                found += range(start, start + part.size)
        return Layout(tuple(kept)) if found == list(columns) else flat_layout(len(columns))

    def read(self, given: Any) -> tuple[np.ndarray, bool]:
        """Return (B, n) float32 of one value or of B of them, and whether it was one.

        Flat numbers, (n,) or (B, n), are taken as well.

        Raises:
            Mismatch: If it is neither.
        """
        first = self.parts[0]
        rows = isinstance(given, np.ndarray) and given.ndim in (1, 2)
        flat = rows and (first.path or first.shape != given.shape)
        if flat and given.shape[-1] == self.size and given.dtype.kind == "f":
            return np.atleast_2d(given).astype(np.float32), given.ndim == 1
        if rows and first.path:
            raise Mismatch(
                f"shape {given.shape} of {given.dtype}, where flat ones are ({self.size},) floats"
            )
        one = np.ndim(to_numpy(_picked(given, first))) == len(first.shape)
        found = self.row(given)[None] if one else self.rows(given)
        return found.astype(np.float32), one

    def row(self, value: Any) -> np.ndarray:
        """Return (n,) float64 of one value.

        Raises:
            Mismatch: If it is not of the space.
        """
        picked = (to_numpy(_picked(value, part)) for part in self.parts)
        return np.concatenate(
            [part.rows(one[None])[0] for part, one in zip(self.parts, picked, strict=True)]
        )

    def rows(self, values: Any) -> np.ndarray:
        """Return (B, n) float64 of B values: arrays whose first axis is the batch's.

        Raises:
            Mismatch: If they are not of the space.
        """
        found = [part.rows(_picked(values, part)) for part in self.parts]
        if len({len(one) for one in found}) > 1:
            raise Mismatch(f"parts of {', '.join(str(len(one)) for one in found)} rows")
        return np.concatenate(found, axis=1)

    def value(self, row: np.ndarray) -> Any:
        """Return the one value of (n,)."""
        return self.joined([(part.path, values[0]) for part, values in self._each(row[None])])

    def values(self, rows: np.ndarray) -> Any:
        """Return the values of (B, n), as arrays whose first axis is the batch's."""
        return self.joined([(part.path, values) for part, values in self._each(rows)])

    def joined(self, parts: Sequence[tuple[tuple[str | int, ...], Any]]) -> Any:
        """Return values at the ends of their paths as the space nests them."""
        return _joined(parts, bool(self.parts[0].path))

    def best(self, rows: np.ndarray) -> np.ndarray:
        """Return (B, c), which score of each choice is the best."""
        return np.stack([rows[:, a:b].argmax(axis=1) for a, b in self.choices], axis=1)

    def done(self, row: np.ndarray) -> np.ndarray:
        """Return (m,) what was done by an action: of a choice a one for the best score."""
        if not self.choices:
            return row
        done = np.array(row, np.float64)
        for start, end in self.choices:
            best = int(done[start:end].argmax())
            done[start:end] = np.arange(end - start) == best
        return done

    def centred(self, rows: np.ndarray) -> np.ndarray:
        """Return rows with scores that sum to zero: a number added to all changes no choice."""
        for start, end in self.choices:
            rows[:, start:end] -= rows[:, start:end].mean(axis=1, keepdims=True)
        return rows

    def _each(self, rows: np.ndarray) -> Iterator[tuple[Part, np.ndarray]]:
        for part, start in zip(self.parts, self.starts, strict=True):
            yield part, part.values(rows[:, start : start + part.size])

    def to_json(self) -> list[dict[str, Any]]:
        """Return the layout as plain JSON values."""
        return [
            {name: list(v) if isinstance(v, tuple) else v for name, v in vars(part).items()}
            for part in self.parts
        ]

    @classmethod
    def from_json(cls, entries: Sequence[Mapping[str, Any]]) -> "Layout":
        """Read what `to_json` returned.

        Raises:
            ValueError: If it is something else.
        """
        parts = []
        for entry in entries:
            sizes, first = tuple(map(int, entry["sizes"])), tuple(map(int, entry["first"]))
            shape, dtype = tuple(map(int, entry["shape"])), np.dtype(str(entry["dtype"]))
            path = tuple(k if isinstance(k, int) else str(k) for k in entry["path"])
            count = math.prod(shape) if entry["kind"] == "choice" else 0
            good = entry["kind"] in get_args(Kind) and len(sizes) == len(first) == count
            if not good or min((1, *shape, *sizes)) < 1 or dtype.kind not in "biuf":
                raise ValueError(f"a part {path} that no space has")
            parts.append(Part(path, entry["kind"], shape, dtype.name, sizes, first))
        found = cls(tuple(parts))
        if not parts or not _is_nested([part.path for part in parts]) or found.size > _LARGEST:
            raise ValueError("no parts, parts inside others, or larger than any space")
        return found


@dataclass(frozen=True)
class Spaces:
    """The two spaces of an environment.

    Attributes:
        observations: Of n numbers.
        actions: Of m numbers.
    """

    observations: Layout
    actions: Layout

    @property
    def plain(self) -> bool:
        """Whether both are their own flat forms."""
        return self.observations.plain and self.actions.plain

    @property
    def unless_plain(self) -> "Spaces | None":
        """Return them where they say more than sizes, else None."""
        return None if self.plain else self

    @classmethod
    def of(cls, source: Any) -> "Spaces":
        """Read the spaces of an environment, a vector of them, or a dataset.

        Args:
            source: Has an `observation_space` and an `action_space`.

        Raises:
            UnknownSpace: If one of them has no flat form.
        """
        return cls(
            layout_of(source.observation_space, "observations"),
            layout_of(source.action_space, "actions"),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the spaces as plain JSON values."""
        return {name: layout.to_json() for name, layout in vars(self).items()}

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> "Spaces":
        """Read what `to_json` returned.

        Raises:
            ValueError: If it is something else.
        """
        return cls(*(Layout.from_json(fields[name]) for name in ("observations", "actions")))


_LARGEST = 2**24  # numbers: a space of more is none that was written by us


def _is_nested(paths: Sequence[tuple[str | int, ...]]) -> bool:
    """Whether paths are the ends of nested dictionaries and tuples, each of one kind of key."""
    if paths == [()]:
        return True
    if () in paths or len({type(path[0]) for path in paths}) != 1:
        return False
    inner: dict[str | int, list[tuple[str | int, ...]]] = {}
    for path in paths:
        inner.setdefault(path[0], []).append(path[1:])
    whole = not isinstance(paths[0][0], int) or list(inner) == list(range(len(inner)))
    return whole and all(map(_is_nested, inner.values()))


def flat_layout(size: int) -> Layout:
    """Return the layout of plain numbers."""
    return Layout((Part((), "number", (size,), "float32"),))


def layout_of(space: gymnasium.Space, role: str) -> Layout:
    """Return the layout of a space.

    Args:
        space: Box, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of them.
        role: "observations" or "actions": of the latter, whole numbers and flags are choices.

    Raises:
        UnknownSpace: If it, or a part of it, is another.
    """
    return Layout(tuple(_parts(space, (), role)))


def _parts(space: Any, path: tuple[str | int, ...], role: str) -> Iterator[Part]:
    spaces, where = gymnasium.spaces, "/".join(map(str, path))
    if isinstance(space, spaces.Dict | spaces.Tuple) and len(space.spaces):
        inner = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        numbered = isinstance(space, spaces.Tuple)
        for key, one in inner:
            if not numbered and not (isinstance(key, str) and key and "/" not in key):
                raise UnknownSpace(where, f"a dictionary with the key {key!r}", role)
            yield from _parts(one, (*path, key), role)
        return
    acted, dtype = role == "actions", str(space.dtype)
    if isinstance(space, spaces.Discrete) and space.n > 1:
        yield Part(path, "choice", (), dtype, (int(space.n),), (int(space.start),))
    elif isinstance(space, spaces.MultiDiscrete) and space.nvec.size and space.nvec.min() > 1:
        sizes, first = space.nvec.ravel().tolist(), space.start.ravel().tolist()
        yield Part(path, "choice", space.nvec.shape, dtype, tuple(sizes), tuple(first))
    elif isinstance(space, spaces.MultiBinary) and acted:
        count = int(np.prod(space.shape))
        yield Part(path, "choice", space.shape, dtype, (2,) * count, (0,) * count)
    elif isinstance(space, spaces.MultiBinary):
        yield Part(path, "flag", space.shape, dtype)
    elif isinstance(space, spaces.Box) and int(np.prod(space.shape, dtype=int)) > 0:
        kind = {"f": "number", "b": "flag"}.get(np.dtype(space.dtype).kind, "whole")
        if acted and kind != "number":
            raise UnknownSpace(where, space, role)
        yield Part(path, kind, space.shape, dtype)  # pyright: ignore[reportArgumentType]
    else:
        raise UnknownSpace(where, space, role)


def _picked(value: Any, part: Part) -> Any:
    found: Any = value
    for key in part.path:
        if not isinstance(found, Mapping if isinstance(key, str) else tuple | list):
            raise Mismatch(f"a {type(found).__name__}, where {part.name!r} is promised")
        try:
            found = found[key]  # pyright: ignore[reportArgumentType, reportCallIssue]
        except (KeyError, IndexError):
            raise Mismatch(f"nothing for {part.name!r}, which is promised") from None
    return found


def to_numpy(value: Any) -> np.ndarray:
    """Return what may be a torch tensor, on whatever device, as an array."""
    return value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)


def _numbers(values: Any, name: str) -> np.ndarray:
    found = to_numpy(values)
    if found.dtype.kind not in "biuf" or np.ma.is_masked(values) or found.ndim == 0:
        what = f"{name!r} of " if name else ""
        raise Mismatch(f"{what}{found.dtype} and shape {found.shape}, where numbers are promised")
    return found


def _joined(pairs: Sequence[tuple[tuple[str | int, ...], Any]], nested: bool) -> Any:
    """Return values at the ends of their paths as nested dictionaries and tuples."""
    if not nested:
        return pairs[0][1]
    keys = list(dict.fromkeys(path[0] for path, _ in pairs))
    inner = {}
    for key in keys:
        mine = [(path[1:], value) for path, value in pairs if path[0] == key]
        inner[key] = _joined(mine, bool(mine[0][0]))
    return tuple(inner.values()) if isinstance(keys[0], int) else inner
