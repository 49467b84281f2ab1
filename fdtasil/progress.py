"""Progress bars with the time left; silent where there is no terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

__all__ = ["Stages"]


class Stages:
    """The stages of a run, one bar each.

    Args:
        shown: Whether to show bars at all.
    """

    def __init__(self, shown: bool) -> None:
        # None lets tqdm look whether there is a terminal.
        self._disable = None if shown else True

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Show a bar while the block runs; yields the function that moves it on."""
        with tqdm(
            total=total, desc=f"{title:24}", unit=unit, disable=self._disable, leave=False
        ) as bar:

            def move(count: int) -> None:
                bar.update(count)

            yield move
