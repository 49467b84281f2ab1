"""imitation's cloning and DAgger beside this library's, by equal starts and environment steps."""

import time
from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import Any

import numpy as np

import fdtasil
from benchmarks.controllers import CONTROLLERS, available
from benchmarks.distillation import HORIZON, recorded
from benchmarks.peers.process import ask_peer
from benchmarks.peers.weights import arrays_of, checked_policy, policy_of
from benchmarks.runner import Cell, Row
from benchmarks.statistics import interval_text
from benchmarks.tables import table
from fdtasil.seeding import episode_seeds

__all__ = ["PEER", "cells", "run", "text"]

PEER = "imitation"
SEEDS = range(3)
EXPERTS = ("HalfCheetah-v5", "Walker2d-v5")
BUDGETS = (1, 5)  # trajectories
ENOUGH = 0.95  # of the expert's return
SHORTER = (1_000, 3_000)  # steps of ours: is less training enough?
CHECKPOINTS = 5

OURS: dict[str, dict[str, Any]] = {
    "fdtasil": {},
    "fdtasil, 10 probes": {"probes": 10},
    "fdtasil, plain cloning": {"probes": 0},
}

# The classes' defaults, but for the length of BC's training, which has none.
_DEFAULTS = {
    "hidden": [32, 32],
    "normalise": False,
    "batch_size": 32,
    "learning_rate": 1e-3,
    "entropy_weight": 1e-3,
    "l2_weight": 0.0,
    "batches": 5_000,
    "rounds": None,
}
_ROUNDS = {"epochs": 4, "batches": None, "episodes": 3, "steps": 500, "beta_decay": None}
# The best of five settings of width, rate, weight decay, normalisation and length, at five
# trajectories of HalfCheetah-v5 by a seed that is in no table. DAgger's rounds were not searched.
_TUNED = {
    "hidden": [256, 256],
    "normalise": True,
    "batch_size": 100,
    "learning_rate": 3e-4,
    "entropy_weight": 0.0,
    "l2_weight": 1e-4,
    "batches": 8_000,
}
_TUNED_ROUNDS = {"epochs": None, "batches": 300, "episodes": 1, "steps": 300, "beta_decay": 0.5}
THEIRS: dict[str, dict[str, Any]] = {
    "imitation, BC": {},
    "imitation, BC, tuned": _TUNED,
    "imitation, BC, policy of stable-baselines3": {"hidden": [64, 64]},
    "imitation, DAgger": {"rounds": _ROUNDS},
    "imitation, DAgger, tuned": {**_TUNED, "rounds": _TUNED_ROUNDS},
}
# DAgger's first round is the expert's, and a round is a whole episode at least.
_OF_DAGGER = (5, 20)


def cells(quick: bool) -> list[Cell]:
    """Every seed, expert, method and budget, of both sides."""
    return [
        {"what": "cloning", "method": method, "expert": expert, "episodes": budget, "seed": seed}
        for seed in (SEEDS[:2] if quick else SEEDS)
        for expert in available(*(EXPERTS[:1] if quick else EXPERTS))
        for method in (*OURS, *THEIRS)
        for budget in _budgets(method)[: 1 if quick else None]
    ]


def _budgets(method: str) -> tuple[int, ...]:
    return _OF_DAGGER if THEIRS.get(method, {}).get("rounds") else BUDGETS


def run(cell: Cell) -> dict[str, Any]:
    """Train with one method, and return what it cost and what came of it."""
    return (_ours if cell["method"] in OURS else _theirs)(cell)


def _ours(cell: Cell) -> dict[str, Any]:
    result, seconds, score = _distilled(cell, None)
    enough = None
    if score >= ENOUGH:
        # A shorter training has a schedule of its own: that of a longer one is not half done.
        shorter = [steps for steps in SHORTER if steps < result.report["steps"]]
        tried = (_distilled(cell, steps)[1:] for steps in shorter)
        enough = next((spent for spent, reached in tried if reached >= ENOUGH), seconds)
    asked = sum(rows for name, rows in result.queries.items() if name != "evaluate")
    return {
        "normalized_return": score,
        "environment_steps": len(result.demonstrations),
        "queries": asked,
        "seconds": seconds,
        "seconds_to_enough": enough,
    }


def _distilled(cell: Cell, steps: int | None) -> tuple[fdtasil.Distilled, float, float]:
    """Return the result, the processor's seconds of all but the evaluation, and the return."""
    path, environment = CONTROLLERS[cell["expert"]].open()
    begun = time.process_time()
    result = fdtasil.distill(
        path,
        environment,
        episodes=cell["episodes"],
        horizon=HORIZON,
        seed=cell["seed"],
        fit=fdtasil.Fit(steps=steps),
        evaluation_episodes=0,
        progress=False,
        **OURS[cell["method"]],
    )
    seconds = time.process_time() - begun
    return result, seconds, _return(result, cell)


def _theirs(cell: Cell) -> dict[str, Any]:
    path, environment = CONTROLLERS[cell["expert"]].open()
    settings = _DEFAULTS | THEIRS[cell["method"]]
    rounds = settings["rounds"]
    if rounds:
        settings = settings | {"rounds": rounds | {"total": HORIZON * cell["episodes"]}}
    shape = {name: cell[name] for name in ("expert", "episodes", "seed")}
    dataset = recorded(**shape)
    states, actions = dataset.demonstrations.observations, dataset.demonstrations.actions
    job = settings | {
        "seed": cell["seed"],
        "environment": environment,
        "expert": str(path),
        "horizon": HORIZON,
        "checkpoints": CHECKPOINTS,
    }
    starts = np.array(episode_seeds(cell["seed"], "rollout", 0, cell["episodes"]))
    given = {"observations": states, "actions": actions, "starts": starts}
    result, found = ask_peer(PEER, job, given)
    seconds, steps = result["seconds"], result["environment_steps"]

    low, high, last = dataset.low, dataset.high, len(seconds) - 1
    final = checked_policy(arrays_of(str(last), found), low, high, states, found["answers"])
    score = _return(final, cell)
    earlier = (
        _return(policy_of(arrays_of(str(number), found), low, high), cell)
        for number in range(last)
    )
    reached = next((n for n, share in enumerate(earlier) if share >= ENOUGH), None)
    if reached is None and score >= ENOUGH:
        reached = last
    taken = steps[-1] if rounds else len(states)
    return {
        "normalized_return": score,
        "environment_steps": taken,
        "queries": taken,
        "seconds": seconds[-1],
        "seconds_to_enough": None if reached is None else seconds[reached],
    }


def _return(policy: Any, cell: Cell) -> float:
    path, environment = CONTROLLERS[cell["expert"]].open()
    judged = fdtasil.evaluate(
        policy, path, environment, horizon=HORIZON, seed=cell["seed"], progress=False
    )
    assert judged.normalized_return is not None
    return judged.normalized_return


def text(rows: Sequence[Row]) -> str:
    """One table: experts, methods and budgets down."""
    heads = ["expert", "method", "trajectories", "seeds", "return / expert's"]
    heads += ["environment steps", "queries", "CPU seconds", f"CPU seconds to {ENOUGH}"]
    return table(heads, _lines(rows))


def _lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    for expert in EXPERTS:
        for method in (*OURS, *THEIRS):
            for budget in _budgets(method):
                wanted = (expert, method, budget)
                names = ("expert", "method", "episodes")
                mine = [
                    row["result"]
                    for row in rows
                    if tuple(row["cell"][name] for name in names) == wanted
                ]
                if mine:
                    yield [expert, method, str(budget), str(len(mine)), *_texts(mine)]


def _texts(results: Sequence[dict[str, Any]]) -> list[str]:
    def mean(name: str) -> str:
        return f"{fmean(result[name] for result in results):,.0f}"

    reached = [r["seconds_to_enough"] for r in results if r["seconds_to_enough"] is not None]
    soon = f"{fmean(reached):,.0f}" if reached else "not reached"
    if 0 < len(reached) < len(results):
        soon += f" ({len(reached)} of {len(results)} seeds)"
    share = interval_text([result["normalized_return"] for result in results])
    return [share, *map(mean, ("environment_steps", "queries", "seconds")), soon]
