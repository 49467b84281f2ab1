"""A run on the Hugging Face hub: its card, its student and its report, of which nothing is run.

huggingface_hub is imported inside the functions: it is an extra, and `import fdtasil` stays light.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fdtasil.errors import ExportError, SettingError, first_line
from fdtasil.experts.hub.requests import endpoint, patience
from fdtasil.files.reading import FILE_LIMIT, read_plain
from fdtasil.files.storage import MANIFEST, verify

if TYPE_CHECKING:
    from huggingface_hub import HfApi

__all__ = ["open_hub", "parcel_of", "send"]

_NAME = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)
_SENT = ("README.md", "report.json", "student.", "figures/")
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
    files = verify(folder)
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


def send(hub: "HfApi", repository: str, files: Mapping[str, bytes], *, public: bool) -> str:
    """Send files to a repository, which is made if there is none, in one commit.

    Args:
        hub: From `open_hub`.
        repository: org/name.
        files: Content by name.
        public: Whether everybody may read them.

    Returns:
        The address of the repository.

    Raises:
        SettingError: If the repository is public, and `public` does not say so.
        ExportError: If the hub does not take them.
    """
    from huggingface_hub import CommitOperationAdd, errors

    try:
        try:
            wait = _TIMES_OF_A_REQUEST * patience()
            private = hub.model_info(repository, timeout=wait).private
        except errors.RepositoryNotFoundError:
            hub.create_repo(repository, private=not public)
            private = not public
        if not private and not public:
            raise SettingError(
                f"{repository} is there already, and everybody may read it",
                "a private repository",
                "add --public, or name another one",
            )
        operations = [CommitOperationAdd(name, data) for name, data in files.items()]
        hub.create_commit(repository, operations, commit_message="A student by fdtasil")
    except SettingError:
        raise
    except Exception as error:  # of the network, of the hub, of what it says about the card
        raise _refused(error, repository) from error
    return f"{endpoint()}/{repository}"


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
