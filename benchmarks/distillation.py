"""The cell that most benchmarks share: distil one expert with one setting and seed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS
from benchmarks.runner import Benchmark, Cell, Row

__all__ = ["HORIZON", "STEPS", "distillations", "usual_arguments"]

HORIZON = 300
STEPS = 4_000  # of all, however much data they have: none is trained longer than another


def distillations(
    name: str,
    about: str,
    cells: Callable[[bool], Sequence[Cell]],
    arguments: Callable[[Cell], dict[str, Any]],
    draw: Callable[[Sequence[Row]], Mapping[str, bytes]],
) -> Benchmark:
    """Return a benchmark each cell of which is one distillation; see `Benchmark`.

    Args:
        name: Of the results file and the command.
        about: What it shows.
        cells: Whether to be quick -> the cells.
        arguments: A cell -> `expert`, a name of `CONTROLLERS`, and those arguments of `distill`
            that are not left at their defaults.
        draw: Rows -> files.
    """

    def run(cell: Cell, device: str) -> dict[str, Any]:
        return _distil(**arguments(cell), device=device)

    return Benchmark(name, about, cells, run, draw, arguments=arguments)


def usual_arguments(cell: Cell) -> dict[str, Any]:
    """Return a cell's expert, trajectories and seed, at a horizon and steps that all share."""
    given = {name: cell[name] for name in ("expert", "episodes", "seed")}
    return given | {"horizon": HORIZON, "steps": STEPS}


def _distil(expert: str, **arguments: Any) -> dict[str, Any]:
    """Distil, and return what tables and figures need of the report."""
    path, environment = CONTROLLERS[expert].open()
    result = fdtasil.distill(path, environment, progress=False, **arguments)
    report, evaluation = result.report, result.evaluation
    assert evaluation is not None
    names = ("train_seconds", "steps", "queries", "radius", "weight", "probes", "warnings")
    return {
        "normalized_return": evaluation.normalized_return,
        "student_return": evaluation.student_return,
        "expert_return": evaluation.expert_return,
        "survival": evaluation.survival,
        "expert_survival": evaluation.expert_survival,
        "action_error": evaluation.action_error,
        "imitation_gap": evaluation.imitation_gap,
        **{name: report[name] for name in names if name in report},
    }
