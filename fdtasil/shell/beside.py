"""The plain cloning that a run is compared with, in a process of its own beside it."""

import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from tempfile import TemporaryFile
from typing import IO, Any

from fdtasil.errors import FdtasilError, FitError
from fdtasil.experts.worker_process import connect, receive, send
from fdtasil.results.evaluation import Evaluation
from fdtasil.shell.call import distil
from fdtasil.shell.command import import_module_of

__all__ = ["evaluated_beside"]

# Modules come from where they come from here: -m would look into the current folder first, and run
# what somebody else left there.
_BEGIN = "import sys; sys.path[:] = sys.argv[1:]; from fdtasil.shell.beside import _main; _main()"
_Outcome = Evaluation | FdtasilError | None


@contextmanager
def evaluated_beside(
    arguments: Mapping[str, Any] | None,
) -> Iterator[Callable[[], Evaluation | None]]:
    """Distil in another process while the block runs, on a core that is idle otherwise.

    The process ends with the block at the latest, and with this one whatever ends it.

    Args:
        arguments: Of the shell's `distil`; None to do nothing.

    Yields:
        What waits for the evaluation and returns it, or raises what the distillation raised.
    """
    if arguments is None:
        yield lambda: None
        return
    command, pipe = [sys.executable, "-P", "-c", _BEGIN, *sys.path], subprocess.PIPE
    with (
        TemporaryFile() as said,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=said) as process,
    ):
        try:
            assert process.stdin is not None
            send(process.stdin, dict(arguments))
            yield lambda: _outcome(process, said)
        finally:
            process.kill()


def _outcome(process: "subprocess.Popen[bytes]", said: IO[bytes]) -> Evaluation | None:
    assert process.stdout is not None
    try:
        outcome: _Outcome = pickle.loads(receive(process.stdout))
    except EOFError:
        code = process.wait()
        said.seek(0)
        last = said.read().decode(errors="replace").strip().rpartition("\n")[2]
        raise FitError(
            f"the plain cloning ended with code {code}: {last or 'it said nothing'}",
            "an evaluation to compare with",
            "run it alone with --probes 0; the run beside it is saved",
        ) from None
    if isinstance(outcome, FdtasilError):
        raise outcome
    return outcome


def _main() -> None:
    """Take the arguments from the parent, and reply with the outcome."""
    inbox, replies = connect()
    arguments = pickle.loads(inbox.get())
    outcome: _Outcome
    try:
        with warnings.catch_warnings(action="ignore"):  # the run beside it warns of the same
            import_module_of(arguments["env"])
            outcome = distil(arguments, progress=False).evaluation
    except FdtasilError as error:
        outcome = error
    send(replies, outcome)
