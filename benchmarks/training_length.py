"""How long to train: return against gradient steps, with little data and with much."""

from collections.abc import Sequence
from typing import Any

from benchmarks.comparison import draw_methods
from benchmarks.distillation import STEPS, distillations, usual_arguments
from benchmarks.grid import SEEDS, experts
from benchmarks.runner import Cell, Row
from benchmarks.scores import scores_of

__all__ = ["BENCHMARK"]

BUDGETS = (5, 20)
LENGTHS = (STEPS, 2 * STEPS)
METHODS: dict[str, dict[str, Any]] = {
    f"10 probes, {steps:,} steps": {"probes": 10, "steps": steps} for steps in LENGTHS
}
SHORT, LONG = METHODS
PAIRS = ((LONG, SHORT),)


def cells(quick: bool) -> list[Cell]:
    """Every method, budget, seed and expert."""
    return [
        {"expert": expert, "episodes": budget, "method": method, "seed": seed}
        for method in METHODS
        for budget in (BUDGETS[:1] if quick else BUDGETS)
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, with `usual_arguments` but for the steps."""
    return usual_arguments(cell, METHODS[cell["method"]])


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables, of the budgets that are complete."""
    scores = scores_of(rows, list(METHODS), len(SEEDS))
    return draw_methods("training_length", scores, list(METHODS), PAIRS)


BENCHMARK = distillations("training_length", __doc__ or "", cells, arguments, draw)
