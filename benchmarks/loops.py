"""How experts' closed loops go on after one disturbed action, and around single states."""

from collections.abc import Sequence
from statistics import median
from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS
from benchmarks.distillation import HORIZON
from benchmarks.grid import every_expert
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.tables import table

__all__ = ["BENCHMARK"]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Diagnose the expert as its own student: what it forgives is no matter of a student."""
    path, env = CONTROLLERS[cell["expert"]].open()
    found = fdtasil.diagnose(path, path, env, horizon=HORIZON, seed=cell["seed"], progress=False)
    loop, around = found.stability, found.linearisation
    return {
        "rate": loop.rate,
        "rate_interval": loop.rate_interval,
        "eigenvalues": None if around is None else list(around.expert),
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: experts down."""
    text = "The factor by which a deviation changes in each step after a single action was\n"
    text += "disturbed: median of the seeds that have one, the least, the largest. The largest\n"
    text += "eigenvalue of one step of the closed loop, over the states of all seeds.\n\n"
    experts = dict.fromkeys(row["cell"]["expert"] for row in rows)
    lines = [
        [expert, *_line([row["result"] for row in rows if row["cell"]["expert"] == expert])]
        for expert in experts
    ]
    heads = ["expert", "seeds", "with a factor", "median", "least to largest"]
    heads += ["largest eigenvalue, median", "states"]
    return {"loops.md": (text + table(heads, lines)).encode()}


def _line(results: Sequence[dict[str, Any]]) -> list[str]:
    rates = [one["rate"] for one in results if one["rate"] is not None]
    values = [value for one in results for value in one["eigenvalues"] or ()]
    return [
        str(len(results)),
        str(len(rates)),
        f"{median(rates):.2f}" if rates else "-",
        f"{min(rates):.2f} to {max(rates):.2f}" if rates else "-",
        f"{median(values):.2f}" if values else "-",
        str(len(values)),
    ]


BENCHMARK = Benchmark("loops", __doc__ or "", every_expert, run, draw)
