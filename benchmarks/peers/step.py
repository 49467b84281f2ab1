"""The cost of a training step: the paper's loss in JAX beside this library's step."""

import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.peers.process import command_of, variables
from benchmarks.runner import Cell, Row
from benchmarks.tables import table
from fdtasil.compute import torch_settings
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import torch_generator
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import fit
from fdtasil.student.policy import Student

__all__ = ["PEER", "cells", "run", "text"]

PEER = "jax"
N, M, HIDDEN, BATCH, STATES = 17, 6, 512, 100, 1_500
PROBES, RADIUS = 10, 0.3
STEPS, ROUNDS = 200, 7
MEASUREMENTS = range(3)  # each with a process of its own for JAX, whose steps differ by a third
OURS = {
    "plain": None,
    "10 probes at every step": f"sphere:{PROBES},forward,per_step=all",
    "10 probes, one a step": f"sphere:{PROBES},forward",
}
"""Ours by what it is called; the last is this library's default, and JAX has none of it."""
_SHARED = list(OURS)[:2]


def cells(quick: bool) -> list[Cell]:
    """The same measurement several times; in each, everything is measured in turn."""
    return [
        {"what": "step", "seed": number}
        for number in (MEASUREMENTS[:1] if quick else MEASUREMENTS)
    ]


def run(cell: Cell) -> dict[str, Any]:
    """Return milliseconds of the processor a step, of both sides in turn."""
    times: dict[str, list[float]] = {}
    with torch_settings(torch.device("cpu")), _jax() as theirs:
        tasks: dict[str, Callable[[], float]] = {
            **{f"fdtasil, {name}": _task(spec) for name, spec in OURS.items()},
            **{f"JAX, {name}": lambda name=name: theirs(name) for name in _SHARED},
        }
        for task in tasks.values():  # the first run compiles, and pays for what others find done
            task()
        for _ in range(ROUNDS):
            for name, task in tasks.items():
                times.setdefault(name, []).append(task() / STEPS * 1e3)
    return {"milliseconds": times}


def _task(spec: str | None) -> Callable[[], float]:
    """Return a training of `STEPS` steps, which returns the processor's seconds that it took."""
    observations = np.random.default_rng(0).standard_normal((STATES, N)).astype(np.float32)
    expert = load_expert(lambda rows: np.tanh(rows[:, :M]))
    number, actions = np.arange(STATES, dtype=np.int32) // 300, expert.ask(observations, "label")
    rewards, ended = np.zeros(STATES), np.zeros(STATES, bool)
    states = Demonstrations(observations, actions, number, number, actions, rewards, ended)
    scales, ones = measure_scales(observations), np.ones(M, np.float32)
    preset = replace(PRESETS["standard"], calibrated=False)
    probes = preset.complete(Probes.parse(spec))
    probes = probes.with_order(1) if probes else None
    answers = None
    if probes is not None:
        around = Surroundings.of(observations, probes, scales)
        answers = ask_probes(expert, around, np.random.default_rng(0))

    def train() -> float:
        start = torch_generator(0, "student")
        student = Student(Mlp((HIDDEN, HIDDEN)), scales.mean, scales.scale, -ones, ones, start)
        begun = time.process_time()
        stored = None if answers is None else lambda sample: answers
        settings = preset.fit_with(steps=STEPS)
        fit(student, states, probes, stored, settings, lambda name: torch_generator(0, name))
        return time.process_time() - begun

    return train


@contextmanager
def _jax() -> Iterator[Callable[[str], float]]:
    """Start JAX's process; it trains when it is told to, and says what that took."""
    sizes = [N, M, HIDDEN, BATCH, STATES, PROBES, STEPS]
    with subprocess.Popen(
        [*command_of(PEER), *map(str, sizes), str(RADIUS)],
        env=variables(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def train(name: str) -> float:
            process.stdin.write(f"{_SHARED.index(name)}\n")
            process.stdin.flush()
            return float(process.stdout.readline())

        try:
            yield train
        finally:
            process.stdin.close()


def text(rows: Sequence[Row]) -> str:
    """One table, with a number of each measurement: medians, and of the ratios in turn."""
    measured = [row["result"]["milliseconds"] for row in rows]
    heads = ["training step", "fdtasil, ms", "JAX, ms", "fdtasil / JAX"]
    return table(heads, [_line(name, measured) for name in OURS])


def _line(name: str, measured: Sequence[dict[str, list[float]]]) -> list[str]:
    ours = [times[f"fdtasil, {name}"] for times in measured]
    theirs = [times[f"JAX, {name}"] for times in measured] if name in _SHARED else []
    pairs = zip(ours, theirs, strict=True) if theirs else ()
    ratios = [[a / b for a, b in zip(*pair, strict=True)] for pair in pairs]
    return [name, *(_medians(times) for times in (ours, theirs, ratios))]


def _medians(measured: Sequence[Sequence[float]]) -> str:
    return ", ".join(f"{statistics.median(one):.2f}" for one in measured) or "-"
