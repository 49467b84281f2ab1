"""How torch computes on this machine: threads, matrix products and the device."""

import functools
import re
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import torch

from fdtasil.errors import FitError, SettingError

__all__ = ["ask_module", "in_turn", "pick_device", "torch_settings", "usual_modes"]

# "medium" sends float32 products through oneDNN, twice as fast on AMD CPUs as the default and
# as exact there; a chip with bfloat16 matrix units may round for real, which this bound catches.
_ACCEPTED_ERROR = 2e-6
# Bytes of the largest block that glibc learns from: once one was freed, none of up to this size is
# mapped anew each time, and the heap keeps twice as much. Untouched, it takes no memory itself.
_KEPT = 2**25 - 2**16
_FULL = re.compile("CUDA.*out of memory|CUBLAS_STATUS_ALLOC_FAILED")


def ask_module(module: torch.nn.Module, observations: np.ndarray) -> np.ndarray:
    """Answer (B, n) observations with (B, m) float32, on the module's device and in its type."""
    like = next(module.parameters(), torch.zeros(()))
    with torch.no_grad():
        batch = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
        found = module(batch.to(like.device, like.dtype))
    if isinstance(found, torch.Tensor):
        return found.float().cpu().numpy()
    return found  # several things, or none: who asks says so


def pick_device(device: str) -> torch.device:
    """Return the torch device of that name.

    Raises:
        SettingError: If the name is unknown, or asks for a GPU that is not there.
    """
    try:
        picked = torch.device(device)
    except (RuntimeError, TypeError):
        raise SettingError(
            f"device={device!r}", '"cpu", "cuda" or "cuda:N"', 'write device="cpu"'
        ) from None
    if picked.type == "cuda" and not torch.cuda.is_available():
        raise SettingError(
            f"device={device!r}, and this torch ({torch.__version__}) sees no GPU",
            "a CUDA build of torch and a visible GPU",
            'write device="cpu", or install a CUDA build of torch',
        )
    if picked.type == "cuda" and (picked.index or 0) >= torch.cuda.device_count():
        raise SettingError(
            f"device={device!r}, and this torch sees {torch.cuda.device_count()} GPU(s)",
            "the number of one of them, from 0",
            'write device="cuda"',
        )
    if picked.type not in ("cpu", "cuda"):
        raise SettingError(f"device={device!r}", '"cpu" or "cuda"', 'write device="cpu"')
    return picked


@contextmanager
def in_turn() -> Iterator[None]:
    """Wait until no other thread is inside such a block, for what a process has only once.

    Torch's threads and precision, and the simulator's warnings, are those of the whole process:
    two runs at once would have each other's, and other bytes. A thread may enter again.
    """
    while not _TURN.acquire(timeout=0.2):  # so that Ctrl-C is heard
        pass
    try:
        yield
    finally:
        _TURN.release()


_TURN = threading.RLock()


@contextmanager
def usual_modes() -> Iterator[None]:
    """Compute as torch does by itself, whatever modes this thread of the caller's is in.

    The caller may have chosen no gradients, inference, mixed precision, or the device "meta".
    """
    with ExitStack() as modes:
        modes.enter_context(torch.inference_mode(False))
        modes.enter_context(torch.enable_grad())
        modes.enter_context(torch.autocast("cpu", enabled=False))
        if torch.cuda.is_available():
            modes.enter_context(torch.autocast("cuda", enabled=False))
        if torch.get_default_device().type != "cpu":  # a mode of its own makes all calls slower
            modes.enter_context(torch.device("cpu"))
        yield


@contextmanager
def torch_settings(device: torch.device, threads: int = 1) -> Iterator[str]:
    """Compute in turn, with `threads` threads and the fastest exact matrix product.

    Small networks are faster on one thread, and several runs at once are far faster so. What the
    caller has set is there again after the block. What a step frees stays with the process for the
    next step: a system that hands out zeroed pages each time takes a third of a large step.

    Args:
        device: Where is computed; the product is measured there.
        threads: Number of torch threads inside the block.

    Yields:
        The float32 matrix-product precision in force: `"medium"` where it was measured to be
        exact, the caller's own setting elsewhere.

    Raises:
        FitError: If the GPU has no memory left, here or inside the block.
    """
    with in_turn(), usual_modes():
        before_threads, before_type = torch.get_num_threads(), torch.get_default_dtype()
        before_precision = torch.get_float32_matmul_precision()
        torch.set_num_threads(threads)
        torch.set_default_dtype(torch.float32)
        try:
            torch.empty(_KEPT, dtype=torch.uint8, device="cpu")
            # Of GPUs too, where it rounds, and where the caller may compute beside this run.
            if not torch.cuda.is_available():
                torch.set_float32_matmul_precision("medium")
            if _product_error(device, torch.get_float32_matmul_precision()) > _ACCEPTED_ERROR:
                torch.set_float32_matmul_precision(before_precision)
            yield torch.get_float32_matmul_precision()
        except RuntimeError as error:
            # Without room for CUDA itself, or for its libraries, the error is of another class.
            if not _FULL.search(str(error)):
                raise
            raise _full(error) from error
        finally:
            torch.set_float32_matmul_precision(before_precision)
            torch.set_default_dtype(before_type)
            torch.set_num_threads(before_threads)


def _full(error: RuntimeError) -> FitError:
    said = str(error).removeprefix("CUDA out of memory. ").partition(". ")[0]
    return FitError(
        f"no GPU memory left: {said.splitlines()[0]}",
        "room for all demonstrations, the answers around them and a training step",
        'end what else uses the GPU, or compute on the CPU: device="cpu"',
    )


@functools.cache  # as long as some training steps, and always the same
def _product_error(device: torch.device, precision: str) -> float:
    """Return the relative error of one float32 product of a training step's size, as now set."""
    random = torch.Generator().manual_seed(0)
    left, right = torch.randn(128, 512, generator=random), torch.randn(512, 512, generator=random)
    exact = left.double() @ right.double()
    product = (left.to(device) @ right.to(device)).cpu()
    return float((product - exact).norm() / exact.norm())
