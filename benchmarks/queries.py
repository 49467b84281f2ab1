"""Is a query better spent on a probe, or on another trajectory: return against queries."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.distillation import distillations, usual_arguments
from benchmarks.grid import SEEDS, STANDARD_METHODS, experts, label
from benchmarks.panels import draw_panels
from benchmarks.runner import Cell, Row
from benchmarks.statistics import (
    DIFFERENCES_NOTE,
    SCORES_NOTE,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

# Trajectories of each method. The baselines' go far enough to ask what 10 probes of 5 ask.
BUDGETS: dict[str, tuple[int, ...]] = {
    "plain": (2, 5, 10, 20, 40, 80),
    "plain, longer": (80,),
    "dagger": (20, 80),
    "1": (2, 5, 20),
    "10": (2, 5, 20),
    "50": (2, 5, 20),
    "fresh": (1, 2, 5, 20),
}
METHODS: dict[str, dict[str, Any]] = {
    **STANDARD_METHODS,
    # Many states are each seen seldom in as many steps: is that what holds cloning back?
    "plain, longer": {"probes": 0, "steps": 12_000},
    "dagger": {"trainer": "dagger", "probes": 0},
}
LABELS = {method: label(method) for method in BUDGETS} | {
    "plain, longer": "plain cloning, three times the steps",
    "dagger": "DAgger",
}
BASELINES = ("plain", "plain, longer", "dagger")
# The answers that a student learns from; the gate's and the evaluation's are asked of all.
PURPOSES = ("act", "label", "calibrate", "probe")

_HEADS = ("expert", "method", "trajectories", "queries")

Curves = Mapping[str, Mapping[int, Mapping[int, tuple[int, float]]]]
"""method -> trajectories -> seed -> (queries, score)."""


def cells(quick: bool) -> list[Cell]:
    """Every seed, expert, method and number of trajectories."""
    return [
        {"expert": expert, "episodes": count, "method": method, "seed": seed}
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
        for method in BUDGETS
        for count in (BUDGETS[method][:2] if quick else BUDGETS[method])
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, with `usual_arguments`."""
    return usual_arguments(cell, METHODS[cell["method"]])


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables, of the experts that are complete."""
    curves = _curves(rows)
    if not curves:
        return {}
    text = f"{SCORES_NOTE}\n{_scores(curves)}\nAgainst a baseline that asks no less, and how many "
    text += f"times as much it asks. {DIFFERENCES_NOTE}\n{_differences(curves)}"
    return {"queries.png": _picture(curves), "queries.md": text.encode()}


def _curves(rows: Sequence[Row]) -> dict[str, Curves]:
    """Return the curves of each expert with every cell."""
    found: dict[str, dict[str, dict[int, dict[int, tuple[int, float]]]]] = {}
    for row in rows:
        cell, result = row["cell"], row["result"]
        asked = sum(result["queries"].get(purpose, 0) for purpose in PURPOSES)
        curve = found.setdefault(cell["expert"], {}).setdefault(cell["method"], {})
        point = curve.setdefault(cell["episodes"], {})
        point[cell["seed"]] = (asked, result["normalized_return"])
    return {
        expert: curves
        for expert, curves in sorted(found.items())
        if all(
            len(curves.get(method, {}).get(count, {})) >= len(SEEDS)
            for method, counts in BUDGETS.items()
            for count in counts
        )
    }


def _at_no_less(
    curves: Curves, ours: tuple[str, int], baseline: str
) -> tuple[dict[int, float], float] | None:
    """Return what a baseline reaches by seed, and how many times as much it asks.

    Of its budgets that ask no less, the least.

    No line has to be drawn between its budgets, and what is won is won in spite of what it asks
    more. None where it asks less at its largest.
    """
    asked = _asked(curves[ours[0]][ours[1]])
    enough = [count for count in BUDGETS[baseline] if _asked(curves[baseline][count]) >= asked]
    if not enough:
        return None
    points = curves[baseline][min(enough)]
    return {seed: score for seed, (_, score) in points.items()}, _asked(points) / asked


def _asked(points: Mapping[int, tuple[int, float]]) -> float:
    return float(np.median([cost for cost, _ in points.values()]))


def _scores(curves: Mapping[str, Curves]) -> str:
    rows = []
    for expert, of_expert in curves.items():
        for method, counts in BUDGETS.items():
            for count in counts:
                score = interval_text(_returns(of_expert[method][count]))
                rows.append([*_head(expert, of_expert, method, count), score])
    return table([*_HEADS, "return"], rows)


def _head(expert: str, curves: Curves, method: str, count: int) -> list[str]:
    """Return the cells that a line of either table begins with."""
    return [expert, LABELS[method], str(count), f"{_asked(curves[method][count]):,.0f}"]


def _returns(points: Mapping[int, tuple[int, float]]) -> list[float]:
    return [score for _, score in points.values()]


def _differences(curves: Mapping[str, Curves]) -> str:
    """Return a table of paired differences, ours - a baseline's who asks no less."""
    lines = [
        (expert, of_expert, *ours)
        for expert, of_expert in curves.items()
        for ours in _ours()
        if any(_at_no_less(of_expert, ours, baseline) for baseline in BASELINES)
    ]
    columns = []
    for baseline in BASELINES:
        theirs = [_at_no_less(of, (method, count), baseline) for _, of, method, count in lines]
        cells, counted = difference_column(
            [
                one
                and paired_difference(
                    {seed: score for seed, (_, score) in of[method][count].items()}, one[0]
                )
                for one, (_, of, method, count) in zip(theirs, lines, strict=True)
            ],
            missing="asks less",
        )
        times = [f" ({one[1]:.1f} x)" if one else "" for one in theirs]
        columns.append([*map("".join, zip(cells, times, strict=True)), counted])
    heads = [_head(*line) for line in lines] + [["intervals", "", "", ""]]
    rows = [[*head, *cells] for head, *cells in zip(heads, *columns, strict=True)]
    return table([*_HEADS, *(f"- {LABELS[baseline]}" for baseline in BASELINES)], rows)


def _ours() -> list[tuple[str, int]]:
    return [(m, count) for m, counts in BUDGETS.items() if m not in BASELINES for count in counts]


def _picture(curves: Mapping[str, Curves]) -> bytes:
    """Draw return against queries."""
    experts = {
        expert: {
            LABELS[method]: {
                _asked(of_expert[method][count]): _returns(of_expert[method][count])
                for count in counts
            }
            for method, counts in BUDGETS.items()
        }
        for expert, of_expert in curves.items()
    }
    return draw_panels(experts, "queries that the student learns from")


BENCHMARK = distillations("queries", __doc__ or "", cells, arguments, draw)
