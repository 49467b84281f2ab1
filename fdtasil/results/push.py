"""A run on the Hugging Face hub: its card, its student and its report, of which nothing is run.

huggingface_hub is imported inside the functions: it is an extra, and `import fdtasil` stays light.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fdtasil.errors import ExportError, SettingError, first_line
from fdtasil.experts.hub.requests import endpoint, patience
from fdtasil.files.reading import FILE_LIMIT, read_plain
from fdtasil.files.run_format import (
    CARD,
    CONFIG,
    MODEL,
    PROGRESS,
    REPORT,
    STATES,
    WEIGHTS,
    check_run,
)
from fdtasil.files.storage import MANIFEST, verify
from fdtasil.results.figures import FIGURES

if TYPE_CHECKING:
    from huggingface_hub import HfApi

__all__ = ["left_over", "look_up", "open_hub", "parcel_of", "send"]

_NAME = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)
_SENT = (CARD, REPORT, "student.", "figures/")
_ALWAYS = {REPORT, WEIGHTS}  # in every repository that a run was sent to
_DATA = {CONFIG, MANIFEST, STATES, PROGRESS, MODEL}
_TIMES_OF_A_REQUEST = 2  # that the patience is long: a request's own limit is the last resort


def parcel_of(folder: Path, *, demonstrations: bool = False) -> dict[str, bytes]:
    """Return what is sent of a run, by name.

    Args:
        folder: Of a finished run.
        demonstrations: Whether the whole run goes, which can be read again on the other side:
            the states and the answers of the expert too.

    Raises:
        StorageError: If it is no whole run folder.
    """
    check_run(folder)
    files = verify(folder, edited=(CARD,))
    if demonstrations:
        return {**files, MANIFEST: read_plain(folder / MANIFEST, FILE_LIMIT, follow=False)}
    return {name: data for name, data in files.items() if name.startswith(_SENT)}


def open_hub(repository: str) -> "HfApi":
    """Return the hub, as who is logged in.

    Args:
        repository: org/name, where something will be sent to.

    Raises:
        SettingError: If that is no name.
        ExportError: If huggingface_hub is missing, or nobody is logged in.
    """
    if not _NAME.fullmatch(repository):
        raise _no_name(repository)
    patience()  # huggingface_hub itself can't be imported where it is no number
    try:
        from huggingface_hub import HfApi, get_token
        from huggingface_hub.errors import HFValidationError
        from huggingface_hub.utils import validate_repo_id
    except Exception as error:  # it also raises where its variables have odd values
        raise ExportError(
            f"huggingface_hub can't be imported: {first_line(error)}",
            "huggingface_hub, for the hub",
            'pip install "fdtasil[hub]"',
        ) from error
    try:
        validate_repo_id(repository)
    except HFValidationError as error:
        raise _no_name(repository) from error
    token = get_token()
    if not token:
        raise ExportError(
            f"nobody is logged in at {endpoint()}",
            "a token with the right to write",
            "run `hf auth login`, or set HF_TOKEN",
        )
    return HfApi(endpoint(), token=token)


def look_up(hub: "HfApi", repository: str, *, public: bool) -> set[str] | None:
    """Return the names of the files of a repository, or None where there is none.

    Args:
        hub: From `open_hub`.
        repository: org/name.
        public: Whether everybody may read what will be sent.

    Raises:
        SettingError: If it is there, and is not what `public` says.
        ExportError: If the hub does not answer.
    """
    from huggingface_hub import errors

    with _refusals(repository):
        try:
            info = hub.model_info(repository, timeout=_TIMES_OF_A_REQUEST * patience())
        except errors.RepositoryNotFoundError:
            return None
    if bool(info.private) == public:
        raise SettingError(
            f"{repository} is there already, and "
            f"{'private' if info.private else 'everybody may read it'}",
            f"a {'public' if public else 'private'} repository",
            f"{'leave --public out' if public else 'add --public'}, or name another one",
        )
    return {sibling.rfilename for sibling in info.siblings or []}


def left_over(there: Collection[str] | None, files: Collection[str]) -> list[str]:
    """Return which files of an earlier push are in a repository, and are not sent now.

    Demonstrations of another expert would stand beside the new student, say. What is not a run's
    is left alone, and so is all in a repository that no run was sent to.
    """
    if there is None or not set(there) >= _ALWAYS:
        return []
    ours = _ALWAYS | _DATA | {f"figures/{name}.png" for name in FIGURES}
    return sorted((ours & set(there)) - set(files))


def send(
    hub: "HfApi",
    repository: str,
    files: Mapping[str, bytes],
    there: Collection[str] | None,
    *,
    public: bool,
) -> str:
    """Send files to a repository, which is made if there is none, in one commit.

    Args:
        hub: From `open_hub`.
        repository: org/name.
        files: Content by name.
        there: From `look_up`.
        public: Whether everybody may read them.

    Returns:
        The address of the repository.

    Raises:
        ExportError: If the hub does not take them.
    """
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    with _refusals(repository):
        if there is None:
            hub.create_repo(repository, private=not public)
        operations = [
            *(CommitOperationAdd(name, data) for name, data in files.items()),
            *(CommitOperationDelete(name, is_folder=False) for name in left_over(there, files)),
        ]
        hub.create_commit(repository, operations, commit_message="A student by fdtasil")
    return f"{endpoint()}/{repository}"


@contextmanager
def _refusals(repository: str) -> Iterator[None]:
    """Tell what the hub says, whatever it is, of a repository."""
    try:
        yield
    except SettingError:
        raise
    except Exception as error:  # of the network, of the hub, of what it says about the card
        raise _refused(error, repository) from error


def _no_name(repository: str) -> SettingError:
    return SettingError(
        f"{repository!r} to push to",
        "org/name of a repository: letters, digits, and . _ - inside",
        "write for example fdtasil push runs/cheetah me/cheetah",
    )


def _refused(error: Exception, repository: str) -> ExportError:
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403, 404):
        return ExportError(
            f"the hub does not let you write to {repository} (HTTP {status})",
            "a token with the right to write there",
            "run `hf auth login` with such a token, or name a repository of your own",
        )
    if isinstance(error, errors.OfflineModeIsEnabled):
        return ExportError("HF_HUB_OFFLINE is set", "a network", "unset it once")
    said = f"HTTP {status}" if status else f"{type(error).__name__}: {first_line(error)}"
    return ExportError(
        f"{endpoint()} did not take {repository}: {said}",
        "a hub that answers",
        "check network, proxy and HF_ENDPOINT, and push again: what is there already is not sent",
    )
