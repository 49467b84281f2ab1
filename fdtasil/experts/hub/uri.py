"""`hf://org/repo/file[@revision]`: how a file of the Hugging Face hub is named."""

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeGuard

from fdtasil.errors import ExpertError
from fdtasil.files.names import stays_inside

__all__ = ["COMMIT", "HubUri", "is_hub_uri", "malformed", "parse", "uri_of_page"]

_SCHEME = "hf:"
# The hub's own names for other kinds of repositories come first in their URIs.
_URI = re.compile(
    r"hf://(?!(?:models|datasets|spaces|kernels|buckets)/)"
    r"(?P<repo>[\w.-]+/[\w.-]+)/(?P<file>[^@]+)(?:@(?P<revision>[^@\s]+))?",
    re.ASCII,
)
COMMIT = re.compile(r"[0-9a-f]{40}")
_PAGE = re.compile(
    r"https?://(?:www\.)?(?:huggingface\.co|hf\.co)/(?P<repo>[\w.-]+/[\w.-]+)/"
    r"(?:blob|resolve|raw)/(?P<revision>[^/?#]+)/(?P<file>[^?#]+)(?:[?#].*)?",
    re.ASCII,
)


@dataclass(frozen=True)
class HubUri:
    """A file of a model repository; the revision None is the newest of the default branch."""

    repo: str
    file: str
    revision: str | None

    def __str__(self) -> str:
        return f"hf://{self.repo}/{self.file}" + (f"@{self.revision}" if self.revision else "")


def is_hub_uri(source: object) -> TypeGuard[str | Path]:
    """Whether an expert is named by its uri on the hub, rightly spelt or not.

    Example:
        >>> is_hub_uri("hf://org/repo/walker.onnx"), is_hub_uri("walker.onnx")
        (True, False)
    """
    return isinstance(source, (str, Path)) and str(source).startswith(_SCHEME)


def parse(text: str) -> HubUri:
    """Read a URI.

    Raises:
        ExpertError: If it names no file of a model repository.
    """
    found = _URI.fullmatch(text)
    if not found or not all(stays_inside(found[part]) for part in ("repo", "file")):
        raise malformed(text)
    return HubUri(found["repo"], str(PurePosixPath(found["file"])), found["revision"])


def uri_of_page(url: str) -> str | None:
    """Return the URI of a file whose address on the hub's own site is known, or None.

    Example:
        >>> uri_of_page("https://huggingface.co/org/repo/blob/main/walker.onnx")
        'hf://org/repo/walker.onnx@main'
    """
    found = _PAGE.fullmatch(url)
    return found and str(HubUri(found["repo"], found["file"], found["revision"]))


def malformed(text: str) -> ExpertError:
    """Return the error of a URI that can't be read."""
    return ExpertError(
        f"{text!r} names no file of the hub",
        "hf://org/repo/file or hf://org/repo/file@revision of a model repository",
        "write it like that, as text (a Path drops a slash)",
    )
