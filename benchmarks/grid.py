"""What benchmarks of the paper's experts have in common: experts, seeds, methods, their names."""

from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.controllers import available
from benchmarks.runner import Cell

__all__ = ["SEEDS", "STANDARD_METHODS", "every_expert", "experts", "label", "side_by_side"]

SEEDS = range(5)
ENVIRONMENTS = ("Walker2d", "HalfCheetah", "Ant", "Humanoid")

STANDARD_METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    "jacobian": {"probes": "jacobian"},
    **{str(count): {"probes": count} for count in (1, 5, 10, 50)},
    # A moved state's label counts as much as a visited state's.
    "augmentation": {"probes": "adaptive:10,labels", "weight": 1.0},
    # Asked anew at every visit, for as many steps as the library gives it.
    "fresh": {"probes": "fresh", "steps": None},
}
"""By the name that cells use: settings of `benchmarks.distillation`, with the standard preset."""

_LABELS = {
    "plain": "plain cloning",
    "jacobian": "analytic Jacobian",
    "1": "1 probe",
    "augmentation": "10 answers as labels",
    "fresh": "fresh queries, longer training",
}


def experts() -> list[str]:
    """Return the paper's experts where they are, this project's otherwise."""
    here = available(*(f"paper/{name}" for name in ENVIRONMENTS))
    return here or available(*(f"{name}-v5" for name in ENVIRONMENTS))


def every_expert(quick: bool) -> list[Cell]:
    """Return a cell for every expert that moves on its own, and seed.

    Args:
        quick: Whether to take two seeds of one expert only.
    """
    return [
        {"expert": expert, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
        for expert in (available("HalfCheetah-v5") if quick else available())
    ]


def side_by_side(
    quick: bool, budgets: Sequence[int], names: Sequence[str], methods: Iterable[str]
) -> list[Cell]:
    """Return a cell for every budget, seed, expert and method.

    Args:
        quick: Whether to take two seeds of the first budget and expert only.
        budgets: Numbers of trajectories.
        names: Of experts.
        methods: Side by side.
    """
    methods = list(methods)
    return [
        {"expert": expert, "episodes": budget, "method": method, "seed": seed}
        for budget in (budgets[:1] if quick else budgets)
        for seed in (range(2) if quick else SEEDS)
        for expert in (names[:1] if quick else names)
        for method in methods
    ]


def label(method: str) -> str:
    """Return what figures call a method; a number is one of probes."""
    return _LABELS.get(method, f"{method} probes" if method.isdigit() else method)
