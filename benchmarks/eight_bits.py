"""Eight bits in the loop: a student, and the files that have its weights in eight bits."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS, available
from benchmarks.distillation import HORIZON
from benchmarks.grid import SEEDS
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

__all__ = ["BENCHMARK"]

TRAJECTORIES = {"HalfCheetah-v5": 1, "Walker2d-v5": 5, "Swimmer-v5": 1}
WIDTHS = (64, 256)
FILES = ("student.int8.onnx", "student.int8.c")
FLOAT = "float32"


def cells(quick: bool) -> list[Cell]:
    """Every seed, width and expert."""
    return [
        {"expert": expert, "width": width, "seed": seed}
        for seed in (SEEDS[:1] if quick else SEEDS)
        for width in (WIDTHS[:1] if quick else WIDTHS)
        for expert in available(*list(TRAJECTORIES)[: 1 if quick else None])
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil a student of two ReLU layers, and judge it and its files over whole episodes."""
    path, env = CONTROLLERS[cell["expert"]].open()
    result = fdtasil.distill(
        path,
        env,
        episodes=TRAJECTORIES[cell["expert"]],
        horizon=HORIZON,
        seed=cell["seed"],
        student=fdtasil.Mlp((cell["width"],) * 2, "relu"),
        evaluation_episodes=0,
        device=device,
        progress=False,
    )
    found = {FLOAT: _judged(result.student, cell)}
    with TemporaryDirectory() as folder:
        for name in FILES:
            try:
                file = result.export(Path(folder) / name)
            except fdtasil.ExportError as refusal:
                found[name] = {"refused": str(refusal)}
                continue
            found[name] = _judged(fdtasil.load_expert(file, trust="c"), cell)
    return found


def _judged(policy: Any, cell: Cell) -> dict[str, Any]:
    """Return its return over 20 episodes of a thousand steps, from the starts of all of them."""
    path, env = CONTROLLERS[cell["expert"]].open()
    judged = fdtasil.evaluate(policy, path, env, seed=cell["seed"], progress=False)
    names = ("normalized_return", "ci95", "survival", "expert_survival")
    return {name: getattr(judged, name) for name in names}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: returns by expert, width and file, and what eight bits cost."""
    found: dict[tuple[str, int], dict[str, dict[int, float]]] = {}
    refused: dict[tuple[str, int], int] = {}
    for row in rows:
        cell = row["cell"]
        key = cell["expert"], cell["width"]
        for name, judged in row["result"].items():
            scores = found.setdefault(key, {}).setdefault(name, {})
            if "refused" in judged:
                refused[key] = refused.get(key, 0) + 1
            else:
                scores[cell["seed"]] = judged["normalized_return"]
    lines, differences = [], []
    for (expert, width), scores in sorted(found.items()):
        given = [list(scores.get(name, {}).values()) for name in (FLOAT, *FILES)]
        shown = [interval_text(values) if values else "refused" for values in given]
        lines.append([expert, f"{width} x {width}", *shown])
        differences += [_difference(scores.get(name, {}), scores[FLOAT]) for name in FILES]
    told, counted = difference_column(differences)
    lines = [
        [*line, *told[len(FILES) * number : len(FILES) * (number + 1)]]
        for number, line in enumerate(lines)
    ]
    heads = ["expert", "student", FLOAT, *FILES, *(f"{name} - {FLOAT}" for name in FILES)]
    lines.append(["intervals", *[""] * (len(heads) - 2), counted])
    said = "\n".join(
        f"Refused, for actions changed too much: {count} of {expert}'s {width} x {width}."
        for (expert, width), count in sorted(refused.items())
    )
    text = f"{SCORES_NOTE}\n{DIFFERENCES_NOTE}\n{table(heads, lines)}" + (said and f"\n{said}\n")
    return {"eight_bits.md": text.encode()}


def _difference(ours: dict[int, float], theirs: dict[int, float]) -> Difference | None:
    return paired_difference(ours, theirs) if len(ours) > 1 else None


BENCHMARK = Benchmark("eight_bits", __doc__ or "", cells, run, draw)
