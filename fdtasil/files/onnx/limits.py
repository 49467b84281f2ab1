"""What an ONNX model may take: memory, and seconds for a call.

A file of 200 bytes can ask for terabytes, or for a loop without an end. The limits are far from
what controllers need, and cost a few microseconds a call: onnxruntime's own allocator keeps the
first, and one thread that looks at the running calls now and then the second.
"""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from fdtasil.files.onnx.runtime import runtime

if TYPE_CHECKING:
    import onnxruntime

try:
    import resource as _module
except ImportError:  # Windows has no such limits; time is limited there too
    _resource: ModuleType | None = None
else:
    _resource = _module

__all__ = ["CALL_SECONDS", "MEMORY", "limit_memory", "limit_process", "run_within_limits"]

CALL_SECONDS = 60.0
MEMORY = 4 * 2**30  # bytes, for all models of a process together
_FOLDED = 128 * 2**20  # bytes of a constant that onnxruntime computes while it opens a model
# Beside the models' own memory: the libraries, and copies of a model while it is opened.
_ROOM, _COPIES = 2**30, 6
_LOOKS = 20  # in the seconds of a call


def limit_memory(options: "onnxruntime.SessionOptions") -> None:
    """Have the sessions that are made with these options share the memory that there may be."""
    _register_allocator()
    options.add_session_config_entry("session.use_env_allocators", "1")
    options.add_session_config_entry(
        "optimization.constant_folding_max_output_size_in_bytes", str(_FOLDED)
    )


def limit_process(size: int) -> None:
    """Limit this process to the memory of a model of `size` bytes, where the system can.

    Address space would count what onnxruntime only reserves, so what is written to is limited.
    """
    if _resource is None:
        return
    most = MEMORY + _ROOM + _COPIES * size
    for limit, value in ((_resource.RLIMIT_DATA, most), (_resource.RLIMIT_CORE, 0)):
        hard = _resource.getrlimit(limit)[1]
        unlimited = hard == _resource.RLIM_INFINITY
        _resource.setrlimit(limit, (value if unlimited else min(value, hard), hard))


def run_within_limits(
    session: "onnxruntime.InferenceSession", outputs: Sequence[str], feed: dict[str, np.ndarray]
) -> list[np.ndarray]:
    """Return some outputs of a model.

    Raises:
        TimeoutError: If it takes longer than `CALL_SECONDS`. A call ends between two operators,
            or between two turns of a loop; a single operator can't be interrupted.
        MemoryError: If it takes more than `MEMORY`.
    """
    call = _Call(runtime().RunOptions())
    _watch(call)
    try:
        return [np.asarray(found) for found in session.run(outputs, feed, call.options)]
    except Exception as error:
        if call.looks > _LOOKS:
            message = f"one call took more than {CALL_SECONDS:g} s and was ended"
            raise TimeoutError(message) from error
        if "is smaller than requested bytes" in str(error):
            message = f"one call takes more than the {MEMORY / 2**30:g} GiB that there may be"
            raise MemoryError(message) from error
        raise
    finally:
        _running.discard(call)


@dataclass(eq=False)
class _Call:
    options: "onnxruntime.RunOptions"
    looks: int = field(default=0)


_running: set[_Call] = set()
_watcher: list[threading.Thread] = []
_lock = threading.Lock()


def _watch(call: _Call) -> None:
    _running.add(call)
    if _watcher and _watcher[0].is_alive():
        return
    with _lock:  # the first call of this process; a fork has no threads but its own
        if not _watcher or not _watcher[0].is_alive():
            _watcher[:] = [threading.Thread(target=_look, name="fdtasil-limits", daemon=True)]
            _watcher[0].start()


def _look() -> None:
    """End the calls that were seen too often.

    Looks are counted and not seconds: a process that is stopped for an hour has called no longer.
    """
    while True:
        time.sleep(CALL_SECONDS / _LOOKS)
        for call in tuple(_running):
            call.looks += 1
            if call.looks > _LOOKS:
                call.options.terminate = True


@cache
def _register_allocator() -> None:
    onnxruntime = runtime()
    memory = onnxruntime.OrtMemoryInfo(
        "Cpu",
        onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR,
        0,
        onnxruntime.OrtMemType.DEFAULT,
    )
    arena = onnxruntime.OrtArenaCfg({"max_mem": MEMORY})
    onnxruntime.create_and_register_allocator(memory, arena)
