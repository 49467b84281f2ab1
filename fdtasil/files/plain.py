"""Frozen dataclasses of numbers, texts and tuples of them as plain JSON values, and back."""

from collections.abc import Mapping
from typing import Any, TypeVar

__all__ = ["from_plain", "to_plain"]

Kind = TypeVar("Kind")


def to_plain(instance: object) -> dict[str, Any]:
    """Return the fields by name; tuples become lists."""
    return {name: list(v) if isinstance(v, tuple) else v for name, v in vars(instance).items()}


def from_plain(kind: type[Kind], fields: Mapping[str, Any]) -> Kind:
    """Return the instance whose fields `to_plain` returned.

    Raises:
        TypeError: If it has other fields.
    """
    return kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()})
