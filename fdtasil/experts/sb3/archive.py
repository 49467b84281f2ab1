"""The zip of an agent: its record as JSON and its weights, within limits, without unpickling."""

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdtasil.errors import ExpertError, first_line
from fdtasil.files.border import reads
from fdtasil.files.reading import from_json, read_limited
from fdtasil.files.storage import sha256

__all__ = ["Archive", "read_archive", "read_file"]

_FILE_LIMIT = 256 * 2**20
# A few kilobytes of zip can unpack to gigabytes, so the sizes are looked at before unpacking.
_MEMBER_LIMITS = {"data": 16 * 2**20, "policy.pth": _FILE_LIMIT, "_stable_baselines3_version": 64}
_AGAIN = "copy or download the file again"
_ZIP = "an agent", "a zip written by save() of stable-baselines3", _AGAIN, ExpertError
_TYPES = (
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    *(torch.int32, torch.int64, torch.uint8, torch.bool),
)


@dataclass(frozen=True)
class Archive:
    """The zip of an agent, read once, so that what is hashed is what is used.

    Attributes:
        path: Where it was.
        content: The whole file.
        record: The member `data`, parsed. The pickles inside are base64 text and stay closed.
    """

    path: Path
    content: bytes
    record: dict[str, Any]

    @property
    def sha256(self) -> str:
        """Of the file."""
        return sha256(self.content)

    def library_version(self) -> str:
        """Return the version of stable-baselines3 that wrote the zip; "unknown" before 0.9."""
        try:
            text = _member(self.path, self.content, "_stable_baselines3_version").decode().strip()
        except (ExpertError, UnicodeDecodeError):
            return "unknown"
        return text if re.fullmatch(r"[\w.+-]+", text) else "unknown"

    @reads(*_ZIP)
    def weights(self) -> dict[str, Tensor]:
        """Read `policy.pth` by name.

        Raises:
            ExpertError: If it is not a plain state dict.
        """
        data = _member(self.path, self.content, "policy.pth")
        _check_inner_size(self.path, data)
        try:
            weights = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        except Exception as error:  # damaged or hostile bytes may raise anything
            raise ExpertError(
                f"{self.path}: policy.pth can't be read: {first_line(error)}",
                "a state dict of plain tensors; anything else could run code",
                _AGAIN,
            ) from error
        if not isinstance(weights, dict) or not all(
            isinstance(name, str) and isinstance(tensor, Tensor) and _is_plain(tensor)
            for name, tensor in weights.items()
        ):
            raise ExpertError(
                f"{self.path}: policy.pth is no state dict", "tensors by name", _AGAIN
            )
        return weights


def _is_plain(tensor: Tensor) -> bool:
    """Whether a tensor has numbers, and of a usual type."""
    dense = tensor.device.type == "cpu" and tensor.layout == torch.strided
    return dense and tensor.dtype in _TYPES


@reads(*_ZIP)
def read_archive(path: Path) -> Archive:
    """Read the zip of an agent.

    Raises:
        ExpertError: If it is missing, not such a zip, damaged, or unpacks to more than the limits.
    """
    content = read_file(path)
    data = _member(path, content, "data")
    try:
        record = from_json(data)
    except ValueError as error:
        raise ExpertError(
            f"{path}: the member data is no JSON: {first_line(error)}",
            "the JSON that stable-baselines3 writes",
            _AGAIN,
        ) from error
    if not isinstance(record, dict):
        raise ExpertError(f"{path}: the member data is no JSON object", "one", _AGAIN)
    return Archive(path, content, record)


def read_file(path: Path) -> bytes:
    """Read a file of at most 256 MiB.

    Raises:
        ExpertError: If it is larger, or can't be read.
    """
    return read_limited(path, _FILE_LIMIT, "a file")


def _member(path: Path, content: bytes, name: str) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            found = [info for info in archive.infolist() if info.filename == name]
            if len(found) != 1:
                raise ExpertError(
                    f"{path} has {len(found)} members named {name}",
                    "a zip written by save() of stable-baselines3, with one",
                    "check that this is the right file, copied whole",
                )
            _check_size(path, name, found[0].file_size)
            return archive.read(found[0])
    except ExpertError:
        raise
    except Exception as error:  # damaged or hostile bytes may raise anything
        raise ExpertError(
            f"{path} is no whole zip ({len(content):,} bytes): {first_line(error)}",
            "a zip written by save() of stable-baselines3",
            _AGAIN,
        ) from error


def _check_inner_size(path: Path, data: bytes) -> None:
    """Refuse a `policy.pth`, which is a zip again, that unpacks to too much."""
    if not data.startswith(b"PK\x03\x04"):  # torch's own test for it
        return  # before 1.6 it was no zip, and not compressed
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as inner:
            size = sum(info.file_size for info in inner.infolist())
    except Exception as error:  # damaged or hostile bytes may raise anything
        raise ExpertError(
            f"{path}: policy.pth can't be read: {first_line(error)}",
            "a whole zip, as torch.save() writes it",
            _AGAIN,
        ) from error
    _check_size(path, "policy.pth", size)


def _check_size(path: Path, name: str, size: int) -> None:
    if size > _MEMBER_LIMITS[name]:
        raise ExpertError(
            f"{path}: {name} unpacks to {size:,} bytes",
            f"at most {_MEMBER_LIMITS[name]:,} bytes",
            "do not use the file: agents with MLP policies are far smaller",
        )
