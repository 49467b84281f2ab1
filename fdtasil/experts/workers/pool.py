"""Batches asked side by side, by whoever answers them."""

import os
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import NoReturn, Protocol

import numpy as np

from fdtasil.errors import ExpertError
from fdtasil.rollouts.behaviours import Policy

__all__ = ["Asker", "WorkerGroup"]


class Asker(Protocol):
    """Answers one batch at a time."""

    def recover(self) -> None:
        """Clean up after a stop, if there was one; called before each batch."""
        ...

    def answer(self, rows: np.ndarray, /) -> np.ndarray:
        """Answer one batch; never called twice at a time."""
        ...

    def stop(self) -> None:
        """Give up the batch it is busy with, if that is possible; called from any thread."""
        ...


class WorkerGroup:
    """Asks batches side by side. Nothing runs before the first; copies of an expert share it."""

    def __init__(self, askers: Sequence[Asker]) -> None:
        self._askers, self._idle = tuple(askers), SimpleQueue[Asker]()
        for asker in askers:
            self._idle.put(asker)
        # One thread waits for each worker: at most as many as there are askers.
        self._executor = ThreadPoolExecutor(len(askers), thread_name_prefix="fdtasil-worker")
        weakref.finalize(self, _close, os.getpid(), self._executor, self._askers)

    def each(
        self, ask: Callable[[np.ndarray, Policy], np.ndarray], batches: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """Return `ask(batch, answer)` of every batch, in their order.

        The first failure stops the others: one worker may hang while another has raised. Ctrl-C
        stops all, the idle ones too.
        """
        call = _Call(ask)
        futures = [self._executor.submit(self._one, call, batch) for batch in batches]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future in done:
                    future.result()  # raises what failed, before an unfinished one is waited for
            return [future.result() for future in futures]
        except KeyboardInterrupt:
            for asker in self._askers:  # of a notebook, which keeps what was interrupted
                asker.stop()
            raise
        finally:
            for future in futures:
                future.cancel()
            call.over.set()
            for asker in tuple(call.busy):
                asker.stop()

    def __reduce__(self) -> NoReturn:
        raise ExpertError(
            "an expert with workers can't be sent to another process, or copied",
            "the expert that it was made of",
            "open it there: load_expert(..., workers=...)",
        )

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

    ask: Callable[[np.ndarray, Policy], np.ndarray]
    busy: set[Asker] = field(default_factory=set)
    over: threading.Event = field(default_factory=threading.Event)


def _close(owner: int, executor: ThreadPoolExecutor, askers: Sequence[Asker]) -> None:
    if os.getpid() != owner:  # a fork of the owner has no say
        return
    executor.shutdown(wait=False, cancel_futures=True)
    for asker in askers:
        asker.stop()
        asker.recover()
