"""How torch computes on this machine: threads, matrix products and the device."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from fdtasil.errors import FitError, SettingError

__all__ = ["ask_module", "pick_device", "torch_settings"]

# "medium" sends float32 products through oneDNN, twice as fast on AMD CPUs as the default and
# as exact there; a chip with bfloat16 matrix units may round for real, which this bound catches.
_ACCEPTED_ERROR = 2e-6
_FULL = re.compile("CUDA.*out of memory|CUBLAS_STATUS_ALLOC_FAILED")


def ask_module(module: torch.nn.Module, observations: np.ndarray) -> np.ndarray:
    """Answer (B, n) observations with (B, m) float32, on the module's device and in its type."""
    like = next(module.parameters(), torch.zeros(()))
    with torch.no_grad():
        batch = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
        return module(batch.to(like.device, like.dtype)).float().cpu().numpy()


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
def torch_settings(device: torch.device, threads: int = 1) -> Iterator[str]:
    """Compute with `threads` threads and the fastest exact matrix product, then restore both.

    Small networks are faster on one thread, and several runs at once are far faster so.

    Args:
        device: Where is computed; the product is measured there.
        threads: Number of torch threads inside the block.

    Yields:
        The float32 matrix-product precision in force: `"medium"` where it was measured to be
        exact, the caller's own setting elsewhere.

    Raises:
        FitError: If the GPU has no memory left, here or inside the block.
    """
    before_threads, before_precision = (
        torch.get_num_threads(),
        torch.get_float32_matmul_precision(),
    )
    torch.set_num_threads(threads)
    try:
        torch.set_float32_matmul_precision("medium")
        if _product_error(device) > _ACCEPTED_ERROR:
            torch.set_float32_matmul_precision(before_precision)
        yield torch.get_float32_matmul_precision()
    except RuntimeError as error:
        # Without room for CUDA itself, or for its libraries, the error is of another class.
        if not _FULL.search(str(error)):
            raise
        said = str(error).removeprefix("CUDA out of memory. ").partition(". ")[0]
        raise FitError(
            f"no GPU memory left: {said.splitlines()[0]}",
            "room for all demonstrations, the answers around them and a training step",
            'end what else uses the GPU, or compute on the CPU: device="cpu"',
        ) from error
    finally:
        torch.set_float32_matmul_precision(before_precision)
        torch.set_num_threads(before_threads)


def _product_error(device: torch.device) -> float:
    """Return the relative error of one float32 product of a training step's size."""
    random = torch.Generator().manual_seed(0)
    left, right = torch.randn(128, 512, generator=random), torch.randn(512, 512, generator=random)
    exact = left.double() @ right.double()
    product = (left.to(device) @ right.to(device)).cpu()
    return float((product - exact).norm() / exact.norm())
