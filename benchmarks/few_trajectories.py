"""What makes most of one or five trajectories: fresh queries and their rivals."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import fdtasil
from benchmarks.comparison import draw_methods
from benchmarks.distillation import HORIZON, distil, recorded
from benchmarks.grid import SEEDS, experts, side_by_side
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.scores import scores_of
from fdtasil.probes.answers import Answers
from fdtasil.probes.scales import measure_scales

__all__ = ["BENCHMARK", "with_neighbours"]

BUDGETS = (1, 5)
NEIGHBOURS = 10
_APART = 10  # rows: a state's neighbours in time differ from it by next to nothing
# Steps that fresh queries take by default, three times those of the others: is it the length?
_LONGER = {"steps": 12_000}
METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    "plain, longer": {"probes": 0, **_LONGER},
    "neighbours": {"dataset": "neighbours"},
    "noise": {"probes": 0, "trainer": "noise"},
    "noise, longer": {"probes": 0, "trainer": "noise", **_LONGER},
    "10 probes": {"probes": 10},
    "10 probes, longer": {"probes": 10, **_LONGER},
    "10 probes, noise": {"probes": 10, "trainer": "noise"},
    "10 probes, both": {"probes": "10,both"},
    "fresh": {"probes": "fresh"},
    "fresh, both": {"probes": "fresh,both"},
    "fresh, noise": {"probes": "fresh", "trainer": "noise"},
}
PICTURED = (
    "plain",
    "plain, longer",
    "noise, longer",
    "10 probes",
    "10 probes, longer",
    "fresh",
    "fresh, noise",
)
PAIRS = (
    ("fresh", "plain, longer"),
    ("fresh", "noise, longer"),
    ("fresh", "noise"),
    ("fresh", "10 probes, longer"),
    ("fresh", "10 probes"),
    ("fresh", "fresh, both"),
    ("fresh", "fresh, noise"),
    ("10 probes, both", "10 probes"),
    ("neighbours", "plain"),
)


def cells(quick: bool) -> list[Cell]:
    """Every budget, seed, expert and method."""
    return side_by_side(quick, BUDGETS, experts(), METHODS)


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, default settings otherwise."""
    shape = {name: cell[name] for name in ("expert", "episodes", "seed")}
    return {**shape, "horizon": HORIZON, **METHODS[cell["method"]]}


def measure(cell: Cell, device: str) -> dict[str, Any]:
    """Distil with one method; with neighbours, from demonstrations that are recorded first."""
    settings = arguments(cell)
    if "dataset" not in settings:
        return distil(**settings, device=device)
    shape = {name: settings[name] for name in ("expert", "seed", "horizon")}
    dataset = with_neighbours(recorded(episodes=settings["episodes"], **shape))
    return distil(dataset=dataset, **shape, device=device)


def with_neighbours(dataset: fdtasil.Dataset) -> fdtasil.Dataset:
    """Return a dataset whose probes lead to other demonstrated states: nobody is asked.

    Differences between neighbouring states and their actions stand in for derivatives (Kissel and
    Diepold, ECML 2019).
    """
    states = dataset.demonstrations
    scales = measure_scales(states.observations)
    whitened = (states.observations / scales.deviation)[:, scales.live].astype(np.float64)
    squares = (whitened**2).sum(axis=1)
    distances = squares[:, None] + squares - 2 * whitened @ whitened.T
    rows = np.arange(len(whitened))
    distances[np.abs(rows[:, None] - rows) < _APART] = np.inf
    nearest = np.argsort(distances, axis=1)[:, :NEIGHBOURS]
    displacements = states.observations[nearest] - states.observations[:, None]
    lengths = np.linalg.norm(whitened[nearest] - whitened[:, None], axis=2)
    answers = Answers(
        displacements.reshape(-1, displacements.shape[-1]),
        np.arange(nearest.size, dtype=np.int32).reshape(nearest.shape),
        states.actions[nearest][:, :, None],
        scales.live.sum() ** 0.5 / np.maximum(lengths, 1e-3).reshape(-1),
    )
    source = fdtasil.Probes.parse(f"sphere:{NEIGHBOURS},forward,whitened,radius=1,per_step=1")
    return replace(dataset, probes=source, answers=answers)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """The picture and the tables of the groups that are complete."""
    short = [method for method, settings in METHODS.items() if "steps" not in settings]
    scores = scores_of(rows, short, len(SEEDS))
    return draw_methods("few_trajectories", scores, list(METHODS), PAIRS, PICTURED)


BENCHMARK = Benchmark("few_trajectories", __doc__ or "", cells, measure, draw, arguments=arguments)
