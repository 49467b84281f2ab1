"""Activations of the student: exact GELU against what boards and verifiers have."""

from collections.abc import Sequence
from typing import Any

from benchmarks.controllers import available
from benchmarks.distillation import HORIZON, distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.statistics import difference_text, interval_text, paired_difference
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

ACTIVATIONS = ("gelu", "relu", "silu", "tanh")
WIDTHS = (256, 64)
EPISODES = 1


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
    """One table: experts and widths down, activations across."""
    lines = []
    for width in WIDTHS:
        whole: dict[str, dict[tuple[str, int], float]] = {name: {} for name in ACTIVATIONS}
        for row in rows:
            cell = row["cell"]
            if cell["width"] == width:
                key = cell["expert"], cell["seed"]
                whole[cell["activation"]][key] = row["result"]["normalized_return"]
        shared = set.intersection(*(set(scores) for scores in whole.values()))
        for expert in dict.fromkeys(expert for expert, _ in sorted(shared)):
            mine = {
                name: {key: value for key, value in scores.items() if key in shared}
                for name, scores in whole.items()
            }
            found = [
                [value for (one, _), value in scores.items() if one == expert]
                for scores in mine.values()
            ]
            if len(found[0]) > 1:
                lines.append([expert, str(width), *map(interval_text, found)])
        if len(shared) > 1:
            kept = {
                name: {key: scores[key] for key in sorted(shared)}
                for name, scores in whole.items()
            }
            texts = [
                difference_text(*paired_difference(kept[name], kept["gelu"]), 3)
                for name in ACTIVATIONS[1:]
            ]
            lines.append(["all, minus gelu", str(width), "", *texts])
    return {"activations.md": table(["expert", "width", *ACTIVATIONS], lines).encode()}


BENCHMARK = distillations("activations", __doc__ or "", cells, arguments, draw)
