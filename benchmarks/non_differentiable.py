"""Experts that have no useful derivative: do probes teach what plain cloning misses."""

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fdtasil
from benchmarks.black_boxes import BLACK_BOXES
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.statistics import SCORES_NOTE, interval_text
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

PROBES = (10, 0)
# Rows that a slow expert may be asked in all; a setting that would ask more is refused at once.
SLOW_BUDGET = 20_000


def cells(quick: bool) -> list[Cell]:
    """Every kind and seed, with and without probes; nothing else is set by hand."""
    kinds = ["float16", "bang_bang"] if quick else list(BLACK_BOXES)
    return [
        {"black_box": kind, "probes": probes, "seed": seed}
        for seed in (range(2) if quick else SEEDS)
        for kind in kinds
        for probes in PROBES
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Make the expert anew, distil it, and return what the table needs."""
    arguments = dict(cell)
    box = BLACK_BOXES[arguments.pop("black_box")]
    with TemporaryDirectory() as folder, box.open(Path(folder)) as expert:
        started = time.perf_counter()
        result = fdtasil.distill(
            expert,
            box.environment,
            episodes=box.demonstrations,
            horizon=box.horizon,
            max_queries=SLOW_BUDGET if box.slow else None,
            device=device,
            progress=False,
            **arguments,
        )
        seconds = time.perf_counter() - started
    evaluation, report = result.evaluation, result.report
    assert evaluation is not None
    scores = ("normalized_return", "expert_return", "student_return", "survival", "action_error")
    names = ("train_seconds", "steps", "queries", "probes", "radius", "warnings")
    return {
        **{name: getattr(evaluation, name) for name in scores},
        **{name: report[name] for name in names if name in report},
        "regime": report["calibration"] and report["calibration"]["regime"],
        "seconds": round(seconds, 1),
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: kinds down, plain cloning and probes across."""
    heads = ["expert", "environment", "expert's return", "plain cloning", "10 probes"]
    heads += ["worst seed", "queries to learn from", "seconds, plain and with probes", "probes"]
    lines: list[list[str]] = []
    for kind in BLACK_BOXES:
        mine = [row for row in rows if row["cell"]["black_box"] == kind]
        lines += _line(kind, *(_results(mine, probes) for probes in PROBES))
    return {"non_differentiable.md": f"{SCORES_NOTE}\n{table(heads, lines)}".encode()}


def _results(rows: Sequence[Row], probes: int) -> list[dict[str, Any]]:
    return [row["result"] for row in rows if row["cell"]["probes"] == probes]


def _line(kind: str, ours: list[dict[str, Any]], plain: list[dict[str, Any]]) -> list[list[str]]:
    """Return the line of a kind, or none where a side of it is not there yet."""
    if not ours or not plain:
        return []
    scores, base = ([r["normalized_return"] for r in results] for results in (ours, plain))
    # The comparison's own queries are left out: a user who does not compare does not make them.
    asked = _mean([sum(r["queries"].values()) - r["queries"]["evaluate"] for r in ours])
    seconds = [_mean([r["seconds"] for r in results]) for results in (plain, ours)]
    sources = ", ".join(dict.fromkeys(r["probes"] for r in ours))
    best = _mean([r["expert_return"] for r in ours])
    cells = [kind, BLACK_BOXES[kind].environment, f"{best:.4g}"]
    cells += [interval_text(base), interval_text(scores), f"{min(scores):.2f}"]
    return [[*cells, f"{asked:,.0f}", f"{seconds[0]:.0f}, {seconds[1]:.0f}", sources]]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


BENCHMARK = Benchmark("non_differentiable", __doc__ or "", cells, run, draw)
