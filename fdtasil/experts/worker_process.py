"""A worker: batches come in by its standard input, answers go out by its standard output.

It is run as a file, not imported as a part of fdtasil: importing the package loads torch, and a
worker without it starts in a tenth of the time and memory. Nothing but the standard library is
imported before the parent has said where modules lie.
"""

import ctypes
import os
import pickle
import queue
import signal
import struct
import sys
import threading
import traceback
from collections.abc import Callable
from typing import IO, Any

__all__ = ["as_array", "connect", "receive", "send"]

_LENGTH = struct.Struct("<Q")
_PARENT_DEATH = 1  # PR_SET_PDEATHSIG


def send(stream: IO[bytes], message: Any) -> None:
    """Write one message."""
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    stream.write(_LENGTH.pack(len(data)))
    stream.write(data)
    stream.flush()


def receive(stream: IO[bytes]) -> bytes:
    """Read one message, still pickled.

    Raises:
        EOFError: If the other side is gone.
    """
    head = stream.read(_LENGTH.size)
    length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
    data = stream.read(length)
    if not length or len(data) < length:  # it may end in the middle of a message
        raise EOFError
    return data


def as_array(answer: Any) -> Any:
    """Return what an expert answered as a float32 array of its own.

    A torch tensor may have a gradient or lie on a GPU, and actions may come with a None beside
    them, as from stable-baselines3's `predict`.

    Raises:
        Exception: What numpy or torch has against it.
    """
    import numpy as np

    found = answer
    if isinstance(answer, tuple) and len(answer) == 2 and np.ndim(answer[0]) == 2:
        if answer[1] is not None and np.ndim(answer[1]) != 3:  # derivatives, (B, m, n)
            raise TypeError("it returned a second value beside the actions, such as a state")
        found = answer[0]
    if isinstance(answer, (dict, tuple)) and found is answer and not _is_array(answer):
        parts = list(answer) if isinstance(answer, dict) else list(range(len(answer)))
        named = ", ".join(map(str, parts[:8]))
        kind = type(answer).__name__
        raise TypeError(f"it returned a {kind} of several things ({named}): say which by output=")
    if hasattr(found, "detach"):  # torch is not imported where the expert does not need it
        found = found.detach().cpu().float().numpy()
    if np.ma.is_masked(found):
        raise TypeError("it returned values that are masked")
    found = np.asarray(found)
    if found.dtype.kind == "c":
        raise TypeError("it returned complex numbers")
    texts = found.dtype.kind == "O" and any(isinstance(one, (str, bytes)) for one in found.flat)
    if found.dtype.kind not in "biufO" or texts:  # numpy reads numbers out of texts and dates
        raise TypeError(f"it returned {'texts' if texts else f'values of {found.dtype}'}")
    return np.array(found, dtype=np.float32, order="C")


def _is_array(answer: Any) -> bool:
    """Whether a tuple is rows of numbers, and not several things."""
    import numpy as np

    if isinstance(answer, dict):
        return False
    try:
        return np.asarray(answer).dtype.kind in "biuf"
    except ValueError:  # of several shapes
        return False


def main() -> None:
    """Answer batches until the parent closes the pipe, or is no more."""
    _serve(*connect())


def connect() -> tuple["queue.SimpleQueue[bytes]", IO[bytes]]:
    """Return where the parent's messages come in, still pickled, and where replies go out.

    From here on this process ends with its parent, and what it prints goes to standard error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    _die_with_the_parent()
    requests, replies = _private_streams()
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests, inbox), daemon=True).start()
    return inbox, replies


def _die_with_the_parent() -> None:
    """Have the kernel kill this process, even in code that never lets another thread run."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGKILL)


def _private_streams() -> tuple[IO[bytes], IO[bytes]]:
    """Keep the two pipes to ourselves: what the expert prints goes to standard error."""
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return requests, replies


def _read(requests: IO[bytes], inbox: "queue.SimpleQueue[bytes]") -> None:
    """Hand messages over; end the process when the pipe ends, whatever it is busy with."""
    try:
        while True:
            inbox.put(receive(requests))
    finally:
        os._exit(0)


def _serve(inbox: "queue.SimpleQueue[bytes]", replies: IO[bytes]) -> None:
    sys.path[:], parcel = pickle.loads(inbox.get())
    # Only now is it known where modules lie.
    # The parcel is a function that opens the expert; pickle finds cloudpickle by itself.
    outcome, answer = _attempt(lambda: pickle.loads(parcel)())
    send(replies, (outcome, None if outcome == "done" else answer))
    while True:
        rows = pickle.loads(inbox.get())
        send(replies, _attempt(lambda rows=rows: as_array(answer(rows))))


def _attempt(work: Callable[[], Any]) -> tuple[str, Any]:
    """Return what the work returns, or plain strings: exceptions may fail to be pickled."""
    try:
        return "done", work()
    except BaseException as error:  # SystemExit too: an expert has no say over the run
        parts = [getattr(error, part, None) for part in ("found", "expected", "next_step")]
        if None not in parts:  # one of fdtasil's, which need not be imported to be known
            return "refused", parts
        return "raised", (type(error).__name__, _text(error), traceback.format_exc())


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception as failure:  # of the expert's own class
        return f"its text raises {type(failure).__name__}"


if __name__ == "__main__":
    main()
