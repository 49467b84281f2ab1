"""What benchmarks of the paper's experts have in common: experts, seeds, methods, their names."""

from typing import Any

from benchmarks.controllers import available

__all__ = ["SEEDS", "STANDARD_METHODS", "experts", "label"]

SEEDS = range(5)
ENVIRONMENTS = ("Walker2d", "HalfCheetah", "Ant", "Humanoid")

STANDARD_METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    "jacobian": {"probes": "jacobian"},
    **{str(count): {"probes": count} for count in (1, 5, 10, 50)},
    # A moved state's label counts as much as a visited state's.
    "augmentation": {"probes": "adaptive:10,labels", "weight": 1.0},
}
"""By the name that cells use: settings of `benchmarks.distillation`, with the standard preset."""

_LABELS = {
    "plain": "plain cloning",
    "jacobian": "analytic Jacobian",
    "1": "1 probe",
    "augmentation": "10 answers as labels",
}


def experts() -> list[str]:
    """Return the paper's experts where they are, this project's otherwise."""
    here = available(*(f"paper/{name}" for name in ENVIRONMENTS))
    return here or available(*(f"{name}-v5" for name in ENVIRONMENTS))


def label(method: str) -> str:
    """Return what figures call a method; a number is one of probes."""
    return _LABELS.get(method, f"{method} probes" if method.isdigit() else method)
