"""Eight bits in the loop: a student, and the files that have its weights in eight bits."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fdtasil
from benchmarks.controllers import CONTROLLERS, available
from benchmarks.distillation import HORIZON
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.scores import Column, scores_text

__all__ = ["BENCHMARK"]

TRAJECTORIES = {"HalfCheetah-v5": 1, "Walker2d-v5": 5, "Swimmer-v5": 1}
WIDTHS = (64, 256)
FILES = ("student.int8.onnx", "student.int8.c")
FLOAT = "float32"


def cells(quick: bool) -> list[Cell]:
    """Every seed, width and expert."""
    return [
        {"expert": expert, "width": width, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
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
    """Return how a policy does over 20 whole episodes, of the same starts for each of them."""
    path, env = CONTROLLERS[cell["expert"]].open()
    judged = fdtasil.evaluate(policy, path, env, seed=cell["seed"], progress=False)
    names = ("normalized_return", "ci95", "survival", "expert_survival")
    return {name: getattr(judged, name) for name in names}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """Returns by expert, width and file, what eight bits cost, and what was refused."""
    scores: dict[tuple[str, Column], dict[str, dict[int, float]]] = {}
    refused: Counter[str] = Counter()
    for row in rows:
        expert, width, seed = (row["cell"][name] for name in ("expert", "width", "seed"))
        for name, judged in row["result"].items():
            if "refused" in judged:
                refused[f"{expert}'s {width} x {width} as {name}"] += 1
            else:
                group = scores.setdefault((expert, width), {})
                group.setdefault(name, {})[seed] = judged["normalized_return"]
    several = {  # a single seed has no difference with an interval
        key: {name: of for name, of in group.items() if len(of) > 1}
        for key, group in sorted(scores.items())
    }
    pairs = [(name, FLOAT) for name in FILES]
    text = scores_text(several, (FLOAT, *FILES), pairs, "width of two layers")
    said = (f"\nRefused, for actions change too much: {n} of {of}.\n" for of, n in refused.items())
    return {"eight_bits.md": "".join([text, *said]).encode()}


BENCHMARK = Benchmark("eight_bits", __doc__ or "", cells, run, draw)
