"""What the hub is asked: what a repository holds at a commit, and the bytes of a file."""

import os
import queue
import threading
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from fdtasil.errors import ExpertError, SettingError, first_line, shown
from fdtasil.experts.hub.uri import COMMIT, HubUri, malformed

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoSibling

__all__ = ["download", "look_up"]

Part = TypeVar("Part")

_SIZE_LIMIT = 2**31  # no ONNX model is larger with its weights: it is one protobuf message


def look_up(uri: HubUri) -> "tuple[HubUri, dict[str, RepoSibling]]":
    """Return the uri with its commit, and what the repository holds at it, by name."""
    patience()  # huggingface_hub itself can't be imported where it is no number
    from huggingface_hub import HfApi

    def answers() -> "Iterator[tuple[HubUri, dict[str, RepoSibling]]]":
        info = HfApi(endpoint()).model_info(
            uri.repo, revision=uri.revision, files_metadata=True, timeout=2 * patience()
        )
        pinned = COMMIT.fullmatch(uri.revision or "")
        if not COMMIT.fullmatch(info.sha or "") or (pinned and info.sha != uri.revision):
            raise ValueError(f"its answer names the commit {info.sha!r}")
        files = {sibling.rfilename: sibling for sibling in info.siblings or []}
        yield replace(uri, revision=info.sha), files

    return next(_patiently(answers(), uri))


def download(uri: HubUri) -> bytes:
    """Return a file's bytes."""
    from huggingface_hub import get_session, hf_hub_url
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

    # `hf_hub_download` would do, but for its retries: where nobody answers, it takes minutes.
    def answers() -> Iterator[bytes]:
        url = hf_hub_url(uri.repo, uri.file, revision=uri.revision, endpoint=endpoint())
        with get_session().stream(
            "GET", url, headers=build_hf_headers(), follow_redirects=True, timeout=2 * patience()
        ) as response:
            hf_raise_for_status(response)
            yield from response.iter_bytes()

    data = bytearray()
    with closing(_patiently(answers(), uri)) as parts:
        for part in parts:
            data += part
            if len(data) > _SIZE_LIMIT:
                raise ExpertError(
                    f"{uri} has more than {_SIZE_LIMIT:,} bytes",
                    "an ONNX file with its weights, or a stable-baselines3 zip",
                    "check that this is the right file",
                )
    return bytes(data)


def _patiently(parts: Iterator[Part], uri: HubUri) -> Generator[Part, None, None]:
    """Yield the parts of an answer as they come, none later than the user's patience allows.

    They are waited for in a thread of their own, since a request's timeout holds for each address
    of a host and for each step on its own, and for the look-up of a name not at all. Left alone,
    the thread ends with the next part, or with its one request, whose own timeout is longer.

    Raises:
        ExpertError: What went wrong, for the user.
    """
    arrived: queue.SimpleQueue[tuple[Part | None, Exception | None]] = queue.SimpleQueue()
    given_up = threading.Event()

    def wait_for_all() -> None:
        try:
            for part in parts:
                if given_up.is_set():
                    return
                arrived.put((part, None))
            arrived.put((None, None))
        except Exception as error:
            arrived.put((None, error))

    threading.Thread(target=wait_for_all, daemon=True).start()
    try:
        while True:
            try:
                part, error = arrived.get(timeout=patience())
            except queue.Empty as nothing:
                raise explain(nothing, uri) from None
            if error is not None:
                raise explain(error, uri) from error
            if part is None:
                return
            yield part
    finally:
        given_up.set()


def explain(error: Exception, uri: HubUri) -> ExpertError:
    """Return what a failed request means for the user, and what to do about it."""
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    log_in = "run `hf auth login`, or set HF_TOKEN"
    if isinstance(error, errors.HFValidationError):
        return malformed(str(uri))
    if isinstance(error, errors.GatedRepoError) or status == 403:
        return ExpertError(
            f"{uri.repo} does not let you read {uri.file} (HTTP {status})",
            "a public repository, or one that grants you access",
            f"accept its terms on its page on the hub if it has some, and {log_in}",
        )
    if isinstance(error, errors.RepositoryNotFoundError) or status == 401:
        return ExpertError(
            f"there is no repository {uri.repo}, or it is private (HTTP {status})",
            "a public model repository, or one that you may read",
            f"check the spelling; if it is private, {log_in}",
        )
    if isinstance(error, errors.RevisionNotFoundError):
        return ExpertError(
            f"{uri.repo} has no revision {uri.revision}",
            "a branch, a tag or a commit",
            "check the spelling, or leave out what follows the @ for the newest",
        )
    if isinstance(error, errors.EntryNotFoundError):
        return no_file(uri, [])
    return _out_of_reach(error, status, uri)


def no_file(uri: HubUri, names: list[str]) -> ExpertError:
    """Return the error of a file that is not there, with the names of those that may be meant."""
    likely = [name for name in names if name.endswith((".onnx", ".zip")) and name.isprintable()]
    shown = ", ".join(likely[:5]) or "a file of that commit, with its folders"
    return ExpertError(
        f"{uri.repo} has no file {uri.file} at {uri.revision}",
        f"{shown}{', ...' * (len(likely) > 5)}",
        "check the spelling, or name another revision after the @",
    )


def _out_of_reach(error: Exception, status: int | None, uri: HubUri) -> ExpertError:
    from huggingface_hub import errors

    next_step = "check network, proxy and HF_ENDPOINT; or download the file, and name its path"
    if isinstance(error, errors.OfflineModeIsEnabled):
        found = f"{uri} is not on this machine, and HF_HUB_OFFLINE is set"
        next_step = "unset it once; or download the file, and name its path"
    elif isinstance(error, queue.Empty):
        found = f"{endpoint()} gave no answer within {patience():g} seconds for {uri}"
        next_step = (
            "check network, proxy and HF_ENDPOINT; for a slow hub, set HF_HUB_DOWNLOAD_TIMEOUT"
        )
    elif status is not None:
        found = f"{endpoint()} answered HTTP {status} for {uri}"
    else:
        found = f"{endpoint()} can't be used: {type(error).__name__}: {first_line(error)}"
    return ExpertError(
        found,
        "a hub that answers, or a commit after the @ whose file was fetched before",
        next_step,
    )


_PATIENCE = 6.0  # seconds without a sign of life after which the hub counts as out of reach


def patience() -> float:
    """Return the seconds to wait; huggingface_hub's variable for slow mirrors counts here too.

    Raises:
        SettingError: If that is no number.
    """
    given = os.environ.get("HF_HUB_DOWNLOAD_TIMEOUT") or _PATIENCE
    try:
        seconds = float(given)
        if not seconds >= 0:
            raise ValueError
    except ValueError:
        raise SettingError(
            f"the environment variable HF_HUB_DOWNLOAD_TIMEOUT is {shown(given)!r}",
            "whole seconds",
            "unset HF_HUB_DOWNLOAD_TIMEOUT, or export HF_HUB_DOWNLOAD_TIMEOUT=30",
        ) from None
    return seconds


def endpoint() -> str:
    """Return the address of the hub, or of the mirror that the user has set."""
    from huggingface_hub import constants

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    return (os.environ.get("HF_ENDPOINT") or constants.ENDPOINT).rstrip("/")
