"""What happens to a student where the machine is not the simulator: noise, pushes, mass, grip."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np

import fdtasil
from benchmarks.comparison import draw_scores
from benchmarks.controllers import CONTROLLERS
from benchmarks.distillation import HORIZON, call_of
from benchmarks.disturbances import DISTURBANCES, STEPS_BETWEEN_PUSHES, Disturbance
from benchmarks.grid import SEEDS, STANDARD_METHODS, experts, label
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.scores import Column, Scores, scores_text

__all__ = ["BENCHMARK", "compare_under_disturbances", "shares_under"]

EPISODES = 5
EVALUATED = 10  # episodes under each disturbance
STUDENTS = ("plain", "10", "augmentation", "fresh")
COLUMNS = ("expert", *STUDENTS)
PAIRS = (
    ("10", "plain"),
    ("10", "augmentation"),
    ("10", "expert"),
    ("fresh", "10"),
    ("fresh", "expert"),
)
KEPT = (
    "expert_return",
    "student_return",
    "expert_survival",
    "survival",
    "expert_physics_resets",
    "physics_resets",
)
HEAD = f"""\
Shares of the undisturbed expert's return, {EPISODES} trajectories of {HORIZON} steps,
{len(SEEDS)} seeds, {EVALUATED} episodes under each disturbance. Noise is in standard deviations of
the demonstrations' observations; a push comes every {STEPS_BETWEEN_PUSHES} steps and gives the
whole body the speed; mass takes inertia along. Humanoid observes its masses, so that they disturb
its input too.
"""


def cells(quick: bool) -> list[Cell]:
    """Every expert, seed and student: an expert is drawn when all of its cells are there."""
    return [
        {"expert": expert, "method": method, "seed": seed}
        for expert in (experts()[:1] if quick else experts())
        for seed in (range(2) if quick else SEEDS)
        for method in STUDENTS
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil in the usual environment, and compare with the expert in every disturbed one."""
    settings = {**STANDARD_METHODS[cell["method"]], "device": device}
    return compare_under_disturbances(cell["expert"], cell["seed"], settings)


def compare_under_disturbances(
    expert: str, seed: int, settings: Mapping[str, Any], disturbed: Iterable[str] = DISTURBANCES
) -> dict[str, Any]:
    """Distil once, and return what student and expert reach under each disturbance.

    Args:
        expert: A name of `CONTROLLERS`.
        seed: Of the distillation, the starts and the disturbances.
        settings: Further arguments of `distill`, as `call_of` takes them.
        disturbed: Names of the disturbances.
    """
    path, environment = CONTROLLERS[expert].open()
    result = fdtasil.distill(
        path,
        environment,
        episodes=EPISODES,
        horizon=HORIZON,
        seed=seed,
        evaluation_episodes=0,  # judged below
        progress=False,
        **call_of(settings),
    )
    deviations = result.dataset.demonstrations.observations.std(axis=0, dtype=np.float64)
    found: dict[str, Any] = {}
    for name in disturbed:
        make = partial(_make, DISTURBANCES[name], environment, deviations)
        try:
            evaluation = fdtasil.evaluate(
                result.student,
                path,
                make,
                episodes=EVALUATED,
                horizon=HORIZON,
                seed=seed,
                progress=False,
            )
        except fdtasil.FdtasilError as error:  # an expert that this disturbance makes useless
            found[name] = {"refused": str(error)}
        else:
            found[name] = {key: getattr(evaluation, key) for key in KEPT}
    return found


def _make(disturbance: Disturbance, environment: str, deviations: np.ndarray) -> gymnasium.Env:
    return disturbance(gymnasium.make(environment), deviations)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables, of the experts that are complete."""
    scores = _scores(rows)
    if not scores:
        return {}
    missing = [
        f"{expert} under {name}"
        for expert in dict.fromkeys(expert for expert, _ in scores)
        for name in DISTURBANCES
        if (expert, name) not in scores
    ]
    text = (
        f"{HEAD}\n{scores_text(scores, COLUMNS, PAIRS, 'disturbance')}\n"
        "Left out, for the expert could not be followed or the simulator reset itself: "
        f"{', '.join(missing) or 'nothing'}.\n"
    )
    picture = draw_scores(
        scores,
        COLUMNS,
        label,
        across="",
        score="share of the undisturbed return",
    )
    return {"robustness.png": picture, "robustness.md": text.encode()}


def _scores(rows: Sequence[Row]) -> Scores:
    """Return the shares of the undisturbed expert's return; of experts with every cell.

    A disturbance that was refused, or that made the simulator reset itself, has no share.
    """
    results = {
        (row["cell"]["expert"], row["cell"]["method"], row["cell"]["seed"]): row["result"]
        for row in rows
    }
    scores: dict[tuple[str, Column], dict[str, dict[int, float]]] = {}
    for expert in dict.fromkeys(row["cell"]["expert"] for row in rows):
        keys = [(expert, method, seed) for method in STUDENTS for seed in SEEDS]
        if not all(key in results for key in keys):
            continue
        for name in DISTURBANCES:
            if all(_counts(results[key][name]) for key in keys):
                scores[expert, name] = shares_under(rows, expert, name, STUDENTS)
    return scores


def _counts(result: Mapping[str, Any]) -> bool:
    return "refused" not in result and not (
        result["expert_physics_resets"] or result["physics_resets"]
    )


def shares_under(
    rows: Sequence[Row], expert: str, disturbance: str, methods: Sequence[str]
) -> dict[str, dict[int, float]]:
    """Return column -> seed -> share of the undisturbed expert's return."""
    shares: dict[str, dict[int, float]] = {column: {} for column in ("expert", *methods)}
    for row in sorted(rows, key=lambda row: row["cell"]["seed"]):
        cell, result, seed = row["cell"], row["result"], row["cell"]["seed"]
        if cell["expert"] != expert:
            continue
        whole, found = result["none"]["expert_return"], result[disturbance]
        shares[cell["method"]][seed] = found["student_return"] / whole
        theirs = found["expert_return"] / whole
        # Equal seeds, equal disturbances: every student's cell has the same expert.
        if abs(shares["expert"].setdefault(seed, theirs) - theirs) > 1e-9:
            raise ValueError(f"{expert}, {disturbance}, seed {seed}: the expert differs")
    return shares


BENCHMARK = Benchmark("robustness", __doc__ or "", cells, run, draw)
