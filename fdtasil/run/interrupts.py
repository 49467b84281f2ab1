"""Ctrl-C and SIGTERM: at once, or held back to the next moment at which nothing is lost."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Interrupts", "heard_interrupts"]


@contextmanager
def heard_interrupts() -> Iterator["Interrupts"]:
    """Turn SIGINT and SIGTERM inside the block into exceptions.

    A handler that is not Python's own is left in charge, and so are those of the main thread where
    a run goes on in another one.
    """
    interrupts, before = Interrupts(), {}
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    try:
        if threading.current_thread() is threading.main_thread():
            for number, handler in usual.items():
                if signal.getsignal(number) == handler:
                    before[number] = signal.signal(number, interrupts.hear)
        yield interrupts
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Interrupts:
    """The signals of a run: at once, or held back to a moment of its choice.

    KeyboardInterrupt for SIGINT, SystemExit with code 143 for SIGTERM, so that files and worker
    processes are closed on the way out.
    """

    def __init__(self) -> None:
        self._held, self._waiting = False, 0

    @contextmanager
    def held_back(self) -> Iterator[None]:
        """Let the first signal wait inside the block until `due` is asked for; not the second."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        self.stop_if_due()

    @property
    def due(self) -> bool:
        """Whether a signal waits."""
        return self._waiting != 0

    def stop_if_due(self) -> None:
        """Raise the exception of the signal that waits, if there is one."""
        if self._waiting == signal.SIGINT:
            raise KeyboardInterrupt
        if self._waiting:
            raise SystemExit(128 + self._waiting)

    def hear(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: the first may wait, a second never does."""
        patient = self._held and not self._waiting
        self._waiting = number
        if not patient:
            self.stop_if_due()
