"""Do errors of derivatives tell a good student from a bad one: good, half-trained and cloned."""

from collections.abc import Mapping, Sequence
from statistics import mean, median
from typing import Any

import numpy as np
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
_WELL, _ILL = 0.95, 0.5  # returns of students that do as their experts, and that fail


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
        "disturbed": found.disturbed,
        "by_law": found.by_law,
        "law": None if found.stability.law is None else vars(found.stability.law),
        "largest_error": found.largest_error,
        "gap": found.gap,
        "ended": found.ended,
        "errors": None if found.errors is None else vars(found.errors),
        "conditions": [
            {"source": one.source, "asked": one.asked, "met": one.met} for one in found.conditions
        ],
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """Returns and errors by expert and student, how their ranks agree, and what the laws say."""
    experts = list(dict.fromkeys(row["cell"]["expert"] for row in rows))
    heads = ["expert", "runs", *(f"{name}: return, derivatives, actions" for name in STUDENTS)]
    heads += [f"rank correlation of return and {name}" for name in ERRORS]
    lines = [_errors(e, [row for row in rows if row["cell"]["expert"] == e]) for e in experts]
    lines.append(["all", str(len(rows)), *[""] * len(STUDENTS), *_agreements(rows)])
    for name in STUDENTS:
        mine = [row for row in rows if row["cell"]["student"] == name]
        lines.append([f"all, {name}", str(len(mine)), *[""] * len(STUDENTS), *_agreements(mine)])
    text = f"Means over seeds; errors are shares of the expert's own.\n\n{table(heads, lines)}\n"
    text += f"{_range_text(rows)}\n"
    text += "The good students, medians over seeds; distances are the largest within 25 steps of\n"
    text += "ten episodes, in deviations.\n\n"
    heads = ["expert", "seeds with a law", "it was measured up to", "largest error"]
    heads += ["distance", "disturbances as large led to", "by the law"]
    heads += ["derivative of the difference"]
    heads += ["allowed by the corollary"]
    good = [row for row in rows if row["cell"]["student"] == "good"]
    lines = [
        _laws(e, [row["result"] for row in good if row["cell"]["expert"] == e]) for e in experts
    ]
    return {"fidelity.md": (text + table(heads, [line for line in lines if line])).encode()}


def _range_text(rows: Sequence[Row]) -> str:
    """Return what the errors were of students that do as well as their experts, and that fail."""
    returns = [row["result"]["normalized_return"] for row in rows]
    errors = [row["result"]["derivatives"] for row in rows]
    well = sorted(error for error, score in zip(errors, returns, strict=True) if score >= _WELL)
    ill = sorted(error for error, score in zip(errors, returns, strict=True) if score < _ILL)
    parts = []
    for name, found in ((f"above {_WELL}", well), (f"below {_ILL}", ill)):
        low, high = np.quantile(found, [0.1, 0.9]) if found else (np.nan, np.nan)
        parts.append(f"of {len(found)} students {name}, 80 % have {low:.0%} to {high:.0%}")
    return f"Errors of derivatives by return: {'; '.join(parts)}.\n"


def _errors(expert: str, rows: Sequence[Row]) -> list[str]:
    line = []
    for student in STUDENTS:
        found = [row["result"] for row in rows if row["cell"]["student"] == student]
        names = ("normalized_return", *ERRORS) if found else ()
        line.append(", ".join(f"{mean(one[name] for one in found):.2f}" for name in names) or "-")
    return [expert, str(len(rows)), *line, *_agreements(rows)]


def _agreements(rows: Sequence[Row]) -> list[str]:
    """Return Spearman's correlation of return and each error: -1 where they agree in full."""
    returns = [row["result"]["normalized_return"] for row in rows]
    return [
        f"{spearmanr(returns, [row['result'][name] for row in rows]).statistic:.2f}"
        if len(rows) > 2
        else "-"
        for name in ERRORS
    ]


def _laws(expert: str, results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the line of an expert's good students; empty without one."""
    if not results:
        return []
    lawful = [one for one in results if one["law"] is not None]
    allowed = [
        (here, most)
        for one in lawful
        for condition in one["conditions"]
        if condition["source"].startswith("corollary")
        for name, here, most in condition["asked"]
        if name == "|dDelta|"
    ]
    values = (
        [one["law"]["reach"][1] for one in lawful],
        [one["largest_error"] for one in results],
        [one["gap"] for one in results],
        [one["disturbed"] for one in results if one["disturbed"] is not None],
        [one["by_law"] for one in lawful],
        [here for here, _ in allowed],
        [most for _, most in allowed],
    )
    medians = (f"{median(found):.2g}" if found else "-" for found in values)
    return [expert, f"{len(lawful)} of {len(results)}", *medians]


BENCHMARK = Benchmark("fidelity", __doc__ or "", cells, run, draw)
