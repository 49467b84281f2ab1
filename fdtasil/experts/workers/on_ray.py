"""Slow experts, asked by the machines of a Ray cluster."""

from concurrent.futures import CancelledError
from dataclasses import replace
from typing import Any

import numpy as np

from fdtasil.errors import ExpertError, SettingError, first_line, warn
from fdtasil.experts.batches import RaisedElsewhere
from fdtasil.experts.expert import Expert
from fdtasil.experts.workers.pool import WorkerGroup

__all__ = ["with_ray"]

_PATIENCE = 30.0  # seconds that an actor may wait for a core before that is said
_TRIES = 3  # machines on which a batch is asked before it is an error


def with_ray(expert: Expert, parcel: bytes, workers: int | None, timeout: float | None) -> Expert:
    """Return the expert, asked by actors that each hold a copy of it.

    Args:
        expert: The expert, opened in this process.
        parcel: A function without arguments that opens it elsewhere, pickled.
        workers: How many actors of one core; None for as many as the cluster has.
        timeout: Seconds after which a batch without an answer is an error, or None.

    Raises:
        SettingError: If ray is not installed.
        ExpertError: If there is no cluster.
    """
    try:
        import ray
    except ImportError as error:
        raise SettingError(
            'workers="ray", and ray is not installed', "the package", 'pip install "fdtasil[ray]"'
        ) from error
    if not ray.is_initialized():
        try:
            ray.init(log_to_driver=False)  # RAY_ADDRESS, or one of this machine
        except Exception as error:  # of its own, or of the network
            raise ExpertError(
                f"no Ray cluster: {type(error).__name__}: {first_line(error)}",
                "one that RAY_ADDRESS names, or room for one on this machine",
                "call ray.init(...) yourself first",
            ) from error
    count = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
    askers = [_Actor(ray, f"{expert.name} on Ray", parcel, timeout) for _ in range(count)]
    return replace(expert, workers=WorkerGroup(askers))


class _Actor:
    """One copy of the expert on the cluster, made anew where it was lost with its machine.

    Args:
        ray: The package.
        title: What to call it in messages.
        parcel: Opens the expert.
        timeout: Seconds for a batch, or None.
    """

    def __init__(self, ray: Any, title: str, parcel: bytes, timeout: float | None) -> None:
        self._ray, self._title, self._parcel, self._timeout = ray, title, parcel, timeout
        self._handle: Any = None
        self._stopped = False

    def recover(self) -> None:
        """Begin anew: nothing is left of a batch that was given up, for its actor was ended."""
        self._stopped = False

    def stop(self) -> None:
        """End the actor, whatever it is busy with, and begin no other; see `Asker`."""
        self._stopped = True
        self._end()

    def _end(self) -> None:
        handle, self._handle = self._handle, None
        if handle is not None and self._ray.is_initialized():
            self._ray.kill(handle)

    def answer(self, rows: np.ndarray) -> np.ndarray:
        """Answer one batch; a lost actor's batch is asked again by another one."""
        errors = self._ray.exceptions
        for left in reversed(range(_TRIES)):
            try:
                handle = self._handle or self._begun()
                return self._ray.get(handle.answer.remote(rows), timeout=self._timeout)
            except errors.GetTimeoutError:
                self._end()
                raise ExpertError(
                    f"{self._title} gave no answer to {len(rows)} observations within "
                    f"{self._timeout:g} s",
                    "an answer in time",
                    "raise timeout=, or see what it does there",
                ) from None
            except errors.RayTaskError as error:
                cause = error.cause or error
                raise RaisedElsewhere(type(cause).__name__, str(cause)) from error
            except errors.RayError as error:
                self._end()
                if self._stopped:  # it was ended, and not lost
                    raise CancelledError from error
                if getattr(error, "actor_init_failed", False):
                    raise ExpertError(
                        f"{self._title} can't open it: {str(error).strip().splitlines()[-1]}",
                        "an expert that opens there as it does here",
                        "install there what it imports, and let it need no file of this machine",
                    ) from error
                if not left:
                    raise ExpertError(
                        f"{self._title} was lost {_TRIES} times with a batch of {len(rows)}: "
                        f"{first_line(error)}",
                        "workers that last",
                        "look whether the expert ends its process, or takes too much memory",
                    ) from error
        raise AssertionError("the last try returns or raises")

    def _begun(self) -> Any:
        """Begin an actor, and return it when it has opened the expert."""
        self._handle = handle = self._ray.remote(num_cpus=1)(_Copy).remote(self._parcel)
        if self._stopped:  # in this order no stop is lost: either it sees the actor, or we see it
            self._end()
            raise CancelledError
        opened = handle.opened.remote()
        waited, _ = self._ray.wait([opened], timeout=_PATIENCE)
        if not waited:
            warn(
                f"{self._title} waits for a free core: each copy holds one as long as its expert "
                "is there"
            )
        self._ray.get(opened)
        return handle


class _Copy:
    """The expert in another process."""

    def __init__(self, parcel: bytes) -> None:
        import pickle

        self._policy = pickle.loads(parcel)()

    def opened(self) -> bool:
        """Answer as soon as there is something to ask."""
        return True

    def answer(self, rows: np.ndarray) -> np.ndarray:
        """Answer one batch."""
        from fdtasil.experts.worker_process import as_array

        return as_array(self._policy(rows))
