"""What the hub is asked: what a repository holds at a commit, and the bytes of a file."""

import os
import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from fdtasil.errors import ExpertError, first_line
from fdtasil.experts.hub.place import COMMIT, Place, malformed

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoSibling

__all__ = ["download", "look_up"]

Part = TypeVar("Part")

_SIZE_LIMIT = 2**31  # no ONNX model is larger with its weights: it is one protobuf message


def look_up(place: Place) -> "tuple[Place, dict[str, RepoSibling]]":
    """Return the place with its commit, and what the repository holds at it, by name."""
    from huggingface_hub import HfApi

    def answers() -> "Iterator[tuple[Place, dict[str, RepoSibling]]]":
        info = HfApi(endpoint()).model_info(
            place.repo, revision=place.revision, files_metadata=True, timeout=2 * patience()
        )
        pinned = COMMIT.fullmatch(place.revision or "")
        if not COMMIT.fullmatch(info.sha or "") or (pinned and info.sha != place.revision):
            raise ValueError(f"its answer names the commit {info.sha!r}")
        files = {sibling.rfilename: sibling for sibling in info.siblings or []}
        yield replace(place, revision=info.sha), files

    return next(_patiently(answers(), place))


def download(place: Place) -> bytes:
    """Return a file's bytes."""
    from huggingface_hub import get_session, hf_hub_url
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

    # `hf_hub_download` would do, but for its retries: where nobody answers, it takes minutes.
    def answers() -> Iterator[bytes]:
        url = hf_hub_url(place.repo, place.file, revision=place.revision, endpoint=endpoint())
        with get_session().stream(
            "GET", url, headers=build_hf_headers(), follow_redirects=True, timeout=2 * patience()
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


def _patiently(parts: Iterator[Part], place: Place) -> Iterator[Part]:
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
            part, error = arrived.get(timeout=patience())
        except queue.Empty as nothing:
            raise explain(nothing, place) from None
        if error is not None:
            raise explain(error, place) from error
        if part is None:
            return
        yield part


def explain(error: Exception, place: Place) -> ExpertError:
    """Return what a failed request means for the user, and what to do about it."""
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    log_in = "run `hf auth login`, or set HF_TOKEN"
    if isinstance(error, errors.HFValidationError):
        return malformed(str(place))
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
        return no_file(place, [])
    return _out_of_reach(error, status, place)


def no_file(place: Place, names: list[str]) -> ExpertError:
    """Return the error of a file that is not there, with the names of those that may be meant."""
    likely = [name for name in names if name.endswith((".onnx", ".zip")) and name.isprintable()]
    shown = ", ".join(likely[:5]) or "a file of that commit, with its folders"
    return ExpertError(
        f"{place.repo} has no file {place.file} at {place.revision}",
        f"{shown}{', ...' * (len(likely) > 5)}",
        "check the spelling, or name another revision after the @",
    )


def _out_of_reach(error: Exception, status: int | None, place: Place) -> ExpertError:
    from huggingface_hub import errors

    next_step = "check network, proxy and HF_ENDPOINT; or download the file, and name its path"
    if isinstance(error, errors.OfflineModeIsEnabled):
        found = f"{place} is not on this machine, and HF_HUB_OFFLINE is set"
        next_step = "unset it once; or download the file, and name its path"
    elif isinstance(error, queue.Empty):
        found = f"{endpoint()} gave no answer within {patience():g} seconds for {place}"
        next_step = (
            "check network, proxy and HF_ENDPOINT; for a slow hub, set HF_HUB_DOWNLOAD_TIMEOUT"
        )
    elif status is not None:
        found = f"{endpoint()} answered HTTP {status} for {place}"
    else:
        found = f"{endpoint()} can't be used: {type(error).__name__}: {first_line(error)}"
    return ExpertError(
        found,
        "a hub that answers, or a commit after the @ whose file was fetched before",
        next_step,
    )


_PATIENCE = 6.0  # seconds without a sign of life after which the hub counts as out of reach


def patience() -> float:
    """Return the seconds to wait; huggingface_hub's variable for slow mirrors counts here too."""
    return max(0.0, float(os.environ.get("HF_HUB_DOWNLOAD_TIMEOUT") or _PATIENCE))


def endpoint() -> str:
    """Return the address of the hub, or of the mirror that the user has set."""
    from huggingface_hub import constants

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    return (os.environ.get("HF_ENDPOINT") or constants.ENDPOINT).rstrip("/")
