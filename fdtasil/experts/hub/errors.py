"""What went wrong with the hub, said to the user."""

import queue

from fdtasil.errors import ExpertError, first_line
from fdtasil.experts.hub.place import Place, malformed
from fdtasil.experts.hub.settings import endpoint, patience

__all__ = ["explain", "no_file"]


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
