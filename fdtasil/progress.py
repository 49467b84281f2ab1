"""Progress bars with the time left; silent where there is neither a terminal nor a notebook."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

__all__ = ["Bar", "Progress"]


class Bar:
    """A bar that is shown, or not."""

    def __init__(self, bar: tqdm) -> None:
        self._bar = bar

    def move(self, count: int) -> None:
        """Move on by `count`."""
        self._bar.update(count)

    def reach(self, count: int) -> None:
        """Move on to `count` in all."""
        self._bar.update(count - self._bar.n)

    def lengthen(self, total: int) -> None:
        """Say how long it is, where that was not known before."""
        self._bar.total = total
        self._bar.refresh()


class Progress:
    """The bars of a run, one for each thing that takes long.

    Args:
        shown: Whether to show bars at all.
    """

    def __init__(self, shown: bool) -> None:
        # A program without a console has no stderr; None lets tqdm look for a terminal.
        self._disable = (False if _in_a_notebook() else None) if shown and sys.stderr else True

    @contextmanager
    def bar(self, title: str, unit: str, total: int | None = None) -> Iterator[Bar]:
        """Show a bar while the block runs."""
        with tqdm(
            total=total, desc=f"{title:24}", unit=unit, disable=self._disable, leave=False
        ) as bar:
            yield Bar(bar)


def _in_a_notebook() -> bool:
    """Whether a Jupyter kernel runs this: its stderr is no terminal, but somebody looks at it."""
    ipython = sys.modules.get("IPython")  # a kernel has it loaded
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")
