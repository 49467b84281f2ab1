"""Slow experts, asked by several processes or threads at once.

Why not `concurrent.futures.ProcessPoolExecutor`: its workers import the caller's `__main__`, so a
script without a guard would run itself again in each of them; it can't end one hung worker; and
when one dies it says neither which nor how.
"""

from collections.abc import Callable
from dataclasses import replace

from fdtasil.checks import check_count, check_number
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.expert import Expert
from fdtasil.experts.workers.handle import WorkerProcess
from fdtasil.experts.workers.pool import WorkerGroup
from fdtasil.rollouts.behaviours import Policy

__all__ = ["Workers", "check_workers", "with_processes", "with_threads"]

Workers = int | str
"""A number, "ray" (a worker for each core of a Ray cluster), or "ray:8"."""

# Rows that a worker is handed at once. A fixed number: which rows are asked together must not
# depend on how many workers there are, since the last bits of an answer may depend on it.
BATCH = 8


def check_workers(
    workers: Workers, threads: bool, timeout: float | None, remote: bool
) -> tuple[Workers, float | None]:
    """Return how an expert is to be asked: workers and timeout, as plain numbers.

    Args:
        workers: How many processes or threads, or those of a Ray cluster.
        threads: Whether they are threads.
        timeout: Seconds for a batch, or None.
        remote: Whether the expert keeps the time itself, as those behind HTTP do.

    Raises:
        SettingError: If the arguments don't go together.
    """
    if isinstance(workers, str):
        _check_ray(workers, threads, remote)
    else:
        workers = check_count("workers", workers, least=0)
    if threads and not workers:
        raise SettingError(
            "threads=True with workers=0", "a number of threads", "write workers=2, threads=True"
        )
    if timeout is None:
        return workers, None
    timeout = check_number("timeout", timeout, positive=True)
    if not remote and (threads or not workers):
        raise SettingError(
            f"timeout={timeout:g} without processes",
            "an expert in a process of its own: only that can be ended while it hangs",
            "write workers=1, or leave timeout= out",
        )
    return workers, timeout


def _check_ray(workers: str, threads: bool, remote: bool) -> None:
    name, colon, count = workers.partition(":")
    if name != "ray" or (colon and not (count.isascii() and count.isdigit() and int(count))):
        raise SettingError(f"workers={workers!r}", 'a number, "ray" or "ray:8"', "write workers=4")
    if threads or remote:
        other = "threads=True" if threads else "an expert that waits for a server"
        step = "leave workers= out, or write workers=8" if remote else "leave threads= out"
        raise SettingError(f"workers={workers!r} with {other}", "one of the two", step)


def with_threads(expert: Expert, workers: int) -> Expert:
    """Return the expert, asked by so many threads of this process."""
    askers = [_Thread(expert.answer) for _ in range(workers)]
    return replace(expert, workers=WorkerGroup(askers))


def with_processes(
    expert: Expert, opener: Callable[[], Policy] | None, workers: Workers, timeout: float | None
) -> Expert:
    """Return the expert, asked by processes that each hold a copy of it.

    Args:
        expert: The expert, opened in this process.
        opener: Opens it in another, where it can't be sent as it is; sent by cloudpickle.
        workers: How many, or "ray".
        timeout: Seconds after which a batch without an answer is an error, or None.

    Raises:
        ExpertError: If it can't be sent.
    """
    import cloudpickle

    answer = expert.answer  # the lambda must not take the whole expert along
    try:
        parcel = cloudpickle.dumps(opener or (lambda: answer))
    except Exception as error:  # each type that can't be sent has its own
        raise ExpertError(
            f"{expert.name} can't be sent to another process: {type(error).__name__}: {error}",
            "a function that cloudpickle can take",
            "pass the path of an ONNX file or a zip, open what can't be sent inside the function "
            "at its first call, or write threads=True",
        ) from error
    if isinstance(workers, str):
        from fdtasil.experts.workers.on_ray import with_ray

        return with_ray(expert, parcel, int(workers.partition(":")[2] or 0) or None, timeout)
    titles = [f"worker {k + 1} of {workers} of {expert.name}" for k in range(workers)]
    askers = [WorkerProcess(title, parcel, timeout) for title in titles]
    return replace(expert, workers=WorkerGroup(askers))


class _Thread:
    """Answers in the thread that asks; Python can't stop one."""

    def __init__(self, answer: Policy) -> None:
        self.answer = answer

    def recover(self) -> None:
        pass

    def stop(self) -> None:
        pass
