"""The tables of the stability experiment."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.runner import Row
from benchmarks.statistics import interval
from benchmarks.tables import table

__all__ = ["NAMES", "STARTS", "THRESHOLDS", "Results", "breaks_at", "draw_table", "grouped"]

Results = Sequence[dict[str, Any]]
"""The results of one order and source, one for each seed."""

THRESHOLDS = {1.0: "1", 1 / 2: "1/2", 1 / 3: "1/3"}
"""1 / (p + 1) for p = 0, 1, 2, above which order p is enough (TaSIL, theorems 3.1, 3.2)."""
NAMES = {"none": "actions only", "jacobian": "analytic", "differences": "finite differences"}
STARTS = {"fresh": "from 50 fresh starts", "learnt": "from the 20 starts that were learnt from"}
_SHOWN = {**dict(sorted(THRESHOLDS.items())), 3.0: "3"}
_QUANTITIES = {"mean": "mean over time", "largest": "largest over time"}

_GAPS = """\
Imitation gap at some nu: median over seeds of the median over starts [95 % interval], and the
median over seeds of the 90 % quantile over starts. Seconds: of the whole cell by the clock on the
wall, whatever else the machine did.
"""
_BREAKS = """\
The nu below which a student's error on its own path is more than twice that on the expert's path:
median over seeds [95 % interval]. 0.05 is the end of the axis, where it does not break.
"""
_RATIOS = """\
Gap of the students of finite differences, as a share of that of the analytic ones: pairs of equal
seeds, median [95 % interval].
"""


def grouped(rows: Sequence[Row]) -> dict[tuple[int, str], Results]:
    """Return the results of each order and source, in the order of the legend."""
    found: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["cell"]["seed"]):
        key = row["cell"]["order"], row["cell"]["source"]
        found.setdefault(key, []).append(row["result"])
    names = list(NAMES)
    return dict(sorted(found.items(), key=lambda item: (item[0][0], names.index(item[0][1]))))


def breaks_at(result: dict[str, Any], starts: str, quantity: str) -> float:
    """Return the nu below which a student's error is more than twice that on the expert's path.

    Args:
        result: Of a cell.
        starts: "fresh" or "learnt".
        quantity: "mean" or "largest" over time.

    Returns:
        The largest such nu, interpolated; an end of the axis where it lies beyond.
    """
    judged = result[starts]
    ratio = np.log(judged[quantity]["median"]) - np.log(judged["on_expert"][quantity]["median"])
    nus, above = np.log(result["nus"]), np.flatnonzero(ratio > np.log(2))
    last = above[-1] if len(above) else 0
    if not len(above) or last == len(nus) - 1:
        return float(np.exp(nus[last]))
    pair = slice(last, last + 2)
    return float(np.exp(np.interp(np.log(2), ratio[pair][::-1], nus[pair][::-1])))


def draw_table(rows: Sequence[Row]) -> bytes:
    """Three tables: gaps by nu, where each order breaks, finite differences against analytic."""
    groups, shown = grouped(rows), [f"nu = {text}" for text in _SHOWN.values()]
    columns = [f"{starts}, {name}" for starts in STARTS for name in _QUANTITIES.values()]
    gaps = table(
        ["p", "derivatives", "starts", *shown, "seconds"],
        (_gaps(*group, rows, starts) for starts in STARTS for group in groups.items()),
    )
    breaks = table(
        ["p", "derivatives", "seeds", "1 / (p + 1)", *columns],
        (_breaks(*group) for group in groups.items()),
    )
    paired = table(
        ["p", "starts", *shown],
        (cells for order in (1, 2) for starts in STARTS for cells in _paired(rows, order, starts)),
    )
    return f"{_GAPS}\n{gaps}\n{_BREAKS}\n{breaks}\n{_RATIOS}\n{paired}".encode()


def _gaps(key: tuple[int, str], results: Results, rows: Sequence[Row], starts: str) -> list[str]:
    order, source = key
    cells = [str(order), NAMES[source], starts]
    for nu in _SHOWN:
        column = _column(results[0], nu)
        gaps = [result[starts]["gap"] for result in results]
        tail = float(np.median([gap["q90"][column] for gap in gaps]))
        cells.append(f"{_text([gap['median'][column] for gap in gaps])}, {tail:.2g}")
    ours = [row for row in rows if (row["cell"]["order"], row["cell"]["source"]) == key]
    return [*cells, f"{np.median([row['seconds'] for row in ours]):.0f}"]


def _breaks(key: tuple[int, str], results: Results) -> list[str]:
    order, source = key
    cells = [str(order), NAMES[source], str(len(results)), list(THRESHOLDS.values())[order]]
    for starts in STARTS:
        for quantity in _QUANTITIES:
            cells.append(_text([breaks_at(result, starts, quantity) for result in results]))
    return cells


def _paired(rows: Sequence[Row], order: int, starts: str) -> list[list[str]]:
    """Return the line of an order and its starts, or none where no seed has both sources."""
    ours, theirs = (
        {
            row["cell"]["seed"]: row["result"]
            for row in rows
            if (row["cell"]["order"], row["cell"]["source"]) == (order, source)
        }
        for source in ("differences", "jacobian")
    )
    seeds = sorted(ours.keys() & theirs.keys())
    if not seeds:
        return []
    cells = []
    for nu in _SHOWN:
        column = _column(ours[seeds[0]], nu)
        gaps = [
            [group[seed][starts]["gap"]["median"][column] for seed in seeds]
            for group in (ours, theirs)
        ]
        cells.append(_text((np.array(gaps[0]) / gaps[1]).tolist()))
    return [[str(order), starts, *cells]]


def _column(result: dict[str, Any], nu: float) -> int:
    return int(np.abs(np.array(result["nus"]) - nu).argmin())


def _text(values: Sequence[float]) -> str:
    low, high = interval(values, np.median)
    return f"{np.median(values):.2g} [{low:.2g}, {high:.2g}]"
