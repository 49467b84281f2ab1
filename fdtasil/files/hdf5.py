"""A look into an HDF5 file before a library reads it: such a file may name any other file."""

import importlib
from pathlib import Path
from typing import Any

from fdtasil.files.names import stays_inside
from fdtasil.files.reading import FILE_LIMIT, check_unpacked, read_plain

__all__ = ["check_hdf5"]

_OBJECTS = 10**6


def check_hdf5(path: Path) -> None:
    """Refuse a file with links, with data in other files, or that unpacks to far more than it has.

    Args:
        path: The file. It may unpack to 64 MiB, or to a hundred times its size.

    Raises:
        ValueError: If it has any of these.
        Exception: Of any kind, where the file is damaged; for `border.reads`.
    """
    h5py: Any = importlib.import_module("h5py")  # whose stubs leave half of it out
    read_plain(path, FILE_LIMIT, follow=False)
    size, todo, seen, unpacked = path.stat().st_size, [], set[int](), 0
    with h5py.File(path, "r") as file:
        todo.append(file["/"])
        while todo:
            group: Any = todo.pop()
            address = h5py.h5o.get_info(group.id).addr
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > _OBJECTS:
                raise ValueError(f"more than {_OBJECTS:,} objects")
            for name in group:
                if not stays_inside(name):
                    raise ValueError(f"an object named {name!r}")
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise ValueError(f"{name} is a link")
                member = group[name]
                if isinstance(member, h5py.Group):
                    todo.append(member)
                elif isinstance(member, h5py.Dataset):
                    unpacked += _checked(member)
            check_unpacked(size, unpacked)


def _checked(data: Any) -> int:
    """Return how many bytes a dataset has in memory, all of them in its own file."""
    if data.external or data.is_virtual:
        raise ValueError(f"{data.name} keeps its data in another file")
    if data.dtype.hasobject and data.dtype.metadata is None:
        raise ValueError(f"{data.name} has the type {data.dtype}")
    return int(data.size or 0) * max(1, data.dtype.itemsize)
