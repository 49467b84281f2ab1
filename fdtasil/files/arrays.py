"""Arrays out of npz and npy files, whose headers may claim anything; nothing is unpickled."""

import io
import math
import zipfile
from typing import IO

import numpy as np

from fdtasil.files.names import stays_inside
from fdtasil.files.reading import check_unpacked

__all__ = ["array_from_bytes", "arrays_from_bytes"]

_MEMBERS = 64
_LONGEST = 2**26  # of an empty array's axes
_DIMENSIONS = 8
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def arrays_from_bytes(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name.

    Args:
        data: The file, compressed or not. It may unpack to 64 MiB, or to a hundred times its size.

    Raises:
        Exception: Of any kind, where the file is damaged; for `border.reads`.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        names = [member.filename for member in members]
        if len(members) > _MEMBERS or len(set(names)) < len(names):
            raise ValueError(f"{len(members)} members, or two of one name")
        if not all(name.endswith(".npy") and stays_inside(name) for name in names):
            raise ValueError("members that are no arrays")
        check_unpacked(len(data), sum(member.file_size for member in members))
        arrays = {}
        for member in members:
            with archive.open(member) as file:
                arrays[member.filename.removesuffix(".npy")] = _read(file, member.file_size)
        return arrays


def array_from_bytes(data: bytes) -> np.ndarray:
    """Return the array of an npy file; see `arrays_from_bytes`."""
    return _read(io.BytesIO(data), len(data))


def _read(file: IO[bytes], size: int) -> np.ndarray:
    """Read an array from a file of `size` bytes."""
    version = np.lib.format.read_magic(file)
    shape, fortran, dtype = _HEADERS[version](file)
    if dtype.kind not in "biuf" or not 0 < dtype.itemsize <= 16:
        raise ValueError(f"an array of {dtype}")
    if len(shape) > _DIMENSIONS or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"an array of shape {shape}")
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape} in {size:,} bytes")
    if 0 in shape and max(shape) > _LONGEST:
        raise ValueError(f"an array of shape {shape}")
    array = np.empty(shape[::-1] if fortran else shape, dtype)
    content = file.read(array.nbytes)
    if len(content) != array.nbytes or file.read(1):
        raise ValueError(f"{len(content):,} bytes of an array with {array.nbytes:,}")
    array.reshape(-1)[...] = np.frombuffer(content, dtype)
    return array.T if fortran else array
