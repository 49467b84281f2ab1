"""What happens to a student where the machine is not the simulator: noise, pushes, mass, grip."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np

import fdtasil
from benchmarks.comparison import Column, Scores, differences_table, draw_panels, scores_table
from benchmarks.controllers import CONTROLLERS
from benchmarks.disturbances import DISTURBANCES, Disturbance
from benchmarks.finite_difference import METHODS, experts
from benchmarks.runner import Benchmark, Cell, Row

__all__ = ["ROBUSTNESS"]

SEEDS = range(5)
EPISODES, HORIZON = 5, 300
STUDENTS = ("plain", "10", "augmentation")
PAIRS = (("10", "plain"), ("10", "augmentation"), ("10", "expert"))
LABELS = {
    "expert": "expert",
    "plain": "plain cloning",
    "10": "10 probes",
    "augmentation": "10 answers as labels",
}


def cells(quick: bool) -> list[Cell]:
    """Every seed, expert and student."""
    return [
        {"expert": expert, "method": method, "seed": seed}
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
        for method in STUDENTS
    ]


def run(cell: Cell) -> dict[str, Any]:
    """Distil in the usual environment, and compare with the expert in every disturbed one."""
    path, environment = CONTROLLERS[cell["expert"]].open()
    result = fdtasil.distill(
        path,
        environment,
        episodes=EPISODES,
        horizon=HORIZON,
        seed=cell["seed"],
        evaluation_episodes=1,  # judged below
        progress=False,
        **METHODS["standard"][cell["method"]],
    )
    deviations = result.dataset.demonstrations.observations.std(axis=0, dtype=np.float64)
    found = {}
    for name, disturbance in DISTURBANCES.items():
        make = partial(_make, disturbance, environment, deviations)
        evaluation = fdtasil.evaluate(
            result.student, path, make, horizon=HORIZON, seed=cell["seed"], progress=False
        )
        keys = ("expert_return", "student_return", "expert_survival", "survival")
        found[name] = {key: getattr(evaluation, key) for key in keys}
    return found


def _make(disturbance: Disturbance, environment: str, deviations: np.ndarray) -> gymnasium.Env:
    return disturbance.wrap(gymnasium.make(environment), deviations)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables, of the experts that are complete."""
    scores = _scores(rows)
    if not scores:
        return {}
    methods = list(LABELS)
    text = (
        f"Share of the undisturbed expert's return, {EPISODES} trajectories of {HORIZON} steps, "
        f"{len(SEEDS)} seeds:\n\n{scores_table(scores, methods, 'disturbance')}\n"
        f"Differences on equal seeds:\n\n{differences_table(scores, PAIRS, 'disturbance')}"
    )
    picture = draw_panels(scores, methods, LABELS.__getitem__, across="")
    return {"robustness.png": picture, "robustness.md": text.encode()}


def _scores(rows: Sequence[Row]) -> Scores:
    """Return the shares of the undisturbed expert's return; of experts with every cell."""
    by_cell = {
        (row["cell"]["expert"], row["cell"]["method"], row["cell"]["seed"]): row["result"]
        for row in rows
    }
    scores: dict[tuple[str, Column], dict[str, dict[int, float]]] = {}
    for expert in dict.fromkeys(row["cell"]["expert"] for row in rows):
        if any((expert, m, seed) not in by_cell for m in STUDENTS for seed in SEEDS):
            continue
        for name, disturbance in DISTURBANCES.items():
            group: dict[str, dict[int, float]] = {method: {} for method in LABELS}
            for seed in SEEDS:
                for method in STUDENTS:
                    result = by_cell[expert, method, seed]
                    whole = result["none"]["expert_return"]
                    group[method][seed] = result[name]["student_return"] / whole
                    # The same in every student's cell: equal seeds, equal disturbances.
                    group["expert"][seed] = result[name]["expert_return"] / whole
            scores[expert, disturbance.label] = group
    return scores


ROBUSTNESS = Benchmark("robustness", __doc__ or "", cells, run, draw)
