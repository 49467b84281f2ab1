"""The plain cloning that a run is compared with, in a process of its own beside it."""

import os
import pickle
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from tempfile import TemporaryFile
from typing import IO, Any

from fdtasil.errors import FdtasilError, FitError
from fdtasil.evaluation import Evaluation
from fdtasil.pipeline import distill
from fdtasil.shell import import_module_of

__all__ = ["evaluated_beside"]

# Modules come from where they come from here: -m would look into the current folder first, and run
# what somebody else left there.
_BEGIN = "import sys; sys.path[:] = sys.argv[1:]; from fdtasil.beside import _main; _main()"
_Outcome = Evaluation | FdtasilError | None


@contextmanager
def evaluated_beside(
    arguments: Mapping[str, Any] | None,
) -> Iterator[Callable[[], Evaluation | None]]:
    """Distil in another process while the block runs, on a core that is idle otherwise.

    The process ends with the block at the latest, and with this one whatever ends it.

    Args:
        arguments: Of `distill`, fit to be pickled; None to do nothing.

    Yields:
        What waits for the evaluation and returns it, or raises what the distillation raised.
    """
    if arguments is None:
        yield lambda: None
        return
    command, pipe = [sys.executable, "-P", "-c", _BEGIN, *sys.path], subprocess.PIPE
    with (
        TemporaryFile() as said,
        subprocess.Popen(command, bufsize=0, stdin=pipe, stdout=pipe, stderr=said) as process,
    ):
        try:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # it ended already; asking for its outcome says how
                process.stdin.write(pickle.dumps(dict(arguments)))
            yield lambda: _outcome(process, said)
        finally:
            process.kill()


def _outcome(process: "subprocess.Popen[bytes]", said: IO[bytes]) -> Evaluation | None:
    assert process.stdout is not None
    data = process.stdout.read()
    if not data:
        code = process.wait()
        said.seek(0)
        last = said.read().decode(errors="replace").strip().rpartition("\n")[2]
        raise FitError(
            f"the plain cloning ended with code {code}: {last or 'it said nothing'}",
            "an evaluation to compare with",
            "run it alone with --probes 0; the run beside it is saved",
        )
    outcome: _Outcome = pickle.loads(data)
    if isinstance(outcome, FdtasilError):
        raise outcome
    return outcome


def _main() -> None:
    """Read the arguments from standard input, and write the outcome to standard output."""
    arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    # What an environment prints must not get into the outcome.
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    outcome: _Outcome
    try:
        with warnings.catch_warnings(action="ignore"):  # the run beside it warns of the same
            import_module_of(arguments["env"])
            outcome = distill(**arguments, progress=False).evaluation
    except FdtasilError as error:
        outcome = error
    with results:
        pickle.dump(outcome, results)


def _end_with_the_parent() -> None:
    sys.stdin.buffer.read()  # ends when the other side is closed, by whatever
    os._exit(1)
