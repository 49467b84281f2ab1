"""Slow experts, asked by several processes or threads at once.

Why not `concurrent.futures.ProcessPoolExecutor`: its workers import the caller's `__main__`, so a
script without a guard would run itself again in each of them; it can't end one hung worker; and
when one dies it says neither which nor how.
"""

import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np

from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts import worker_process
from fdtasil.experts.expert import Answer, Expert, RaisedElsewhere

__all__ = ["check_workers", "with_processes", "with_threads"]

# Rows that a worker is handed at once. A fixed number: which rows are asked together must not
# depend on how many workers there are, since the last bits of an answer may depend on it.
BATCH = 8
_START_SECONDS = 60.0  # at least; a worker may have to import torch on a busy machine
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


def check_workers(workers: int, threads: bool, timeout: float | None, remote: bool) -> None:
    """Check how an expert is to be asked.

    Args:
        workers: How many processes or threads.
        threads: Whether they are threads.
        timeout: Seconds for a batch, or None.
        remote: Whether the expert keeps the time itself, as those behind HTTP do.

    Raises:
        SettingError: If the arguments don't go together.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 0:
        raise SettingError(f"workers={workers!r}", "a number of at least 0", "write workers=2")
    if threads and not workers:
        raise SettingError(
            "threads=True with workers=0", "a number of threads", "write workers=2, threads=True"
        )
    if timeout is None:
        return
    if isinstance(timeout, bool) or not 0 < timeout < float("inf"):
        raise SettingError(f"timeout={timeout!r}", "a number of seconds", "write timeout=60")
    if not remote and (threads or not workers):
        raise SettingError(
            f"timeout={timeout:g} without processes",
            "an expert in a process of its own: only that can be ended while it hangs",
            "write workers=1, or leave timeout= out",
        )


def with_threads(expert: Expert, workers: int) -> Expert:
    """Return the expert, asked by so many threads of this process."""
    askers = [_Thread(expert.answer) for _ in range(workers)]
    return replace(expert, workers=_Pool(askers))


def with_processes(
    expert: Expert, opener: Callable[[], Answer] | None, workers: int, timeout: float | None
) -> Expert:
    """Return the expert, asked by processes that each hold a copy of it.

    Args:
        expert: The expert, opened in this process.
        opener: Opens it in another, where it can't be sent as it is; sent by cloudpickle.
        workers: How many.
        timeout: Seconds after which a batch without an answer is an error, or None.

    Raises:
        ExpertError: If it can't be sent.
    """
    import cloudpickle

    answer = expert.answer  # the lambda must not take the whole expert along
    try:
        parcel = cloudpickle.dumps(opener or (lambda: answer))
    except Exception as error:  # each type that can't be sent has its own
        raise ExpertError(
            f"{expert.name} can't be sent to another process: {type(error).__name__}: {error}",
            "a function that cloudpickle can take",
            "pass the path of an ONNX file or a zip, open what can't be sent inside the function "
            "at its first call, or write threads=True",
        ) from error
    titles = [f"worker {k + 1} of {workers} of {expert.name}" for k in range(workers)]
    askers = [_Process(title, parcel, timeout) for title in titles]
    return replace(expert, workers=_Pool(askers))


class _Asker(Protocol):
    def recover(self) -> None:
        """Clean up after a stop, if there was one; called before each batch."""
        ...

    def answer(self, rows: np.ndarray, /) -> np.ndarray:
        """Answer one batch; never called twice at a time."""
        ...

    def stop(self) -> None:
        """Give up the batch it is busy with, if that is possible; called from any thread."""
        ...


class _Pool:
    """Asks batches side by side. Nothing runs before the first; copies of an expert share it."""

    def __init__(self, askers: Sequence[_Asker]) -> None:
        self._idle: SimpleQueue[_Asker] = SimpleQueue()
        for asker in askers:
            self._idle.put(asker)
        # One thread waits for each worker: at most as many as there are askers.
        self._executor = ThreadPoolExecutor(len(askers), thread_name_prefix="fdtasil-worker")
        weakref.finalize(self, _close, os.getpid(), self._executor, tuple(askers))

    def each(
        self, ask: Callable[[np.ndarray, Answer], np.ndarray], batches: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """Return `ask(batch, answer)` of every batch, in their order.

        The first failure stops the others: one worker may hang while another has raised. So does
        Ctrl-C.
        """
        call = _Call(ask)
        futures = [self._executor.submit(self._one, call, batch) for batch in batches]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future in done:
                    future.result()  # raises what failed, before an unfinished one is waited for
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()
            call.over.set()
            for asker in tuple(call.busy):
                asker.stop()

    def _one(self, call: "_Call", batch: np.ndarray) -> np.ndarray:
        asker = self._idle.get()
        try:
            asker.recover()
            # In this order no stop is lost: either we see the end, or the end sees us.
            call.busy.add(asker)
            if call.over.is_set():
                raise CancelledError
            return call.ask(batch, asker.answer)
        finally:
            call.busy.discard(asker)
            self._idle.put(asker)


@dataclass(frozen=True)
class _Call:
    """One call of `each`: who is busy with its batches, and whether it is over."""

    ask: Callable[[np.ndarray, Answer], np.ndarray]
    busy: set[_Asker] = field(default_factory=set)
    over: threading.Event = field(default_factory=threading.Event)


def _close(owner: int, executor: ThreadPoolExecutor, askers: Sequence[_Asker]) -> None:
    if os.getpid() != owner:  # a fork of the owner has no say
        return
    executor.shutdown(wait=False, cancel_futures=True)
    for asker in askers:
        asker.stop()
        asker.recover()


class _Thread:
    """Answers in the thread that asks; Python can't stop one."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer

    def recover(self) -> None:
        pass

    def stop(self) -> None:
        pass


class _Process:
    """Answers in a process, which is started by the first batch, and again after a failure."""

    def __init__(self, title: str, parcel: bytes, timeout: float | None) -> None:
        self._title, self._parcel, self._timeout = title, parcel, timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = self._expired = False
        self._lock = threading.Lock()  # between the thread that asks and those that stop it

    def recover(self) -> None:
        if self._stopped:
            self._bury()
            self._stopped = self._expired = False

    def answer(self, rows: np.ndarray) -> np.ndarray:
        if self._process is None:
            self._start()
        return self._exchange(rows, self._timeout, f"on {len(rows)} observations")

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            if self._process is not None:
                _kill(self._process)

    def _start(self) -> None:
        # A process group of its own keeps the terminal's Ctrl-C away from it from its first
        # moment, and lets it be ended together with whatever it starts.
        process = subprocess.Popen(
            [sys.executable, "-P", str(Path(worker_process.__file__))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | _ONE_THREAD,
            process_group=0,
        )
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
        self._bury()
        if self._expired:
            return ExpertError(
                f"{self._title} hangs {when}: no answer in {seconds:g} s",
                f"an answer within timeout={self._timeout:g}",
                "raise timeout=, write a smaller batch=, or see what it waits for",
            )
        return ExpertError(
            f"{self._title} {_ending(process.returncode)} {when}",
            "a worker that lives as long as it is asked",
            "call it on such a batch on its own; SIGKILL is often the kernel, out of memory: "
            "write fewer workers=",
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


def _kill(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process and what it has started, unless it has been waited for already."""
    if process.returncode is not None:
        return
    with suppress(ProcessLookupError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _ending(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    return f"was killed by {signal.Signals(-code).name}"
