"""Frozen dataclasses of numbers, texts and tuples of them as plain JSON values, and back."""

import math
import types
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

__all__ = ["as_kind", "from_plain", "to_plain", "without_infinities"]

Kind = TypeVar("Kind")


def to_plain(instance: object) -> dict[str, Any]:
    """Return the fields by name; tuples become lists, and dataclasses inside what they have."""
    return {name: _plain(value) for name, value in vars(instance).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return to_plain(value) if is_dataclass(value) else value


def from_plain(kind: type[Kind], fields: Mapping[str, Any]) -> Kind:
    """Return the instance whose fields `to_plain` returned.

    A number that JSON does not have was written as null, and is NaN here.

    Raises:
        TypeError: If it has other fields, or values of other types than the fields'.
    """
    types_ = get_type_hints(kind)
    values = {
        name: as_kind(types_[name], value, name)
        for name, value in fields.items()
        if name in types_
    }
    if values.keys() != fields.keys():
        raise TypeError(f"{kind.__name__} with the fields {', '.join(map(str, fields))[:200]}")
    return kind(**values)


def without_infinities(value: Any, name: str = "") -> tuple[Any, list[str]]:
    """Return plain values with null for each infinite or NaN number, and where those were."""
    if isinstance(value, float) and not math.isfinite(value):
        return None, [name]
    if isinstance(value, Mapping):
        parts = {
            key: without_infinities(v, f"{name}.{key}" if name else key)
            for key, v in value.items()
        }
        plain = {key: part for key, (part, _) in parts.items()}
        return plain, [place for _, places in parts.values() for place in places]
    if isinstance(value, (list, tuple)):
        found = [without_infinities(v, f"{name}[{i}]") for i, v in enumerate(value)]
        return [part for part, _ in found], [place for _, places in found for place in places]
    return value, []


def as_kind(kind: Any, value: Any, name: str) -> Any:
    """Return a JSON value as a type has it.

    Args:
        kind: A number, a text, a Literal, a tuple of them, or one of these or None.
        value: Lists are tuples; null is NaN where a float is wanted.
        name: What the value is called, for the error.

    Raises:
        TypeError: If it is of another type.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return as_kind(inner[0], value, name)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in inner:
            return None
        return as_kind(next(one for one in inner if one is not type(None)), value, name)
    if origin is Literal:
        good = value in inner
    elif origin is tuple:
        return _tuple(inner, value, name)
    elif kind is float:
        value = math.nan if value is None else value
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
    elif kind is int:
        good = isinstance(value, int) and not isinstance(value, bool)
    else:
        good = not isinstance(kind, type) or isinstance(value, kind)
    if not good:
        raise TypeError(f"{name} of type {type(value).__name__}")
    return value


def _tuple(inner: tuple[Any, ...], value: Any, name: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise TypeError(f"{name} of type {type(value).__name__}")
    kinds = [inner[0]] * len(value) if inner[-1] is ... else list(inner)
    if len(kinds) != len(value):
        raise TypeError(f"{name} of length {len(value)}")
    return tuple(as_kind(kind, one, name) for kind, one in zip(kinds, value, strict=True))
