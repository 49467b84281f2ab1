"""What the hub is asked: what a repository holds at a commit, and the bytes of a file."""

import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from fdtasil.errors import ExpertError
from fdtasil.experts.hub.errors import explain
from fdtasil.experts.hub.place import COMMIT, Place
from fdtasil.experts.hub.settings import endpoint, patience

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
