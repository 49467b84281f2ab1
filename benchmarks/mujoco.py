"""The paper's main figure: cloning, DAgger, DART, each plain, with probes, with the Jacobian."""

from collections.abc import Sequence
from typing import Any

from benchmarks.comparison import draw_scores
from benchmarks.controllers import available
from benchmarks.distillation import distillations, usual_arguments
from benchmarks.grid import SEEDS, experts, side_by_side
from benchmarks.runner import Cell, Row
from benchmarks.scores import Column, Scores, scores_of, scores_text

__all__ = ["BENCHMARK"]

BUDGETS = (5, 20)
SOURCES: dict[str, int | str] = {"plain": 0, "probes": 10, "jacobian": "jacobian"}
_LABELS = {"plain": "plain", "probes": "10 probes", "jacobian": "analytic Jacobian"}
_NAMES = {"bc": "cloning", "dagger": "DAgger", "dart": "DART"}
# What is the default is left out: other benchmarks' cells are then seen to be the same.
TRAINERS: dict[str, dict[str, Any]] = {
    "bc": {},
    "dagger": {"trainer": "dagger"},
    "dart": {"trainer": "dart"},
}
METHODS = {
    f"{trainer}, {source}": {**setting, "probes": probes}
    for trainer, setting in TRAINERS.items()
    for source, probes in SOURCES.items()
}
# What probes add to each trainer, and what each trainer adds to probes.
PAIRS = (
    ("bc, probes", "bc, plain"),
    ("dagger, probes", "dagger, plain"),
    ("dart, probes", "dart, plain"),
    ("bc, probes", "dagger, plain"),
    ("dagger, probes", "bc, probes"),
    ("dart, probes", "bc, probes"),
)


def cells(quick: bool) -> list[Cell]:
    """Every budget, seed, expert and method."""
    names = [*experts(), *available("Swimmer-v5")]
    return side_by_side(quick, BUDGETS, names, METHODS)


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's trainer and source, with `usual_arguments`."""
    return usual_arguments(cell, METHODS[cell["method"]])


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """A picture of each budget, and two tables, of the cells that have every method and seed."""
    scores = scores_of(rows, list(METHODS), len(SEEDS))
    if not scores:
        return {}
    pictures = {
        f"mujoco_{budget}.png": draw_scores(
            _by_trainer(scores, budget), list(SOURCES), _LABELS.__getitem__, ""
        )
        for budget in dict.fromkeys(budget for _, budget in scores)
    }
    return {**pictures, "mujoco.md": scores_text(scores, list(METHODS), PAIRS).encode()}


def _by_trainer(scores: Scores, budget: Column) -> Scores:
    """Return the scores of one budget, trainers across and sources as methods."""
    return {
        (expert, _NAMES[trainer]): {source: found[f"{trainer}, {source}"] for source in SOURCES}
        for (expert, column), found in scores.items()
        for trainer in TRAINERS
        if column == budget
    }


BENCHMARK = distillations("mujoco", __doc__ or "", cells, arguments, draw)
