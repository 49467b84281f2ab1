"""Activations of the student: exact GELU against what boards and verifiers have."""

from collections.abc import Sequence
from itertools import islice
from statistics import fmean
from typing import Any

from benchmarks.controllers import available
from benchmarks.distillation import HORIZON, distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.statistics import (
    SCORES_NOTE,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

ACTIVATIONS = ("gelu", "relu", "silu", "tanh")
WIDTHS = (256, 64)
EPISODES = 1
_LAST_LINE = """\
In the last line a pair is an expert, and its score the mean over seeds; intervals are by Student's
t. **Bold** is significant with all six looked at together (Benjamini-Hochberg).
"""


def cells(quick: bool) -> list[Cell]:
    """Every expert, width, activation and seed, with the default probes."""
    return [
        {"expert": expert, "width": width, "activation": activation, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
        for width in WIDTHS
        for expert in (available("HalfCheetah-v5") if quick else available())
        for activation in ACTIVATIONS
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the expert of a cell, and what is not left at its default."""
    network = {"hidden": (cell["width"],) * 2, "activation": cell["activation"]}
    given = {name: cell[name] for name in ("expert", "seed")}
    return {**given, "episodes": EPISODES, "horizon": HORIZON, **network}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """A table a width: experts down, activations across, and what each costs beside GELU."""
    text, gains = f"{SCORES_NOTE}\n{_LAST_LINE}", []
    found = {w: _scores([row for row in rows if row["cell"]["width"] == w]) for w in WIDTHS}
    for of_width in found.values():
        means = [{e: fmean(of[name]) for e, of in of_width.items()} for name in ACTIVATIONS]
        pairs = len(of_width) > 1
        gains += [paired_difference(one, means[0]) if pairs else None for one in means[1:]]
    cells = iter(difference_column(gains, 3)[0])
    for width, of_width in found.items():
        lines = [[expert, *map(interval_text, of.values())] for expert, of in of_width.items()]
        lines.append(["all, minus gelu", "", *islice(cells, len(ACTIVATIONS) - 1)])
        text += f"\n## {width} x {width}\n\n{table(['expert', *ACTIVATIONS], lines)}"
    return {"activations.md": text.encode()}


def _scores(rows: Sequence[Row]) -> dict[str, dict[str, list[float]]]:
    """Return expert -> activation -> the scores of those seeds that all of them have."""
    found: dict[str, dict[str, dict[int, float]]] = {}
    for row in sorted(rows, key=lambda row: (row["cell"]["expert"], row["cell"]["seed"])):
        cell = row["cell"]
        of = found.setdefault(cell["expert"], {name: {} for name in ACTIVATIONS})
        of[cell["activation"]][cell["seed"]] = row["result"]["normalized_return"]
    seeds = {expert: set.intersection(*map(set, of.values())) for expert, of in found.items()}
    return {
        expert: {name: [one[seed] for seed in sorted(seeds[expert])] for name, one in of.items()}
        for expert, of in found.items()
        if len(seeds[expert]) > 1
    }


BENCHMARK = distillations("activations", __doc__ or "", cells, arguments, draw)
