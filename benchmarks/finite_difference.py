"""The paper's finite-difference appendix: how many probes stand in for the Jacobian."""

from collections.abc import Sequence
from typing import Any

from benchmarks.comparison import draw_scores
from benchmarks.distillation import distillations, usual_arguments
from benchmarks.grid import SEEDS, STANDARD_METHODS, experts, label
from benchmarks.runner import Cell, Row
from benchmarks.scores import scores_of, scores_text

__all__ = ["BENCHMARK"]

PRESETS: dict[str, dict[str, Any]] = {
    # What a user gets who sets nothing; beyond five trajectories, who sets the steps alone.
    "standard": {},
    # The paper's sphere, radius, weight and optimiser, at the training cost of the other preset:
    # 4,500 epochs with every probe in every step would take weeks on two cores.
    "paper": {"preset": "paper"},
}
# Presets and numbers of trajectories, the most telling first: what a cut sweep has is complete.
GRID = (
    ("standard", 5),
    ("paper", 5),
    ("standard", 2),
    ("standard", 20),
    ("standard", 1),
    ("paper", 20),
    ("standard", 10),
    ("standard", 50),
)
METHODS: dict[str, dict[str, dict[str, Any]]] = {
    "standard": STANDARD_METHODS,
    "paper": {
        "plain": {"probes": 0},
        "jacobian": {"probes": "jacobian,per_step=1"},
        **{str(count): {"probes": f"sphere:{count},per_step=1"} for count in (1, 5, 10, 50)},
        "augmentation": {"probes": "sphere:10,labels,per_step=1", "weight": 1.0},
    },
}
# The appendix's claims, and the baseline: ours - theirs on equal seeds.
PAIRS = (("1", "jacobian"), ("10", "jacobian"), ("10", "1"), ("50", "1"), ("10", "augmentation"))
# What these experts get by default, for three times the steps, beside the design of the paper.
FRESH_PAIRS = {"standard": (("fresh", "10"), ("fresh", "jacobian")), "paper": ()}


def cells(quick: bool) -> list[Cell]:
    """Every preset, budget, seed, environment and method."""
    return [
        {"expert": expert, "preset": preset, "episodes": budget, "method": method, "seed": seed}
        for preset, budget in (GRID[:1] if quick else GRID)
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
        for method in METHODS[preset]
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, with its preset."""
    preset, method = cell["preset"], cell["method"]
    return usual_arguments(cell, PRESETS[preset] | METHODS[preset][method])


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables a preset, of the budgets that are complete."""
    files, text = {}, ""
    for preset, methods in METHODS.items():
        mine = [row for row in rows if row["cell"]["preset"] == preset]
        scores = scores_of(mine, list(methods), len(SEEDS))
        if not scores:
            continue
        picture = draw_scores(scores, list(methods), label)
        pairs = PAIRS + FRESH_PAIRS[preset]
        files[f"finite_difference_{preset}.png"] = picture
        text += f"## Preset `{preset}`\n\n{scores_text(scores, list(methods), pairs)}\n"
    return files and files | {"finite_difference.md": text.strip().encode() + b"\n"}


BENCHMARK = distillations("finite_difference", __doc__ or "", cells, arguments, draw)
