"""The smallest student that keeps the level, with probes and cloned as long, judged as C."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import fdtasil
from benchmarks.controllers import CONTROLLERS
from benchmarks.distillation import HORIZON
from benchmarks.grid import every_expert
from benchmarks.panels import draw_panels
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.statistics import (
    DIFFERENCES_NOTE,
    SCORES_NOTE,
    Difference,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table
from fdtasil.results.size import c_microseconds, size_of_student
from fdtasil.run.shrinking import OTHER_STARTS

__all__ = ["BENCHMARK"]

EPISODES = 5
KEEP = 0.95
STEPS = 12_000  # of every student: what fresh queries take when they are left to themselves
WIDTHS = (16, 32, 64, 128, 256)
_NAMES = {False: "fresh", True: "plain cloning"}  # by whether it is cloned
_JUDGED = ("confirmed", "c_return")
_WAYS = ("c", "onnx")
_CHOSEN = f"""\
A student is the smallest whose interval over 20 episodes begins above {KEEP}. The starts that
chose it flatter it: it was judged once more, from others, and its C code from these too. All
students were trained for {STEPS:,} steps.
"""


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Record once, train students of every width, and judge the smallest that keeps the level."""
    path, env = CONTROLLERS[cell["expert"]].open()
    recorded = fdtasil.distill(
        path,
        env,
        episodes=EPISODES,
        horizon=HORIZON,
        seed=cell["seed"],
        fit=fdtasil.Fit(steps=1),
        evaluation_episodes=0,
        device=device,
        progress=False,
    )
    sizes = [(width, width) for width in WIDTHS]
    found = fdtasil.shrink(
        recorded,
        path,
        env,
        keep=KEEP,
        sizes=sizes,
        fit=fdtasil.Fit(steps=STEPS),
        progress=False,
    )
    names = ("hidden", "cloned", "bytes", "multiply_adds", "normalized_return", "ci95", "survival")
    students = [{name: getattr(one, name) for name in names} for one in found.candidates]
    result = {"students": students, "expert_bytes": path.stat().st_size}
    if found.result is not None and found.confirmed is not None:
        smallest = _as_c(found.result, path, env, cell["seed"] + OTHER_STARTS)
        result["smallest"] = {"confirmed": found.confirmed.normalized_return, **smallest}
    return result


def _as_c(result: fdtasil.Distilled, path: Path, env: str, seed: int) -> dict[str, Any]:
    """Return how the compiled student does in the loop, and how long one answer takes."""
    with TemporaryDirectory() as folder:
        file = result.export(Path(folder) / "student.c")
        compiled = fdtasil.load_expert(file, trust="c")
        judged = fdtasil.evaluate(compiled, path, env, horizon=HORIZON, seed=seed, progress=False)
        return {
            "hidden": list(result.student.architecture.hidden),  # pyright: ignore
            "c_return": judged.normalized_return,
            "c_ci95": judged.ci95,
            "c_bytes": file.stat().st_size,
            "c_microseconds": c_microseconds(file.read_text(), result.student),
            "onnx_microseconds": size_of_student(result.student).onnx_microseconds,
        }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table of the smallest students, one of all sizes, and a picture of these."""
    experts = list(dict.fromkeys(row["cell"]["expert"] for row in rows))
    found = {
        expert: [row["result"] for row in rows if row["cell"]["expert"] == expert]
        for expert in experts
    }
    found = {expert: results for expert, results in found.items() if len(results) > 1}
    heads = ["expert", "smallest of each seed", "bytes at most", "from other starts"]
    heads += ["its C code from these"]
    heads += ["microseconds as C, in onnxruntime", "smallest cloned"]
    heads += ["fresh 32 x 32 - cloned 256 x 256"]
    cells, counted = difference_column([_headline(results) for results in found.values()])
    lines = [
        [*_smallest(expert, results), gain]
        for (expert, results), gain in zip(found.items(), cells, strict=True)
    ]
    lines.append(["intervals", *[""] * (len(heads) - 2), counted])
    small = f"{SCORES_NOTE}\n{DIFFERENCES_NOTE}\n{_CHOSEN}\n{table(heads, lines)}"
    every = table(["expert", "", *(f"{w} x {w}" for w in WIDTHS)], _every(found))
    curves = {
        expert: {name: dict(enumerate(of.values())) for name, of in _curves(results).items()}
        for expert, results in found.items()
    }
    files = {"small_students.md": f"{small}\n{every}".encode()}
    if curves:
        files["small_students.png"] = draw_panels(
            curves, "width of two hidden layers", ticks=[str(width) for width in WIDTHS]
        )
    return files


def _smallest(expert: str, results: Sequence[Any]) -> list[str]:
    kept = [result.get("smallest") for result in results]
    there = [one for one in kept if one is not None]
    sizes = [_first(result, cloned=False) for result in results]
    most = max((one["bytes"] for one in sizes if one is not None), default=None)
    return [
        expert,
        _widths(sizes),
        "-" if most is None else f"{most:,}",
        *(interval_text([one[name] for one in there]) if there else "-" for name in _JUDGED),
        ", ".join(f"{np.mean([one[f'{way}_microseconds'] for one in there]):.1f}" for way in _WAYS)
        if there
        else "-",
        _widths([_first(result, cloned=True) for result in results]),
    ]


def _headline(results: Sequence[Any]) -> Difference:
    """Return the mean difference of a small student with queries and a large cloned one."""
    curves = _curves(results)
    small, large = curves["fresh"][32], curves["plain cloning"][256]
    return paired_difference(dict(enumerate(small)), dict(enumerate(large)))


def _first(result: Any, *, cloned: bool) -> Any:
    """Return the smallest student of a seed whose interval begins above the level, or None."""
    return next(
        (
            one
            for one in sorted(result["students"], key=lambda one: one["bytes"])
            if one["cloned"] == cloned and one["ci95"] is not None and one["ci95"][0] >= KEEP
        ),
        None,
    )


def _widths(students: Sequence[Any]) -> str:
    return ", ".join("none" if one is None else str(one["hidden"][0]) for one in students)


def _every(found: dict[str, list[Any]]) -> list[list[str]]:
    return [
        [expert, name, *(interval_text(scores) for scores in curve.values())]
        for expert, results in found.items()
        for name, curve in _curves(results).items()
    ]


def _curves(results: Sequence[Any]) -> dict[str, dict[float, list[float]]]:
    return {
        name: {
            width: [
                one["normalized_return"]
                for result in results
                for one in result["students"]
                if one["cloned"] == cloned and one["hidden"][0] == width
            ]
            for width in WIDTHS
        }
        for cloned, name in _NAMES.items()
    }


BENCHMARK = Benchmark("small_students", __doc__ or "", every_expert, run, draw)
