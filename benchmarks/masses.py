"""Other masses than the demonstrations': what `spread=` does for a robot that observes its own."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.controllers import available
from benchmarks.distillation import recorded
from benchmarks.grid import SEEDS
from benchmarks.robustness import compare_under_disturbances, shares_under
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.statistics import (
    DIFFERENCES_NOTE,
    SCORES_NOTE,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

EXPERTS = ("paper/Humanoid", "Humanoid-v5")
FRESH, SPREAD = "fresh", "fresh, masses spread"
METHODS = ("plain cloning", FRESH, SPREAD)
DISTURBED = ("none", "mass x 0.8", "mass x 1.2")
SHARE = 0.1  # of a mass, the deviation that it will have
# Ten numbers of inertia for each body, the last its mass, behind 22 positions and 23 speeds.
_FIRST, _EACH, _MASS = 45, 10, 9
_BODIES = {"paper/Humanoid": 14, "Humanoid-v5": 13}


def cells(quick: bool) -> list[Cell]:
    """Every expert, seed and method."""
    return [
        {"expert": expert, "method": method, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
        for expert in available(*EXPERTS)
        for method in METHODS
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil with the usual masses, and compare with the expert on others."""
    settings: dict[str, Any] = {"probes": 0 if cell["method"] == METHODS[0] else "fresh"}
    if cell["method"] == SPREAD:
        settings["spread"] = _masses(cell["expert"])
    found = compare_under_disturbances(
        cell["expert"], cell["seed"], {**settings, "device": device}, DISTURBED
    )
    return {name: found[name] for name in DISTURBED}


def _masses(expert: str) -> dict[int, float]:
    """Return the coordinates of the bodies' masses, and how far each will go."""
    first = recorded(expert, episodes=1, seed=0, horizon=2).demonstrations.observations[0]
    places = [_FIRST + _EACH * body + _MASS for body in range(_BODIES[expert])]
    return {place: SHARE * float(first[place]) for place in places if first[place] > 0}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: experts and masses down, methods across."""
    lines, gains = [], []
    for expert in dict.fromkeys(row["cell"]["expert"] for row in rows):
        for name in DISTURBED:
            shares = shares_under(rows, expert, name, METHODS)
            theirs = list(shares.pop("expert").values())
            if any(len(found) < 2 for found in shares.values()):
                continue
            texts = [interval_text(list(found.values())) for found in shares.values()]
            gains.append(paired_difference(shares[SPREAD], shares[FRESH]))
            lines.append([expert, name, f"{np.mean(theirs):.2f}", *texts])
    cells, counted = difference_column(gains)
    lines = [[*line, gain] for line, gain in zip(lines, cells, strict=True)]
    lines.append(["intervals", "", "", "", "", "", counted])
    heads = ["expert", "physics", "the expert", *METHODS, f"{SPREAD} - {FRESH}"]
    text = f"{SCORES_NOTE}\n{DIFFERENCES_NOTE}\n{table(heads, lines)}"
    return {"masses.md": text.encode()}


BENCHMARK = Benchmark("masses", __doc__ or "", cells, run, draw)
