"""Discrete actions: what one and five episodes teach of an agent's scores, or of its choices."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import fdtasil
from benchmarks.controllers import OWN
from benchmarks.grid import SEEDS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.statistics import SCORES_NOTE, interval_text
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

EXPERTS = {
    f"{name}-{algorithm}": name
    for name in ("CartPole-v1", "LunarLander-v3")
    for algorithm in ("PPO", "DQN")
}
ANSWERS = ("scores", "choices")
EPISODES = (1, 5)
PROBES: dict[str, Any] = {"plain cloning": 0, "10 probes": 10, "fresh": "fresh"}
EVALUATED = 30


def cells(quick: bool) -> list[Cell]:
    """Every expert, kind of answer, number of episodes, method and seed."""
    return [
        {
            "expert": expert,
            "answers": answers,
            "episodes": episodes,
            "method": method,
            "seed": seed,
        }
        for seed in (SEEDS[:2] if quick else SEEDS)
        for episodes in EPISODES[: 1 if quick else 2]
        for expert in ([*EXPERTS][:1] if quick else EXPERTS)
        for answers in ANSWERS
        for method in PROBES
    ]


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Distil an agent, or a function that says what it chooses and nothing else."""
    path, environment = OWN / f"{cell['expert']}.onnx", EXPERTS[cell["expert"]]
    result = fdtasil.distill(
        path if cell["answers"] == "scores" else _chooser(path),
        environment,
        PROBES[cell["method"]],
        episodes=cell["episodes"],
        seed=cell["seed"],
        evaluation_episodes=EVALUATED,
        device=device,
        progress=False,
    )
    evaluation, report = result.evaluation, result.report
    assert evaluation is not None
    scores = ("normalized_return", "expert_return", "student_return", "agreement", "survival")
    names = ("train_seconds", "steps", "states", "queries", "probes", "warnings")
    return {
        **{name: getattr(evaluation, name) for name in scores},
        **{name: report[name] for name in names},
    }


def _chooser(path: Any) -> Callable[[np.ndarray], np.ndarray]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)

    def choose(observations: np.ndarray) -> np.ndarray:
        (scores,) = session.run(None, {"obs": observations})
        return scores.argmax(axis=1)

    return choose


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: experts, answers and episodes down, methods across."""
    lines = []
    for episodes in EPISODES:
        for expert in EXPERTS:
            for answers in ANSWERS:
                shape = {"expert": expert, "answers": answers, "episodes": episodes}
                found = {method: _found(rows, {**shape, "method": method}) for method in PROBES}
                if all(len(results) > 1 for results in found.values()):
                    lines.append([expert, answers, str(episodes), *map(_text, found.values())])
    heads = ["expert", "what it answers", "episodes"]
    heads += [f"{name}: return, agreement" for name in PROBES]
    return {"choices.md": f"{SCORES_NOTE}\n{table(heads, lines)}".encode()}


def _found(rows: Sequence[Row], shape: Cell) -> list[dict[str, Any]]:
    return [row["result"] for row in rows if shape.items() <= row["cell"].items()]


def _text(results: Sequence[dict[str, Any]]) -> str:
    agreement = float(np.mean([result["agreement"] for result in results]))
    return f"{interval_text([r['normalized_return'] for r in results])}, {agreement:.2f}"


BENCHMARK = Benchmark("choices", __doc__ or "", cells, run, draw)
