"""A process that holds a copy of an expert: started, asked, timed and ended from here."""

import os
import pickle
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from fdtasil.errors import ExpertError
from fdtasil.experts import worker_process
from fdtasil.experts.batches import RaisedElsewhere

__all__ = ["Ended", "WorkerProcess", "in_a_process"]

_START_SECONDS = 60.0  # at least; a worker may have to import torch on a busy machine
_KILLED = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows has none
_LAST_SECONDS = 2.0  # between the end of a process's pipe and its own
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)


class WorkerProcess:
    """Answers in a process, which is started by the first batch, and again after a failure.

    Args:
        title: What errors call it.
        parcel: Pickled by cloudpickle: a function that opens the expert there.
        timeout: Seconds after which a batch without an answer is an error, or None.
    """

    def __init__(self, title: str, parcel: bytes, timeout: float | None) -> None:
        self._title, self._parcel, self._timeout = title, parcel, timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = self._expired = False
        self._lock = threading.Lock()  # between the thread that asks and those that stop it

    def recover(self) -> None:
        """Bury a process that was stopped; see `Asker`."""
        if self._stopped:
            self._bury()
            self._stopped = self._expired = False

    def answer(self, rows: np.ndarray) -> np.ndarray:
        """Ask the process, which is started if there is none; see `Asker`.

        Raises:
            ExpertError: If it can't open the expert, refuses the rows, dies, or is late.
            RaisedElsewhere: What the expert raised there.
        """
        if self._process is None:
            self._start()
        return self._exchange(rows, self._timeout, f"on {len(rows)} observations")

    def stop(self) -> None:
        """Kill the process; see `Asker`."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                _kill(self._process)

    def _start(self) -> None:
        process = _started(None)
        with self._lock:
            self._process = process
            if self._stopped:
                _kill(process)
        seconds = None if self._timeout is None else max(self._timeout, _START_SECONDS)
        try:
            self._exchange((sys.path, self._parcel), seconds, "while it was being started")
        except RaisedElsewhere as error:
            self.stop()
            raise ExpertError(
                f"{self._title} can't open it: {error.kind}: {error}",
                "an expert that can be opened in a process of its own",
                "import what it needs inside the function, or write threads=True",
            ) from error

    def _exchange(self, message: Any, seconds: float | None, when: str) -> Any:
        """Send a message, and return the reply that comes within `seconds`."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        clock = None if seconds is None else threading.Timer(seconds, self._expire)
        try:
            if clock is not None:
                clock.start()
            worker_process.send(process.stdin, message)
            outcome, value = pickle.loads(worker_process.receive(process.stdout))
        except (OSError, EOFError) as error:
            raise self._gone(process, seconds, when) from error
        finally:
            if clock is not None:
                clock.cancel()
                clock.join()  # it must not go off during the next batch
        if outcome == "refused":
            raise ExpertError(*value)
        if outcome == "raised":
            kind, text, trace = value
            raise RaisedElsewhere(kind, text) from RuntimeError(f"in {self._title}\n{trace}")
        return value

    def _expire(self) -> None:
        self._expired = True
        self.stop()

    def _gone(
        self, process: "subprocess.Popen[bytes]", seconds: float | None, when: str
    ) -> ExpertError:
        # A process that ends by itself closes its pipe first: a kill now would be taken for it.
        with suppress(subprocess.TimeoutExpired):
            process.wait(0 if self._stopped else _LAST_SECONDS)
        self._bury()
        if self._expired:
            return ExpertError(
                f"{self._title} hangs {when}: no answer in {seconds:g} s",
                f"an answer within timeout={self._timeout:g}",
                "raise timeout=, write a smaller batch=, or see what it waits for",
            )
        memory = process.returncode == -_KILLED  # which the kernel sends
        return ExpertError(
            f"{self._title} {_ending(process.returncode)} {when}",
            "a worker that lives as long as it is asked",
            "call it on such a batch on its own"
            + ("; often the memory is full: write fewer workers=" if memory else ""),
        )

    def _bury(self) -> None:
        """Leave nothing of the last process: no child of it, no zombie, no pipe."""
        with self._lock:
            process, self._process = self._process, None
            if process is None:
                return
            _kill(process)
            process.wait()
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):  # what it has not read can't be flushed any more
                stream.close()  # pyright: ignore[reportOptionalMemberAccess]


class Ended(Exception):
    """A process ended, or was ended, before it had done its work."""


def in_a_process(parcel: bytes, seconds: float) -> None:
    """Have a process of its own do some work, and end it.

    Args:
        parcel: A pickled function without arguments.
        seconds: After which the process is ended.

    Raises:
        Ended: If it does not live to say that it is done.
        ExpertError: What the work refused.
        RaisedElsewhere: What the work raised.
    """
    process = _started(subprocess.DEVNULL)  # a crash has its own words for standard error
    assert process.stdin is not None
    assert process.stdout is not None
    clock = threading.Timer(seconds, _kill, (process,))
    clock.start()
    try:
        worker_process.send(process.stdin, (sys.path, parcel))
        outcome, value = pickle.loads(worker_process.receive(process.stdout))
    except (OSError, EOFError) as error:
        late = clock.finished.is_set()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_LAST_SECONDS)
        _kill(process)
        how = f"took more than {seconds:g} s" if late else _ending(process.wait())
        raise Ended(f"{how} in a process that opened it") from error
    finally:
        clock.cancel()
        _kill(process)
        process.wait()
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):
                stream.close()
    if outcome == "refused":
        raise ExpertError(*value)
    if outcome == "raised":
        raise RaisedElsewhere(*value[:2])


def _started(messages: int | None) -> "subprocess.Popen[bytes]":
    """Start a worker process, which writes its `messages` where it is told to."""
    # A process group of its own keeps the terminal's Ctrl-C away from it from its first moment,
    # and lets it be ended together with whatever it starts.
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(worker_process.__file__))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=messages,
        env=os.environ | _ONE_THREAD,
        process_group=0,
    )


def _kill(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process and what it has started, unless it has been waited for already."""
    if process.returncode is not None:
        return
    with suppress(ProcessLookupError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, _KILLED)
        else:
            process.kill()


def _ending(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    known = {one.value: one.name for one in signal.Signals}  # not those of real time
    return f"was killed by {known.get(-code, f'signal {-code}')}"
