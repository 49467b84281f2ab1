"""Tensors with a description, as one safetensors file; equal contents give equal bytes."""

import json
from collections.abc import Mapping
from typing import Any

import safetensors.torch
from torch import Tensor

from fdtasil.files.border import reads
from fdtasil.files.reading import from_json

__all__ = ["tensors_from_bytes", "tensors_to_bytes"]


def tensors_to_bytes(tensors: Mapping[str, Tensor], about: Mapping[str, Any], entry: str) -> bytes:
    """Return a safetensors file.

    Args:
        tensors: By name.
        about: Plain JSON values.
        entry: Name of the metadata entry that holds them as one text: safetensors writes several
            entries in an order that differs from run to run.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return safetensors.torch.save(plain, {entry: json.dumps(about)})


def tensors_from_bytes(data: bytes, entry: str, what: str) -> tuple[dict[str, Tensor], Any]:
    """Read what `tensors_to_bytes` wrote: tensors by name, and what was said about them.

    Args:
        data: The file.
        entry: As it was written.
        what: What the file should be, for the error.

    Raises:
        StorageError: If it is no such file.
    """
    wanted = what, "a file written by fdtasil", "check the path, or save again"
    return reads(*wanted)(_read)(data, entry)


def _read(data: bytes, entry: str) -> tuple[dict[str, Tensor], Any]:
    tensors = safetensors.torch.load(data)
    size = int.from_bytes(data[:8], "little")
    about = from_json(data[8 : 8 + size])["__metadata__"][entry]
    return tensors, from_json(about.encode())
