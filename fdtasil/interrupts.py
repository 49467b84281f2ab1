"""Ctrl-C and SIGTERM: at once, or held back to the next moment at which nothing is lost."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

__all__ = ["Interrupts"]


class Interrupts:
    """Turns the first SIGINT or SIGTERM inside the block into an exception.

    KeyboardInterrupt for SIGINT, SystemExit with code 143 for SIGTERM, so that files and worker
    processes are closed on the way out. A handler that is not Python's own is left in charge, and
    so is the main thread's where a run goes on in another one.
    """

    def __init__(self) -> None:
        self._before: dict[int, object] = {}
        self._held, self._waiting = False, 0

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
            for number, handler in usual.items():
                if signal.getsignal(number) == handler:
                    self._before[number] = signal.signal(number, self._hear)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]

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

    def _hear(self, number: int, frame: FrameType | None) -> None:
        patient = self._held and not self._waiting
        self._waiting = number
        if not patient:
            self.stop_if_due()
