"""Calls of this library in processes of their own, which end with the block at the latest.

Why not `concurrent.futures.ProcessPoolExecutor`: its processes import the caller's `__main__`, so
a script without a guard would run itself again in each of them; and a failure waits for all that
is queued.
"""

import pickle
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from tempfile import TemporaryFile
from typing import IO, Any, TypeVar

from fdtasil.errors import FdtasilError, FitError, SettingError, first_line
from fdtasil.experts.worker_process import connect, receive, send

__all__ = ["Call", "elsewhere", "side_by_side"]

Job = TypeVar("Job")

# Modules come from where they come from here: -m would look into the current folder first, and run
# what somebody else left there.
_BEGIN = "import sys; sys.path[:] = sys.argv[1:]; from fdtasil.run.elsewhere import _main; _main()"
_PAUSE = 0.05  # seconds between two looks at processes that are waited for


@dataclass(frozen=True)
class Call:
    """A call under way in another process.

    Attributes:
        title: What errors call it.
        process: Its process.
        reply: Where its outcome is written.
        said: What it prints.
    """

    title: str
    process: "subprocess.Popen[bytes]"
    reply: IO[bytes]
    said: IO[bytes]

    @property
    def ended(self) -> bool:
        """Whether `outcome` returns at once."""
        return self.process.poll() is not None

    def outcome(self) -> Any:
        """Wait for what the function returns.

        Raises:
            FdtasilError: What it raised.
            FitError: If the process ended without an outcome.
        """
        code = self.process.wait()
        self.reply.seek(0)
        try:
            outcome = pickle.loads(receive(self.reply))
        except EOFError:
            self.said.seek(0)
            last = self.said.read().decode(errors="replace").strip().rpartition("\n")[2]
            raise FitError(
                f"{self.title} ended with code {code}: {last or 'it said nothing'}",
                "a process that lives until it is done",
                "run it alone, to see more; what is saved stays",
            ) from None
        if isinstance(outcome, FdtasilError):
            raise outcome
        return outcome


@contextmanager
def elsewhere(title: str, function: Callable[..., Any], *arguments: Any) -> Iterator[Call]:
    """Call a function in another process while the block runs.

    The process ends with the block at the latest, and with this one whatever ends it. It warns of
    nothing.

    Args:
        title: What errors call it.
        function: Of a module, so that the other process can import it.
        arguments: Its arguments; they are pickled.

    Raises:
        SettingError: If they can't be.
    """
    command = [sys.executable, "-P", "-c", _BEGIN, *sys.path]
    with (
        TemporaryFile() as reply,  # not a pipe, which would have to be emptied before it ends
        TemporaryFile() as said,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=reply, stderr=said) as process,
    ):
        try:
            assert process.stdin is not None
            try:
                send(process.stdin, (function, arguments))
            except OSError:  # it has ended already; `outcome` says how
                with suppress(OSError):
                    process.stdin.close()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise SettingError(
                    f"{title} in another process, which can't be sent what it is made from: "
                    f"{first_line(error)}",
                    "paths, ids and plain values",
                    "do it in this process: leave workers= out, in a shell --baseline",
                ) from error
            yield Call(title, process, reply, said)
        finally:
            process.kill()


def side_by_side(
    title: Callable[[Job], str], function: Callable[[Job], Any], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[Job, Any]]:
    """Call a function for each job in other processes, so many at once.

    Args:
        title: Job -> what errors call it.
        function: Of a module, or a `partial` of one, with what can be pickled.
        jobs: What it is called with.
        workers: How many at once.

    Yields:
        Each job with its outcome, in the order they end. The first failure ends the others.
    """
    waiting = list(reversed(jobs))
    with ExitStack() as processes:
        under_way: list[tuple[Job, Call]] = []
        while waiting or under_way:
            while waiting and len(under_way) < workers:
                job = waiting.pop()
                call = processes.enter_context(elsewhere(title(job), function, job))
                under_way.append((job, call))
            ended = [pair for pair in under_way if pair[1].ended]
            under_way = [pair for pair in under_way if pair not in ended]
            yield from ((job, call.outcome()) for job, call in ended)
            if not ended:
                time.sleep(_PAUSE)


def _main() -> None:
    """Take the call from the parent, and reply with its outcome."""
    inbox, replies = connect()
    function, arguments = pickle.loads(inbox.get())
    outcome: Any
    try:
        with warnings.catch_warnings(action="ignore"):
            outcome = function(*arguments)
    except FdtasilError as error:
        outcome = error
    send(replies, outcome)
