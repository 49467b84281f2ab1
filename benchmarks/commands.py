"""A command that stands still in an episode: what one to ten demonstrations teach of others."""

from collections.abc import Sequence
from typing import Any

from benchmarks.distillation import distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.scores import by_demonstrations

__all__ = ["BENCHMARK"]

EXPERT = "Reacher-v5"
EPISODES = (1, 2, 5, 10)
# The goal, coordinates 4 and 5, lies in a disc of 0.2 metres: 0.1 in either direction.
SPREAD = "4:0.1,5:0.1"
METHODS: dict[str, dict[str, Any]] = {
    "plain cloning": {"probes": 0},
    "fresh": {"probes": "fresh"},
    "fresh, spread": {"probes": "fresh", "spread": SPREAD},
}


def cells(quick: bool) -> list[Cell]:
    """Every number of demonstrations, seed and method."""
    return [
        {"expert": EXPERT, "episodes": episodes, "method": method, "seed": seed}
        for episodes in (EPISODES[:1] if quick else EPISODES)
        for seed in (SEEDS[:2] if quick else SEEDS)
        for method in METHODS
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the expert of a cell, and what is not left at its default."""
    shape = {name: cell[name] for name in ("expert", "episodes", "seed")}
    return {**shape, "evaluation_episodes": 50, **METHODS[cell["method"]]}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: demonstrations down, methods across."""
    text = by_demonstrations(rows, EPISODES, list(METHODS))
    return {"commands.md": text.encode()}


BENCHMARK = distillations("commands", __doc__ or "", cells, arguments, draw)
