"""Unknown ONNX files are opened and tried first in a process that may crash, hang or grow.

A few hundred bytes can end a process while onnxruntime opens them (a division that the processor
refuses), take all memory, or never end; nothing in this process could stop it. What passes once is
not tried again.
"""

import pickle
from collections.abc import Callable

from fdtasil.errors import ExpertError, shown
from fdtasil.experts.batches import RaisedElsewhere
from fdtasil.experts.workers.handle import Ended, in_a_process
from fdtasil.files.onnx.limits import MEMORY

__all__ = ["try_out", "vouch_for"]

_SECONDS = 30.0  # for opening a model and a few answers; large ones take one or two

_PASSED: set[str] = set()
_EXPECTED = f"a model that opens and answers within {_SECONDS:g} s and {MEMORY / 2**30:g} GiB"
_ADVICE = "leave the file alone; if you know it, wrap a session of its own in a function"


def vouch_for(digest: str | None) -> None:
    """Take a file for tried: another process of this run has."""
    if digest is not None:
        _PASSED.add(digest)


def try_out(digest: str, name: str, work: Callable[[], object]) -> None:
    """Open a model in a process of its own, unless one with this hash has passed before.

    Args:
        digest: sha256 of the file.
        name: What to call it.
        work: Opens it and asks it a little.

    Raises:
        ExpertError: If the process crashes, takes too much memory or too long, or what
            `work` raises in it.
    """
    if digest in _PASSED:
        return
    try:
        in_a_process(pickle.dumps(work), _SECONDS)
    except Ended as ended:
        raise ExpertError(f"{name} {ended}", _EXPECTED, _ADVICE) from ended
    except RaisedElsewhere as error:
        found = f"{name} can't be tried: {error.kind}: {shown(error)}"
        raise ExpertError(found, _EXPECTED, _ADVICE) from error
    _PASSED.add(digest)
