"""The cell that most benchmarks share: distil one expert with one setting and seed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS
from benchmarks.runner import Benchmark, Cell, Row
from fdtasil.run.presets import preset_of

__all__ = [
    "HORIZON",
    "STEPS",
    "call_of",
    "distil",
    "distillations",
    "recorded",
    "usual_arguments",
]

HORIZON = 300
STEPS = 4_000  # however much data there is; a method that has others says so


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
            that are not left at their defaults, as `call_of` takes them.
        draw: Rows -> files.
    """

    def run(cell: Cell, device: str) -> dict[str, Any]:
        return distil(**arguments(cell), device=device)

    return Benchmark(name, about, cells, run, draw, arguments=arguments)


def usual_arguments(cell: Cell, method: Mapping[str, Any]) -> dict[str, Any]:
    """Return a cell's expert, trajectories and seed, at the usual horizon and steps.

    Args:
        cell: With these three names.
        method: Further arguments, or others; None leaves one at the library's default.
    """
    given = {name: cell[name] for name in ("expert", "episodes", "seed")}
    settings = {**given, "horizon": HORIZON, "steps": STEPS, **method}
    return {name: value for name, value in settings.items() if value is not None}


def call_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `distill` that flat settings stand for.

    Stored results are found by their settings: flat, they stay what they are when the library
    groups its arguments anew.

    Args:
        settings: Arguments of `distill`, the fields of `Fit` and `Mlp` beside them; `Fit`'s that
            are left out are the preset's.
    """
    rest = dict(settings)
    of_fit, of_student = (
        {field.name: rest.pop(field.name) for field in fields(kind) if field.name in rest}
        for kind in (fdtasil.Fit, fdtasil.Mlp)
    )
    preset = preset_of(rest.get("preset", "standard"))
    student = fdtasil.Mlp(**of_student) if of_student else None
    return {**rest, "student": student, "fit": preset.fit_with(**of_fit)}


def recorded(expert: str, *, episodes: int, seed: int, horizon: int = HORIZON) -> fdtasil.Dataset:
    """Return the demonstrations that `distil` learns from with the same arguments."""
    return fdtasil.distill(
        *CONTROLLERS[expert].open(),
        0,
        episodes=episodes,
        horizon=horizon,
        seed=seed,
        evaluation_episodes=0,
        fit=fdtasil.Fit(steps=1),
        progress=False,
    ).dataset


def distil(expert: str, **settings: Any) -> dict[str, Any]:
    """Distil, and return what tables and figures need of the report."""
    path, environment = CONTROLLERS[expert].open()
    result = fdtasil.distill(path, environment, progress=False, **call_of(settings))
    report, evaluation = result.report, result.evaluation
    assert evaluation is not None
    names = ("train_seconds", "steps", "queries", "radius", "probes", "warnings")
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
