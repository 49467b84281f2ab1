"""The picture and the table of the stability experiment."""

from collections.abc import Sequence

from benchmarks.runner import Row

__all__ = ["draw_figure", "draw_table"]


def draw_figure(rows: Sequence[Row]) -> bytes:
    raise NotImplementedError


def draw_table(rows: Sequence[Row]) -> bytes:
    raise NotImplementedError
