"""A planner with hard limits, which has no answer at some states: probes against cloning."""

from collections.abc import Sequence
from typing import Any

import fdtasil
from benchmarks.controllers import planner
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.statistics import SCORES_NOTE, interval_text
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

EPISODES = (1, 3)
HORIZON = 100
METHODS = {"plain": 0, "10 probes": "10,forward"}


def cells(quick: bool) -> list[Cell]:
    """Every number of episodes, seed and method."""
    return [
        {"episodes": episodes, "method": method, "seed": seed}
        for episodes in (EPISODES[:1] if quick else EPISODES)
        for seed in (SEEDS[:2] if quick else SEEDS)
        for method in METHODS
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil the planner."""
    example = planner()
    result = fdtasil.distill(
        example.controller,
        example.CartPole,
        METHODS[cell["method"]],
        episodes=cell["episodes"],
        horizon=HORIZON,
        seed=cell["seed"],
        constraints=example.LIMITS,
        device=device,
        progress=False,
    )
    evaluation, queries = result.evaluation, result.queries
    assert evaluation is not None
    ((_, theirs, ours),) = evaluation.violations
    return {
        "normalized_return": evaluation.normalized_return,
        "student_return": evaluation.student_return,
        "expert_return": evaluation.expert_return,
        "action_error": evaluation.action_error,
        "violations": ours,
        "expert_violations": theirs,
        "no_answer": result.report["no_answer"],
        "queries": {name: rows for name, rows in queries.items() if name != "evaluate"},
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: episodes and methods down."""
    heads = ["episodes", "method", "queries", "return / expert's", "force error, N"]
    heads += ["violations, student and expert", "probes without an answer"]
    lines = [
        line
        for episodes in EPISODES
        for method in METHODS
        for line in _line(rows, episodes, method)
    ]
    return {"constrained_mpc.md": f"{SCORES_NOTE}\n{table(heads, lines)}".encode()}


def _line(rows: Sequence[Row], episodes: int, method: str) -> list[list[str]]:
    found = [
        row["result"]
        for row in rows
        if (row["cell"]["episodes"], row["cell"]["method"]) == (episodes, method)
    ]
    if len(found) < 2:
        return []

    def mean(values: Sequence[float]) -> float:
        return sum(values) / len(values)

    def text(name: str) -> str:
        return interval_text([one[name] for one in found])

    broken = (mean([one[name] for one in found]) for name in ("violations", "expert_violations"))
    silent = mean([one["no_answer"].get("probe", 0.0) for one in found])
    asked = mean([sum(one["queries"].values()) for one in found])
    head = [str(episodes), method, f"{asked:,.0f}", text("normalized_return")]
    return [[*head, text("action_error"), ", ".join(f"{b:.2%}" for b in broken), f"{silent:.2%}"]]


BENCHMARK = Benchmark("constrained_mpc", __doc__ or "", cells, run, draw)
