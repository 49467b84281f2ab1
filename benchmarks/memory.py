"""An expert with a memory, in an environment that hides speeds: students with and without one."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

import fdtasil
from benchmarks.controllers import OWN
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.scores import by_demonstrations

__all__ = ["BENCHMARK"]

EXPERT = "InvertedPendulum-v5-hidden.zip"  # an LSTM, by RecurrentPPO
HORIZON = 150
EPISODES = (1, 3)
METHODS: dict[str, dict[str, Any]] = {
    "no history": {"probes": 10},
    "history=2": {"probes": 10, "history": 2},
    "history=3": {"probes": 10, "history": 3},
    "plain cloning, history=3": {"probes": 0, "history": 3},
}


class Hidden(gymnasium.ObservationWrapper):
    """The pendulum on a cart, of which only positions are seen."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("InvertedPendulum-v5"))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation[:2].astype(np.float32)


def cells(quick: bool) -> list[Cell]:
    """Every number of episodes, seed and method."""
    return [
        {"episodes": episodes, "method": method, "seed": seed}
        for episodes in (EPISODES[:1] if quick else EPISODES)
        for seed in (SEEDS[:2] if quick else SEEDS)
        for method in METHODS
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil the recurrent agent."""
    result = fdtasil.distill(
        str(OWN / EXPERT),
        Hidden,
        episodes=cell["episodes"],
        horizon=HORIZON,
        seed=cell["seed"],
        device=device,
        progress=False,
        **METHODS[cell["method"]],
    )
    evaluation, report = result.evaluation, result.report
    assert evaluation is not None
    scores = ("normalized_return", "expert_return", "survival", "expert_survival")
    names = ("train_seconds", "queries", "warnings")
    return {name: getattr(evaluation, name) for name in scores} | {n: report[n] for n in names}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: demonstrations down, methods across."""
    text = by_demonstrations(rows, EPISODES, list(METHODS))
    return {"memory.md": text.encode()}


BENCHMARK = Benchmark("memory", __doc__ or "", cells, run, draw)
