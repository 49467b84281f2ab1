"""Do errors of derivatives tell a good student from a bad one: good, half-trained and cloned."""

from collections.abc import Sequence
from typing import Any

from scipy.stats import spearmanr

import fdtasil
from benchmarks.controllers import CONTROLLERS, available
from benchmarks.distillation import HORIZON
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

STUDENTS: dict[str, dict[str, Any]] = {
    "good": {"probes": "fresh"},
    "half-trained": {"probes": "fresh", "fit": fdtasil.Fit(steps=400)},
    "cloned": {"probes": 0},
}
ERRORS = ("derivatives", "actions")


def cells(quick: bool) -> list[Cell]:
    """Every expert, student and seed."""
    return [
        {"expert": expert, "student": student, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
        for expert in (available("HalfCheetah-v5") if quick else available())
        for student in STUDENTS
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil from one trajectory, judge the student's return, and its derivatives apart."""
    path, env = CONTROLLERS[cell["expert"]].open()
    call = {"episodes": 1, "horizon": HORIZON, "seed": cell["seed"], "progress": False}
    result = fdtasil.distill(path, env, **STUDENTS[cell["student"]], **call, device=device)
    assert result.evaluation is not None
    found = fdtasil.diagnose(
        result.student, path, env, horizon=HORIZON, seed=cell["seed"], progress=False
    )
    return {
        "normalized_return": result.evaluation.normalized_return,
        "derivatives": found.fidelity.error,
        "actions": found.fidelity.action_error,
        "bound": found.bound,
        "gap": found.gap,
        "order": found.stability.order,
        "errors": None if found.errors is None else vars(found.errors),
        "conditions": [
            {"source": one.source, "asked": one.asked, "met": one.met} for one in found.conditions
        ],
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """A line for each expert: return and errors of its students, how their ranks agree, bounds."""
    experts = list(dict.fromkeys(row["cell"]["expert"] for row in rows))
    heads = ["expert", *(f"{name}: return, derivatives, actions" for name in STUDENTS)]
    heads += [f"rank correlation of return and {name}" for name in ERRORS]
    heads += ["distance to the expert's path after 25 steps: bounded, measured"]
    heads += ["derivative of the difference: measured, allowed by the corollary"]
    lines = [_line(e, [row for row in rows if row["cell"]["expert"] == e]) for e in experts]
    if len(experts) > 1:
        lines.append(["all", *[""] * len(STUDENTS), *_agreements(rows), "", ""])
    return {"fidelity.md": table(heads, lines).encode()}


def _line(expert: str, rows: Sequence[Row]) -> list[str]:
    cells = []
    for student in STUDENTS:
        found = [row["result"] for row in rows if row["cell"]["student"] == student]
        names = ("normalized_return", *ERRORS) if found else ()
        means = (sum(one[name] for one in found) / len(found) for name in names)
        cells.append(", ".join(f"{mean:.2f}" for mean in means) or "-")
    return [expert, *cells, *_agreements(rows), _distances(rows), _derivatives(rows)]


def _distances(rows: Sequence[Row]) -> str:
    """Return the bound and the measured distance of the good students, in deviations."""
    good = [row["result"] for row in rows if row["cell"]["student"] == "good"]
    bounds = [one["bound"] for one in good if one["bound"] is not None]
    if not good:
        return "-"
    bound = f"{sum(bounds) / len(bounds):.3g}" if bounds else "no law"
    return f"{bound}, {sum(one['gap'] for one in good) / len(good):.2g}"


def _derivatives(rows: Sequence[Row]) -> str:
    """Return |dDelta| of the good students, and what the corollary for r = 1 allows."""
    found = [
        (measured, allowed)
        for row in rows
        if row["cell"]["student"] == "good"
        for one in row["result"].get("conditions", ())
        if one["source"].startswith("corollary")
        for name, measured, allowed in one["asked"]
        if name == "|dDelta|"
    ]
    if not found:
        return "-"
    measured, allowed = (sum(values) / len(values) for values in zip(*found, strict=True))
    return f"{measured:.3g}, {allowed:.2g}"


def _agreements(rows: Sequence[Row]) -> list[str]:
    """Return Spearman's correlation of return and each error: -1 where they agree in full."""
    returns = [row["result"]["normalized_return"] for row in rows]
    return [
        f"{spearmanr(returns, [row['result'][name] for row in rows]).statistic:.2f}"
        if len(rows) > 2
        else "-"
        for name in ERRORS
    ]


BENCHMARK = Benchmark("fidelity", __doc__ or "", cells, run, draw)
