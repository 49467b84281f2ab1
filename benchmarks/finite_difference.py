"""The paper's finite-difference appendix: how many probes stand in for the Jacobian."""

from collections.abc import Sequence
from typing import Any

from benchmarks.comparison import draw_scores, scores_of, scores_text
from benchmarks.controllers import available
from benchmarks.distillation import distillations, usual_arguments
from benchmarks.runner import Cell, Row

__all__ = ["FINITE_DIFFERENCE", "SEEDS", "STANDARD_METHODS", "experts", "label"]

ENVIRONMENTS = ("Walker2d", "HalfCheetah", "Ant", "Humanoid")
SEEDS = range(5)

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
STANDARD_METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    "jacobian": {"probes": "jacobian"},
    **{str(count): {"probes": count} for count in (1, 5, 10, 50)},
    # A moved state's label counts as much as a visited state's.
    "augmentation": {"probes": "adaptive:10,labels", "weight": 1.0},
}
METHODS: dict[str, dict[str, dict[str, Any]]] = {
    "standard": STANDARD_METHODS,
    "paper": {
        "plain": {"probes": 0},
        "jacobian": {"probes": "jacobian,per_step=1"},
        **{str(count): {"probes": f"sphere:{count},per_step=1"} for count in (1, 5, 10, 50)},
        "augmentation": {"probes": "sphere:10,labels,per_step=1", "weight": 1.0},
    },
}


def cells(quick: bool) -> list[Cell]:
    """Every preset, budget, seed, environment and method."""
    return [
        {"expert": expert, "preset": preset, "episodes": budget, "method": method, "seed": seed}
        for preset, budget in (GRID[:1] if quick else GRID)
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
        for method in METHODS[preset]
    ]


def experts() -> list[str]:
    """Return the paper's experts where they are, this project's otherwise."""
    here = available(*(f"paper/{name}" for name in ENVIRONMENTS))
    return here or available(*(f"{name}-v5" for name in ENVIRONMENTS))


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, with its preset."""
    preset, method = cell["preset"], cell["method"]
    return usual_arguments(cell) | PRESETS[preset] | METHODS[preset][method]


# The appendix's claims, and the rival: ours - theirs on equal seeds.
PAIRS = (("1", "jacobian"), ("10", "jacobian"), ("10", "1"), ("50", "1"), ("10", "augmentation"))
_LABELS = {
    "plain": "plain cloning",
    "jacobian": "analytic Jacobian",
    "1": "1 probe",
    "augmentation": "10 answers as labels",
}


def label(method: str) -> str:
    """Return what figures call a method; a number is one of probes."""
    return _LABELS.get(method, f"{method} probes" if method.isdigit() else method)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables a preset, of the budgets that are complete."""
    files, text = {}, ""
    for preset, methods in METHODS.items():
        mine = [row for row in rows if row["cell"]["preset"] == preset]
        scores = scores_of(mine, list(methods), len(SEEDS))
        if not scores:
            continue
        picture = draw_scores(scores, list(methods), label)
        files[f"finite_difference_{preset}.png"] = picture
        text += f"## Preset `{preset}`\n\n{scores_text(scores, list(methods), PAIRS)}\n"
    return files and files | {"finite_difference.md": text.strip().encode() + b"\n"}


FINITE_DIFFERENCE = distillations("finite_difference", __doc__ or "", cells, arguments, draw)
