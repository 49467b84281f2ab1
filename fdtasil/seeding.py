"""One integer enters, named streams leave; no global random state is read or written."""

import hashlib

import numpy as np
import torch

from fdtasil.checks import check_count

__all__ = ["episode_seeds", "generator", "torch_generator"]


def generator(seed: int, *path: str | int) -> np.random.Generator:
    """Return the numpy generator of the stream named by `path`.

    A stream is found by its name and not by its turn, so a new stream never shifts the others,
    and an episode keeps its stream whatever process or slot it runs in.

    Args:
        seed: The run's seed.
        *path: The stream's name, for example `("rollout", 0, 3)`.

    Example:
        >>> generator(0, "noise", 1).random() - generator(0, "noise", 1).random()
        0.0
    """
    return np.random.default_rng(_sequence(seed, path))


def torch_generator(seed: int, *path: str | int) -> torch.Generator:
    """Return the torch (CPU) generator of the stream named by `path`; see `generator`."""
    state = _sequence(seed, path).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state) >> 1)


def episode_seeds(seed: int, stream: str, first: int, count: int) -> list[int]:
    """Return the reset seeds of the episodes `first` to `first + count - 1` of a stream.

    Returns:
        `count` plain ints below 2**31: gymnasium refuses numpy integers.
    """
    return [int(generator(seed, stream, e).integers(2**31)) for e in range(first, first + count)]


def _sequence(seed: int, path: tuple[str | int, ...]) -> np.random.SeedSequence:
    name = "/".join(str(part) for part in path).encode()
    words = np.frombuffer(hashlib.sha256(name).digest()[:16], dtype=np.uint32)
    return np.random.SeedSequence(
        [check_count("seed", seed, 0, 2**32 - 1), *(int(word) for word in words)]
    )
