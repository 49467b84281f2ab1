"""The experts that the project ships: what the manifest says of them, and where their files are.

A wheel holds the manifest and one small file; the source tree holds all of them.
"""

import difflib
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.parse import quote
from urllib.request import urlopen

from fdtasil.errors import ExpertError, SettingError, StorageError, first_line, without_secrets
from fdtasil.files.reading import read_limited
from fdtasil.files.storage import sha256, write_bytes

__all__ = ["ShippedExpert", "fetch_expert", "shipped_experts"]

_HOUSE = Path(__file__).parent.parent
_LIMIT = 2**24  # bytes; twenty times the largest
_TIMEOUT = 60.0  # seconds
_A_SOURCE = (
    "write --source and the folder `experts` of a copy of the repository, "
    "or the http(s) address of such a folder"
)


@dataclass(frozen=True)
class ShippedExpert:
    """What the manifest says of an expert.

    Attributes:
        environment: The gymnasium id that it acts in.
        file: Its name, of an ONNX file.
        sha256: Of the file, hexadecimal.
        returns: Mean return of an episode, by the steps after which it is cut.
        path: The file, where it came with this installation; else None.
    """

    environment: str
    file: str
    sha256: str
    returns: Mapping[int, float]
    path: Path | None


def shipped_experts() -> dict[str, ShippedExpert]:
    """Return what the manifest says of each expert, by name.

    Raises:
        ExpertError: If the manifest did not come with this installation.

    Example:
        >>> shipped_experts()["InvertedDoublePendulum-v5"].returns[1000]
        9359.84
    """
    shipped = _HOUSE / "shipped"  # in a wheel
    folder = shipped if shipped.is_dir() else _HOUSE.parent / "experts"
    manifest = read_limited(
        folder / "MANIFEST.toml",
        _LIMIT,
        "the manifest of the shipped experts",
        "install the wheel, or work in a copy of the whole repository",
    )
    entries = tomllib.loads(manifest.decode())
    return {name: _read(entry, folder) for name, entry in entries.items()}


def _read(entry: dict, folder: Path) -> ShippedExpert:
    path = folder / entry["file"]
    return ShippedExpert(
        environment=entry["environment"],
        file=entry["file"],
        sha256=entry["sha256"],
        returns={int(steps): found["mean"] for steps, found in entry["returns"].items()},
        path=path if path.is_file() else None,
    )


def fetch_expert(name: str, out: Path, source: str | None = None) -> Path:
    """Write the file of a shipped expert into a folder, after comparing its sha256.

    Args:
        name: Of the expert in the manifest.
        out: The folder; made if need be. A file that is there already is kept if it is the same.
        source: Folder, or http(s) address of a folder, that has the file; default: this
            installation.

    Returns:
        The path of the file.

    Raises:
        SettingError: If no shipped expert has this name.
        ExpertError: If the source does not have the file, or has another one of this name.
        StorageError: If another file of this name is in the folder, or it can't be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(fetch_expert("InvertedDoublePendulum-v5", Path(folder)).name)
        InvertedDoublePendulum-v5.onnx
    """
    known = shipped_experts()
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"write {near[0]}" if near else "choose one of these"
        raise SettingError(f"no shipped expert {name!r}", f"one of {', '.join(known)}", hint)
    expert, target = known[name], out / known[name].file
    if target.exists():
        if sha256(read_limited(target, _LIMIT, "an expert")) != expert.sha256:
            raise StorageError(
                f"{target} is there, and is another file than the shipped expert",
                f"the same file (sha256 {expert.sha256}), or none",
                "move it away, or write another folder with --out",
            )
        return target
    data, origin = _taken(name, expert, source)
    if sha256(data) != expert.sha256:
        raise ExpertError(
            f"{origin} has {len(data):,} bytes with the sha256 {sha256(data)}",
            f"the sha256 {expert.sha256} of the manifest",
            "take the file from the version of the project that is installed",
        )
    write_bytes(target, data)
    return target


def _taken(name: str, expert: ShippedExpert, source: str | None) -> tuple[bytes, str]:
    """Return what a source has under the name of an expert's file, and where it was."""
    if source is None:
        if expert.path is None:
            raise ExpertError(
                f"the file of {name} did not come with this installation",
                "a source that has it",
                _A_SOURCE,
            )
        return read_limited(expert.path, _LIMIT, "an expert"), str(expert.path)
    from fdtasil.experts.http_expert import is_http_url  # torch comes with it, and takes seconds

    if is_http_url(source):
        address = f"{source.rstrip('/')}/{quote(expert.file)}"
        return _download(address), without_secrets(address)
    path = Path(source) / expert.file
    return read_limited(path, _LIMIT, f"the file of {name}", _A_SOURCE), str(path)


def _download(address: str) -> bytes:
    shown, end, data = without_secrets(address), time.monotonic() + _TIMEOUT, bytearray()
    try:
        with urlopen(address, timeout=_TIMEOUT) as answer:
            while part := answer.read1(65536):
                data += part
                # A socket's timeout begins anew with every byte that comes.
                if time.monotonic() > end:
                    raise TimeoutError(f"no end after {_TIMEOUT:g} s")
                if len(data) > _LIMIT:
                    raise OSError(f"more than {_LIMIT:,} bytes")
    except (OSError, HTTPException, ValueError) as error:
        raise ExpertError(
            f"{shown} can't be fetched: {first_line(error)}",
            "an address that answers with the file",
            f"check it, or {_A_SOURCE}",
        ) from error
    return bytes(data)
