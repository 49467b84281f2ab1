"""stable-baselines3 seeds the generators of a whole process; here it does not."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["randomness_kept"]


@contextmanager
def randomness_kept() -> Iterator[None]:
    """Undo the seeding of all global generators that making or loading an agent does."""
    plain, numbers = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        random.setstate(plain)
        np.random.set_state(numbers)
