"""do-mpc's approximate MPC beside this library's student, of one planner with hard limits."""

import time
from collections.abc import Iterator, Sequence
from statistics import fmean, median
from typing import Any

import numpy as np

import fdtasil
from benchmarks.constrained_mpc import HORIZON, METHODS
from benchmarks.controllers import planner
from benchmarks.peers.process import ask_peer
from benchmarks.peers.weights import Policy, arrays_of, checked_policy
from benchmarks.runner import Cell, Row
from benchmarks.statistics import interval_text
from benchmarks.tables import table

__all__ = ["PEER", "cells", "run", "text"]

PEER = "do_mpc"
SEEDS = range(3)
EPISODES = 3  # of ours
JUDGED = 5  # episodes; the planner is asked at each of their states
CALLS = 2_000
MARGIN = 1.2  # of the box that do-mpc samples

# The first is the training of its own example, with the package's own network.
TRAININGS = {
    "as in its example": {
        "hidden_layers": 3,
        "width": 50,
        "epochs": 3_000,
        "batch_size": 1_000,
        "patience": 50,
    },
    "tuned": {
        "hidden_layers": 2,
        "width": 256,
        "epochs": 1_000,
        "batch_size": 100,
        "patience": 20,
    },
}


def cells(quick: bool) -> list[Cell]:
    """Ours and theirs by seed, and one with ten times their solves, which takes a while."""
    small: list[Cell] = [
        {"what": "control", **size, "seed": seed}
        for seed in (SEEDS[:1] if quick else SEEDS)
        for size in ({"episodes": EPISODES}, {"solves": 5_000})
    ]
    return small if quick else [*small, {"what": "control", "solves": 50_000, "seed": len(SEEDS)}]


def run(cell: Cell) -> dict[str, Any]:
    """Return by method what its student costs, and how it controls."""
    return (_theirs if "solves" in cell else _ours)(cell, planner())


def _ours(cell: Cell, example: Any) -> dict[str, Any]:
    begun = time.process_time()
    result = fdtasil.distill(
        example.controller,
        example.CartPole,
        METHODS["10 probes"],
        episodes=cell["episodes"],
        horizon=HORIZON,
        seed=cell["seed"],
        evaluation_episodes=0,
        progress=False,
    )
    spent, queries = time.process_time() - begun, result.queries
    states, answers = _expert_states(cell["seed"], example)
    times = []
    for number in range(CALLS):
        state = states[number % len(states)]
        started = time.perf_counter()
        result.student.predict(state)
        times.append(time.perf_counter() - started)
    found = {
        "queries": sum(rows for name, rows in queries.items() if name != "evaluate"),
        "seconds": spent,
        "microseconds": 1e6 * median(times),
    }

    def policy(rows: np.ndarray) -> np.ndarray:
        return result.student.predict(rows)[0]

    return {"fdtasil, 10 probes": found | _judge(policy, states, answers, cell, example)}


def _theirs(cell: Cell, example: Any) -> dict[str, Any]:
    states, answers = _expert_states(cell["seed"], example)
    # A little wider than the states that they are judged at, which nobody knows beforehand.
    box = (MARGIN * np.abs(states).max(axis=0)).tolist()
    job = {"seed": cell["seed"], "solves": cell["solves"], "box": box, "trainings": TRAININGS}
    results, arrays = ask_peer(PEER, job, {"states": states})
    high = np.array([example.FORCE])
    found = {}
    for name, result in results.items():
        mine = arrays_of(name, arrays)
        policy = checked_policy(mine, -high, high, states, mine["answers"])
        cost = {"queries": cell["solves"], "seconds": result.pop("seconds")}
        judged = _judge(policy, states, answers, cell, example)
        found[f"do-mpc, {name}"] = cost | result | judged
    return found


def _expert_states(seed: int, example: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return states that the planner visits from other starts, and its answers."""
    recorded = fdtasil.distill(
        example.controller,
        example.CartPole,
        0,
        episodes=JUDGED,
        horizon=HORIZON,
        seed=1_000 + seed,
        evaluation_episodes=0,
        fit=fdtasil.Fit(steps=1),
        progress=False,
    ).demonstrations
    return recorded.observations, recorded.actions


def _judge(
    policy: Policy, states: np.ndarray, answers: np.ndarray, cell: Cell, example: Any
) -> dict[str, Any]:
    """Compare a policy with the planner, at its states and in its place."""
    found = fdtasil.evaluate(
        policy,
        example.controller,
        example.CartPole,
        episodes=JUDGED,
        horizon=HORIZON,
        seed=cell["seed"],
        constraints=example.LIMITS,
        progress=False,
    )
    ((_, theirs, ours),) = found.violations
    return {
        "expert_state_error": float(np.abs(policy(states) - answers).mean()),
        "own_state_error": found.action_error,
        "normalized_return": found.normalized_return,
        "violations": ours,
        "expert_violations": theirs,
    }


def text(rows: Sequence[Row]) -> str:
    """One table: methods down."""
    heads = ["student", "seeds", "queries", "force error on the expert's states, N", "on its own"]
    heads += ["return / expert's", "violations, student and expert", "CPU seconds"]
    return table([*heads, "microseconds a call"], _lines(rows))


def _lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    found: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        for name, result in row["result"].items():
            found.setdefault((name, row["cell"].get("solves", 0)), []).append(result)
    for (name, _), results in sorted(found.items(), key=lambda item: item[0][1]):

        def values(key: str, results: Sequence[dict[str, Any]] = results) -> list[float]:
            return [result[key] for result in results]

        yield [
            name,
            str(len(results)),
            f"{fmean(values('queries')):,.0f}",
            interval_text(values("expert_state_error"), 3),
            interval_text(values("own_state_error"), 3),
            interval_text(values("normalized_return")),
            f"{fmean(values('violations')):.2%}, {fmean(values('expert_violations')):.2%}",
            f"{fmean(values('seconds')):,.0f}",
            f"{fmean(values('microseconds')):.0f}",
        ]
