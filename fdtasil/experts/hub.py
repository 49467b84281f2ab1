"""Files of the Hugging Face hub, by `hf://org/repo/file[@revision]`, pinned to their commit.

huggingface_hub is imported inside the functions: it is an extra, and `import fdtasil` stays light.
"""

import fnmatch
import hashlib
import os
import queue
import re
import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, TypeGuard, TypeVar

from fdtasil.errors import ExpertError, first_line
from fdtasil.onnx_files import side_files
from fdtasil.storage import sha256, stays_inside, write_bytes

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoSibling

__all__ = ["HubFile", "fetch", "is_hub_uri"]

Part = TypeVar("Part")

_SCHEME = "hf:"
# The hub's own names for other kinds of repositories come first in their URIs.
_URI = re.compile(
    r"hf://(?!(?:models|datasets|spaces|kernels|buckets)/)"
    r"(?P<repo>[\w.-]+/[\w.-]+)/(?P<file>[^@]+)(?:@(?P<revision>[^@\s]+))?",
    re.ASCII,
)
_COMMIT = re.compile(r"[0-9a-f]{40}")
_PATIENCE = 6.0  # seconds without a sign of life after which the hub counts as out of reach
_SIZE_LIMIT = 2**31  # no ONNX model is larger with its weights: it is one protobuf message


@dataclass(frozen=True)
class HubFile:
    """A file of the hub that is on this machine.

    Attributes:
        path: A plain file; the side files that an ONNX model declares are where it says.
        uri: What was fetched, with the commit as its revision.
    """

    path: Path
    uri: str


@dataclass(frozen=True)
class _Place:
    """A file of a model repository; the revision None is the newest of the default branch."""

    repo: str
    file: str
    revision: str | None

    def __str__(self) -> str:
        return f"hf://{self.repo}/{self.file}" + (f"@{self.revision}" if self.revision else "")


def is_hub_uri(source: object) -> TypeGuard[str | Path]:
    """Whether an expert is named by its place on the hub, rightly spelt or not.

    Example:
        >>> is_hub_uri("hf://org/repo/walker.onnx"), is_hub_uri("walker.onnx")
        (True, False)
    """
    return isinstance(source, (str, Path)) and str(source).startswith(_SCHEME)


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
    place = _parse(str(uri))
    _check_library()
    if not _COMMIT.fullmatch(place.revision or ""):
        place, _ = _look_up(place)
    path = _stored(place)
    for name in _declared(path):
        file = str(PurePosixPath(place.file).parent / name)
        _stored(replace(place, file=file))
    return HubFile(path, str(place))


def _parse(text: str) -> _Place:
    found = _URI.fullmatch(text)
    if not found or not stays_inside(found["file"]):
        raise _malformed(text)
    return _Place(found["repo"], str(PurePosixPath(found["file"])), found["revision"])


def _malformed(text: str) -> ExpertError:
    return ExpertError(
        f"{text!r} names no file of the hub",
        "hf://org/repo/file or hf://org/repo/file@revision of a model repository",
        "write it like that, as text (a Path drops a slash)",
    )


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
    return sorted(name for name in side_files(path.read_bytes()) if stays_inside(name))


def _stored(place: _Place) -> Path:
    """Return the plain file that holds a file of a commit, after fetching it if need be.

    The hub's own cache keeps links into a folder of blobs, without the files' names: a model
    would not find its side files there, and `read_model` rightly refuses links. So plain files
    are kept, in the part of the cache that huggingface_hub has for other libraries.
    """
    path = _folder(place) / place.file
    if not os.path.isfile(path):
        place, files = _look_up(place)
        if files and place.file not in files:
            raise _no_file(place, sorted(files))
        _check_statistics(place, files)
        data = _download(place)
        _check_whole(place, data, files.get(place.file))
        write_bytes(path, data)
    return path


def _folder(place: _Place) -> Path:
    from huggingface_hub import cached_assets_path

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    root = os.environ.get("HF_ASSETS_CACHE")
    try:
        return cached_assets_path("fdtasil", place.repo, place.revision or "", assets_dir=root)
    except (OSError, ValueError) as error:
        raise ExpertError(
            f"there is no room for files of the hub: {first_line(error)}",
            "a cache folder that can be written",
            "set HF_HOME or HF_ASSETS_CACHE to one",
        ) from error


def _look_up(place: _Place) -> "tuple[_Place, dict[str, RepoSibling]]":
    """Return the place with its commit, and what the repository holds at it, by name."""
    from huggingface_hub import HfApi

    def answers() -> "Iterator[tuple[_Place, dict[str, RepoSibling]]]":
        info = HfApi(_endpoint()).model_info(
            place.repo, revision=place.revision, files_metadata=True, timeout=2 * _patience()
        )
        pinned = _COMMIT.fullmatch(place.revision or "")
        if not _COMMIT.fullmatch(info.sha or "") or (pinned and info.sha != place.revision):
            raise ValueError(f"its answer names the commit {info.sha!r}")
        files = {sibling.rfilename: sibling for sibling in info.siblings or []}
        yield replace(place, revision=info.sha), files

    return next(_patiently(answers(), place))


def _download(place: _Place) -> bytes:
    """Return a file's bytes."""
    from huggingface_hub import get_session, hf_hub_url
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

    # `hf_hub_download` would do, but for its retries: where nobody answers, it takes minutes.
    def answers() -> Iterator[bytes]:
        url = hf_hub_url(place.repo, place.file, revision=place.revision, endpoint=_endpoint())
        with get_session().stream(
            "GET", url, headers=build_hf_headers(), follow_redirects=True, timeout=2 * _patience()
        ) as response:
            hf_raise_for_status(response)
            yield from response.iter_bytes()

    data = bytearray()
    for part in _patiently(answers(), place):
        data += part
        if len(data) > _SIZE_LIMIT:
            raise ExpertError(
                f"{place} has more than {_SIZE_LIMIT:,} bytes",
                "an ONNX file with its weights, or a stable-baselines3 zip",
                "check that this is the right file",
            )
    return bytes(data)


def _check_statistics(place: _Place, files: "dict[str, RepoSibling]") -> None:
    """Refuse to leave out statistics that `read_agent` would find beside a zip on disk."""
    agent = PurePosixPath(place.file)
    found = [name for name in sorted(files) if _normalises(PurePosixPath(name), agent, files)]
    if agent.suffix == ".zip" and found:
        raise ExpertError(
            f"{found[0]!r} lies beside {place} and looks like its observation statistics",
            "an agent without statistics",
            "download both; `fdtasil export-sb3 --vecnormalize` makes one ONNX file of them",
        )


def _normalises(path: PurePosixPath, agent: PurePosixPath, files: Collection[str]) -> bool:
    if path.parent == agent.parent:
        return fnmatch.fnmatchcase(path.name, "*vec*norm*.pkl")
    # In a folder below, as rl-zoo has it: another agent's are none of this one's business.
    own = path.parent.name == agent.stem or str(path.parent / "config.yml") in files
    return path.parent.parent == agent.parent and path.name == "vecnormalize.pkl" and own


def _check_whole(place: _Place, data: bytes, described: "RepoSibling | None") -> None:
    """Refuse what a proxy or a broken connection made of a file: it would be kept for ever."""
    expected, found = None, None
    if described is not None and described.lfs is not None:
        expected, found = described.lfs.sha256, sha256(data)
    elif described is not None:
        blob = b"blob %d\0" % len(data) + data  # how git names the content of a file
        expected = described.blob_id
        found = hashlib.sha1(blob, usedforsecurity=False).hexdigest()
    if expected is not None and expected != found:
        raise ExpertError(
            f"{place} arrived with {len(data):,} bytes and the hash {found}",
            f"the hash {expected} that the hub names",
            "try again; if it stays so, something between here and the hub changes files",
        )


def _patiently(parts: Iterator[Part], place: _Place) -> Iterator[Part]:
    """Yield the parts of an answer as they come, none later than the user's patience allows.

    They are waited for in a thread of their own, since a request's timeout holds for each address
    of a host and for each step on its own, and for the look-up of a name not at all. Left alone,
    the thread ends with its one request, whose own timeout is longer.

    Raises:
        ExpertError: What went wrong, for the user.
    """
    arrived: queue.SimpleQueue[tuple[Part | None, Exception | None]] = queue.SimpleQueue()

    def wait_for_all() -> None:
        try:
            for part in parts:
                arrived.put((part, None))
            arrived.put((None, None))
        except Exception as error:
            arrived.put((None, error))

    threading.Thread(target=wait_for_all, daemon=True).start()
    while True:
        try:
            part, error = arrived.get(timeout=_patience())
        except queue.Empty as nothing:
            raise _explain(nothing, place) from None
        if error is not None:
            raise _explain(error, place) from error
        if part is None:
            return
        yield part


def _patience() -> float:
    """Return the seconds to wait; huggingface_hub's variable for slow mirrors counts here too."""
    return max(0.0, float(os.environ.get("HF_HUB_DOWNLOAD_TIMEOUT") or _PATIENCE))


def _endpoint() -> str:
    from huggingface_hub import constants

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    return (os.environ.get("HF_ENDPOINT") or constants.ENDPOINT).rstrip("/")


def _explain(error: Exception, place: _Place) -> ExpertError:
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    log_in = "run `hf auth login`, or set HF_TOKEN"
    if isinstance(error, errors.HFValidationError):
        return _malformed(str(place))
    if isinstance(error, errors.GatedRepoError) or status == 403:
        return ExpertError(
            f"{place.repo} does not let you read {place.file} (HTTP {status})",
            "a public repository, or one that grants you access",
            f"accept its terms on its page on the hub if it has some, and {log_in}",
        )
    if isinstance(error, errors.RepositoryNotFoundError) or status == 401:
        return ExpertError(
            f"there is no repository {place.repo}, or it is private (HTTP {status})",
            "a public model repository, or one that you may read",
            f"check the spelling; if it is private, {log_in}",
        )
    if isinstance(error, errors.RevisionNotFoundError):
        return ExpertError(
            f"{place.repo} has no revision {place.revision}",
            "a branch, a tag or a commit",
            "check the spelling, or leave out what follows the @ for the newest",
        )
    if isinstance(error, errors.EntryNotFoundError):
        return _no_file(place, [])
    return _out_of_reach(error, status, place)


def _no_file(place: _Place, names: list[str]) -> ExpertError:
    likely = [name for name in names if name.endswith((".onnx", ".zip")) and name.isprintable()]
    shown = ", ".join(likely[:5]) or "a file of that commit, with its folders"
    return ExpertError(
        f"{place.repo} has no file {place.file} at {place.revision}",
        f"{shown}{', ...' * (len(likely) > 5)}",
        "check the spelling, or name another revision after the @",
    )


def _out_of_reach(error: Exception, status: int | None, place: _Place) -> ExpertError:
    from huggingface_hub import errors

    next_step = "check network, proxy and HF_ENDPOINT; or download the file, and name its path"
    if isinstance(error, errors.OfflineModeIsEnabled):
        found = f"{place} is not on this machine, and HF_HUB_OFFLINE is set"
        next_step = "unset it once; or download the file, and name its path"
    elif isinstance(error, queue.Empty):
        found = f"{_endpoint()} gave no answer within {_patience():g} seconds for {place}"
        next_step = (
            "check network, proxy and HF_ENDPOINT; for a slow hub, set HF_HUB_DOWNLOAD_TIMEOUT"
        )
    elif status is not None:
        found = f"{_endpoint()} answered HTTP {status} for {place}"
    else:
        found = f"{_endpoint()} can't be used: {type(error).__name__}: {first_line(error)}"
    return ExpertError(
        found,
        "a hub that answers, or a commit after the @ whose file was fetched before",
        next_step,
    )
