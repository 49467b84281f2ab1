"""The paper's stability experiment: the less an expert forgives, the higher the order it needs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

import fdtasil
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.stability_figure import draw_figure
from benchmarks.stability_table import draw_table
from benchmarks.synthetic_system import (
    CONTRACTION,
    SIZE,
    SyntheticSystem,
    advance,
    as_function,
    make_expert,
)
from fdtasil.rollouts.behaviours import Policy
from fdtasil.run.presets import preset_of
from fdtasil.seeding import generator

__all__ = ["BENCHMARK", "follow_student"]

SEEDS = range(10)
STEPS = 4500
DEMONSTRATIONS = 20
HORIZON = 100
TESTS = 50
# The paper's interval, and its thresholds exactly.
NUS = tuple(sorted({*np.geomspace(0.05, 3, 25).round(3).tolist(), round(1 / 3, 4), 0.5, 1.0}))
# Nothing but rounding tells what is recorded at one nu from another; here rounding is small.
_RECORDED_AT = 1.0
# Above nu = 1 a bad student may run away faster than exponentially: it is stopped there.
_FAR = 1e6

SOURCES: dict[tuple[int, str], str] = {
    (0, "none"): "none",
    # The paper's appendix on finite differences: ten directions on a sphere of radius 0.01.
    (1, "differences"): "sphere:10,forward",
    (2, "differences"): "sphere:10,central",
    (1, "jacobian"): "jacobian",
    (2, "jacobian"): "jacobian",
}
"""Order and source of the derivatives -> the argument `probes`."""


def cells(quick: bool) -> list[Cell]:
    """Every seed, order and source; a cell's student is judged at every nu.

    One student serves all: the expert's own paths are eta^t x_0 whatever nu is, and with them all
    that a student is trained on.
    """
    return [
        {"order": order, "source": source, "seed": seed, "steps": STEPS}
        for seed in (SEEDS[:1] if quick else SEEDS)
        for order, source in SOURCES
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil with the paper's settings, and judge from fresh starts and from those learnt from."""
    order, source, seed = cell["order"], cell["source"], cell["seed"]
    expert = make_expert(seed)
    asked = as_function(expert)
    # The action box has no bounds, so the student's output is linear and nothing is clipped.
    result = fdtasil.distill(
        expert if source == "jacobian" else asked,
        lambda: SyntheticSystem(_RECORDED_AT, seed),
        SOURCES[order, source],
        # Raw states and every probe in every step: with these the library's first-order term is
        # the paper's, the unsquared Frobenius norm of the Jacobian's error.
        preset="paper",
        fit=preset_of("paper").fit_with(
            steps=cell["steps"],
            order=max(1, order),
            weight=1.0,
            # The library's term is the size of z'Hz for z uniform on the sphere of radius sqrt(n),
            # about sqrt(2) times the Frobenius norm of H where n is 10 (never below 1.29 times;
            # 1.5 for the difference of two experts): this is about the paper's 10.
            curvature_weight=10.0 / 2**0.5 if order == 2 else None,
        ),
        student=fdtasil.Mlp((64, 64, 64)),
        episodes=DEMONSTRATIONS,
        horizon=HORIZON,
        seed=seed,
        device=device,
        evaluation_episodes=0,  # judged below
        progress=False,
    )
    seen = result.demonstrations
    first = np.unique(seen.episode, return_index=True)[1]
    starts = {
        "fresh": generator(seed, "test starts").standard_normal((TESTS, SIZE)),
        "learnt": seen.observations[first].astype(np.float64),
    }
    last = result.history[-1]
    return {
        "nus": list(NUS),
        **{name: follow_student(result.student.act, asked, x) for name, x in starts.items()},
        **{name: last[name] for name in ("action_error", "derivative_error", "curvature_error")},
        "queries": result.queries,
        "train_seconds": result.report["train_seconds"],
    }


def follow_student(student: Policy, expert: Policy, starts: np.ndarray) -> dict[str, Any]:
    """Let a student act from some starts, at every nu, beside the expert.

    Args:
        student: (B, 10) -> (B, 10).
        expert: -h.
        starts: (E, 10).

    Returns:
        Median and 90 % quantile over the starts, one of each for each nu, of `gap`, the largest
        distance to the expert's path, and of `largest` and `mean`, over time, of the distance of
        the student's action to the expert's on the student's path; in `on_expert` the latter two
        on the expert's path, which are the same for each nu.
    """
    nus = np.array(NUS)[:, None, None]
    ours = np.broadcast_to(starts, (len(NUS), *starts.shape))
    # In closed form: the expert's rounding would be an error like a student's.
    theirs = starts * CONTRACTION ** np.arange(HORIZON + 1)[:, None, None]
    gap, errors = np.zeros(ours.shape[:2]), []
    for step in range(HORIZON):
        error = _error(student, expert, ours)
        errors.append(np.linalg.norm(error, axis=-1))
        ours = np.clip(advance(ours, error, nus), -_FAR, _FAR)
        gap = np.maximum(gap, np.linalg.norm(ours - theirs[step + 1], axis=-1))
    base = np.linalg.norm(_error(student, expert, theirs[:-1]), axis=-1)
    return {
        "gap": _summary(gap),
        "largest": _summary(np.max(errors, axis=0)),
        "mean": _summary(np.mean(errors, axis=0)),
        "on_expert": {"largest": _summary(base.max(axis=0)), "mean": _summary(base.mean(axis=0))},
    }


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """The paper's first figure, and a table of it."""
    return {"stability.png": draw_figure(rows), "stability.md": draw_table(rows)}


def _error(student: Policy, expert: Policy, states: np.ndarray) -> np.ndarray:
    flat = states.reshape(-1, SIZE).astype(np.float32)
    return (student(flat) - expert(flat)).astype(np.float64).reshape(states.shape)


def _summary(values: np.ndarray) -> dict[str, Any]:
    """Return median and 90 % quantile of the last axis, to four digits."""
    quantiles = {"median": np.median(values, axis=-1), "q90": np.quantile(values, 0.9, axis=-1)}
    return {name: _short(found) for name, found in quantiles.items()}


def _short(values: np.ndarray) -> Any:
    return float(f"{values:.4g}") if values.ndim == 0 else [_short(value) for value in values]


BENCHMARK = Benchmark("stability", __doc__ or "", cells, run, draw)
