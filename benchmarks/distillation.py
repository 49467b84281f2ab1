"""The cell that most benchmarks share: distil one expert with one setting and seed."""

from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS
from benchmarks.runner import Cell

__all__ = ["distil_cell"]


def distil_cell(cell: Cell) -> dict[str, Any]:
    """Distil, and return what tables and figures need of the report.

    Args:
        cell: `expert`, a name of `CONTROLLERS`; the rest are arguments of `distill`.
    """
    arguments = dict(cell)
    path, environment = CONTROLLERS[arguments.pop("expert")].open()
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
