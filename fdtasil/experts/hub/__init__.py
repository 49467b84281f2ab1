"""Files of the Hugging Face hub, by `hf://org/repo/file[@revision]`, pinned to their commit.

huggingface_hub is imported inside the functions: it is an extra, and `import fdtasil` stays light.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from fdtasil.errors import ExpertError, first_line
from fdtasil.experts.hub.requests import download, look_up, no_file
from fdtasil.experts.hub.uri import COMMIT, HubUri, is_hub_uri, parse
from fdtasil.experts.sb3.statistics import statistics_beside
from fdtasil.files.names import stays_inside
from fdtasil.files.onnx.model import side_files
from fdtasil.files.reading import FILE_LIMIT, read_limited
from fdtasil.files.storage import sha256, write_bytes

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoSibling

__all__ = ["HubFile", "fetch", "is_hub_uri"]


@dataclass(frozen=True)
class HubFile:
    """A file of the hub that is on this machine.

    Attributes:
        path: A plain file; the side files that an ONNX model declares are where it says.
        uri: What was fetched, with the commit as its revision.
    """

    path: Path
    uri: str


def fetch(uri: str | Path) -> HubFile:
    """Fetch a file of the hub with the side files that it declares, unless they are here already.

    What is here under a commit's name needs no network. Nothing else of the repository is fetched,
    and no code of it is run. A token is sent where huggingface_hub is configured with one.

    Args:
        uri: `hf://org/repo/file`, with `@` and a branch, tag or commit after it if not the newest.

    Returns:
        The file, and its URI with the commit that the revision stands for now.

    Raises:
        ExpertError: If there is no such file that the user may read, or no hub that answers
            within seconds.
        StorageError: If the file can't be written.

    Example::

        walker = fetch("hf://org/repo/walker.onnx")
        print(walker.uri)  # hf://org/repo/walker.onnx@<commit>
    """
    named = parse(str(uri))
    _check_library()
    if not COMMIT.fullmatch(named.revision or ""):
        named, _ = look_up(named)
    path = _stored(named)
    for name in _declared(path):
        file = str(PurePosixPath(named.file).parent / name)
        _stored(replace(named, file=file))
    return HubFile(path, str(named))


def _check_library() -> None:
    try:
        import huggingface_hub  # noqa: F401
    except Exception as error:  # it also raises where its variables have odd values
        raise ExpertError(
            f"huggingface_hub can't be imported: {first_line(error)}",
            "huggingface_hub, for experts by hf://",
            'pip install "fdtasil[hub]", or download the file and name its path',
        ) from error


def _declared(path: Path) -> list[str]:
    """Return the side files that a model declares beside or below itself.

    Other names are left to `read_model`, which refuses them, and so is what is no model.
    """
    if path.suffix == ".zip":
        return []
    return sorted(
        name
        for name in side_files(read_limited(path, FILE_LIMIT, "a file of the hub"))
        if stays_inside(name)
    )


def _stored(uri: HubUri) -> Path:
    """Return the plain file that holds a file of a commit, after fetching it if need be.

    The hub's own cache keeps links into a folder of blobs, without the files' names: a model
    would not find its side files there, and `read_model` rightly refuses links. So plain files
    are kept, in the part of the cache that huggingface_hub has for other libraries.
    """
    path = _folder(uri) / uri.file
    if not os.path.isfile(path):
        uri, files = look_up(uri)
        if files and uri.file not in files:
            raise no_file(uri, sorted(files))
        _check_statistics(uri, files)
        check = _hash_of(uri, files.get(uri.file))
        data = download(uri)
        check(data)
        write_bytes(path, data)
    return path


def _folder(uri: HubUri) -> Path:
    from huggingface_hub import cached_assets_path

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    root = os.environ.get("HF_ASSETS_CACHE")
    try:
        return cached_assets_path("fdtasil", uri.repo, uri.revision or "", assets_dir=root)
    except (OSError, ValueError) as error:
        raise ExpertError(
            f"there is no room for files of the hub: {first_line(error)}",
            "a cache folder that can be written",
            "set HF_HOME or HF_ASSETS_CACHE to one",
        ) from error


def _check_statistics(uri: HubUri, files: "dict[str, RepoSibling]") -> None:
    """Refuse to leave out statistics that `read_agent` would find beside a zip on disk."""
    agent = PurePosixPath(uri.file)
    found = statistics_beside(agent, {PurePosixPath(name) for name in files})
    if agent.suffix == ".zip" and found:
        raise ExpertError(
            f"{str(found[0])!r} lies beside {uri} and looks like its observation statistics",
            "an agent without statistics",
            "download both; `fdtasil export-sb3 --vecnormalize` makes one ONNX file of them",
        )


def _hash_of(uri: HubUri, described: "RepoSibling | None") -> Callable[[bytes], None]:
    """Return what refuses bytes that are not the file's: they would be kept for ever.

    A proxy or a broken connection makes others of them; so does a mirror that names no hash.
    """
    if described is not None and described.lfs is not None and described.lfs.sha256:
        expected, hashed = described.lfs.sha256, sha256
    elif described is not None and described.lfs is None and described.blob_id:
        expected, hashed = described.blob_id, _git_name
    else:
        raise ExpertError(
            f"the list of files of {uri.repo} has no hash of {uri.file}",
            "a hub that names the hash of each file",
            "unset HF_ENDPOINT; or download the file, look at it, and name its path",
        )

    def check(data: bytes) -> None:
        if hashed(data) != expected:
            raise ExpertError(
                f"{uri} arrived with {len(data):,} bytes and the hash {hashed(data)}",
                f"the hash {expected} that the hub names",
                "try again; if it stays so, something between here and the hub changes files",
            )

    return check


def _git_name(data: bytes) -> str:
    """Return how git names the content of a file."""
    return hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()
