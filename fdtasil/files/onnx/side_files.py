"""Weights that an ONNX model keeps in files of their own: inside its folder, or not at all.

Read here and not by onnx or onnxruntime: what is hashed is then what is used, and one rule holds
for all tensors, also those of attributes, sub-graphs and functions, whatever the versions.
"""

import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fdtasil.errors import ExpertError, first_line, shown
from fdtasil.files.storage import stays_inside

if TYPE_CHECKING:
    import onnx

__all__ = ["load_side_files", "names_of_side_files"]


def names_of_side_files(model: "onnx.ModelProto") -> set[str]:
    """Return the side files that a model names, whatever they are."""
    return {_entries(tensor).get("location", "") for tensor in _outside(model)}


def load_side_files(model: "onnx.ModelProto", path: Path, room: int) -> bytes:
    """Put the weights of a model's side files into the model.

    Args:
        model: Changed in place.
        path: Its file.
        room: Bytes that the side files may have together.

    Returns:
        The side files' content, in the order of their names.

    Raises:
        ExpertError: If one is not a plain file below the model's folder, is reached by a link, is
            too large, or does not have what the model says.
    """
    import onnx

    folder, files = path.resolve().parent, {}
    for name in sorted(names_of_side_files(model)):
        try:
            files[name] = _read(folder, name, room)
        except (OSError, ValueError) as error:
            raise _unusable(path, folder, name, first_line(error)) from error
        room -= len(files[name])
    for tensor in list(_outside(model)):
        entries = _entries(tensor)
        name = entries.get("location", "")
        try:
            tensor.raw_data = _part(files[name], entries)
        except ValueError as error:
            raise _unusable(path, folder, name, first_line(error)) from error
        del tensor.external_data[:]
        tensor.data_location = onnx.TensorProto.DEFAULT
    return b"".join(files.values())


def _outside(message: Any) -> Iterator["onnx.TensorProto"]:
    """Yield the tensors, wherever they are in a message, whose data are elsewhere."""
    import onnx

    if isinstance(message, onnx.TensorProto):
        if message.data_location == onnx.TensorProto.EXTERNAL:
            yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in [value] if hasattr(value, "ListFields") else value:
                yield from _outside(part)


def _entries(tensor: "onnx.TensorProto") -> dict[str, str]:
    # Damaged text, which is not UTF-8, comes as bytes.
    return {str(entry.key): str(entry.value) for entry in tensor.external_data}


def _read(folder: Path, name: str, room: int) -> bytes:
    """Read a file below a folder, without following a link."""
    path = folder / name
    if not stays_inside(name):
        raise ValueError("the name leads out of the model's folder")
    if path.resolve() != path:
        raise ValueError("a link leads to it")
    # What is not a plain file may wait for ever when it is opened.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with open(os.open(path, flags | getattr(os, "O_BINARY", 0)), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("it is no plain file")
        if about.st_nlink > 1:
            raise ValueError("a hard link leads to it")
        if about.st_size > room:
            raise ValueError(f"it has {about.st_size:,} bytes, with {room:,} left of the limit")
        return file.read()


def _part(data: bytes, entries: Mapping[str, str]) -> bytes:
    offset = int(entries.get("offset") or 0)
    length = int(entries["length"]) if entries.get("length") else len(data) - offset
    if offset < 0 or length < 0 or offset + length > len(data):
        raise ValueError(f"there are no {length} bytes from {offset} on, of {len(data):,}")
    return data[offset : offset + length]


def _unusable(path: Path, folder: Path, name: str, problem: str) -> ExpertError:
    next_step = "copy both files together under their old names"
    if path.is_symlink():  # as in the hub's own cache, whose files have lost their names
        next_step += ", or name a file of the hub by hf://org/repo/file"
    return ExpertError(
        f"{path} keeps weights in {shown(name) or 'a file without a name'}: {problem}",
        f"a plain file of that name in {folder}, without links",
        f"{next_step}, or export with external_data=False",
    )
