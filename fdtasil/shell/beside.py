"""The plain cloning that a run is compared with, in a process of its own beside it."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fdtasil.results.evaluation import Evaluation
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.elsewhere import elsewhere
from fdtasil.shell.call import distil

__all__ = ["evaluated_beside"]


@contextmanager
def evaluated_beside(
    arguments: Mapping[str, Any] | None,
) -> Iterator[Callable[[], Evaluation | None]]:
    """Distil in another process while the block runs, on a core that is idle otherwise.

    Args:
        arguments: Of the shell's `distil`; None to do nothing.

    Yields:
        What waits for the evaluation and returns it, or raises what the distillation raised.
    """
    if arguments is None:
        yield lambda: None
        return
    # It warns of nothing: the run beside it warns of the same.
    with elsewhere("the plain cloning", _evaluation, dict(arguments)) as call:
        yield call.outcome


def _evaluation(arguments: Mapping[str, Any]) -> Evaluation | None:
    import_module_of(arguments["env"])
    return distil(arguments, progress=False).evaluation
