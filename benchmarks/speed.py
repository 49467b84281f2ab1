"""What a training step, a query and an environment step cost, as ratios to what they must."""

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import torch

from benchmarks.controllers import CONTROLLERS, available
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.tables import table
from fdtasil.compute import torch_settings
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import Answers, ask_probes
from fdtasil.probes.device_twin import DeviceTwin
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import torch_generator
from fdtasil.student.architectures import Mlp
from fdtasil.student.exports import export
from fdtasil.student.fit import Fit, fit
from fdtasil.student.policy import Student

__all__ = ["BENCHMARK"]

SIZES = ((17, 6), (376, 17))
SOURCES = (None, "sphere:10", "sphere:50", "sphere:10,resample", "fresh")
HIDDEN = (512, 256)  # the usual student, and that of an expert that is asked anew
BATCH = 100
STATES = 1500
STEPS = 150
ROUNDS = 7
GPU_ROUNDS = 3
BATCHES = (64, 256, 1024, 4096)
TOGETHER = 512  # environments in one vector environment


def cells(quick: bool) -> list[Cell]:
    """One cell for each size of a step, each expert that is asked, each environment stepped."""
    kinds = ["step", "step on a GPU"] if torch.cuda.is_available() else ["step"]
    found: list[Cell] = [
        {"what": what, "size": list(size), "hidden": hidden}
        for what in kinds
        for size in SIZES
        for hidden in HIDDEN
    ]
    experts = [name for name in available() if not name.startswith("paper/")]
    if quick:
        experts = experts[:1]
    found += [{"what": "asking", "expert": name} for name in experts]
    found += [{"what": "stepping", "expert": name} for name in experts]
    return [*found, {"what": "stepping together", "expert": experts[0], "count": TOGETHER}]


def measure(cell: Cell, device: str) -> dict[str, Any]:
    """Measure one cell, on one thread; what is measured says where it runs, not `device`."""
    with torch_settings(torch.device("cpu")):
        return _MEASURES[cell["what"]](cell)


def _step(cell: Cell) -> dict[str, Any]:
    """Milliseconds of a step without and with probes, taken in turn, and of the floor."""
    n, m, hidden = *cell["size"], cell["hidden"]
    tasks = {source: _task(n, m, hidden, source) for source in SOURCES}
    times: dict[str, list[float]] = {str(source): [] for source in SOURCES}
    times["floor"] = []
    for task in tasks.values():  # the first run of a process pays for what later ones find done
        task()
    for _ in range(ROUNDS):
        for source, task in tasks.items():
            times[str(source)].append(_seconds(task) / STEPS * 1e3)
        times["floor"].append(_floor(n, m, hidden) * 1e3)
    return {"milliseconds": times}


def _step_on_a_gpu(cell: Cell) -> dict[str, Any]:
    """Milliseconds of a step on the CPU and on the GPU, there of a whole training."""
    n, m, hidden = *cell["size"], cell["hidden"]
    tasks = {
        f"{source}, {device}": (_task(n, m, hidden, source, device, steps), steps)
        for source in SOURCES
        for device, steps in (("cpu", STEPS), ("cuda", Fit().schedule().total_steps(STATES)))
    }
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for task, _ in tasks.values():
        task()
    for _ in range(GPU_ROUNDS):
        for name, (task, steps) in tasks.items():
            times[name].append(_seconds(task) / steps * 1e3)
    return {"milliseconds": times, "gpu": torch.cuda.get_device_name()}


def _task(
    n: int, m: int, hidden: int, spec: str | None, device: str = "cpu", steps: int = STEPS
) -> Callable[[], object]:
    random = np.random.default_rng(0)
    observations = random.standard_normal((STATES, n)).astype(np.float32)
    expert = _expert(n, m, observations)
    number, actions = np.arange(STATES, dtype=np.int32) // 300, expert.ask(observations, "label")
    demonstrations = Demonstrations(
        observations, actions, number, number, actions, np.zeros(STATES), number > 9
    )
    preset = replace(PRESETS["standard"], calibrated=False)
    probes = preset.complete(Probes.parse(spec))
    probes = probes.with_order(1) if probes else None
    scales, settings = measure_scales(observations), preset.fit_with(steps=steps)
    ones = np.ones(m, np.float32)
    around = Surroundings.of(observations, probes, scales) if probes else None
    # Stored answers are asked once for a whole training, of which this is a short piece.
    stored = ask_probes(expert, around, np.random.default_rng(0)) if around else None
    twin = None
    if device == "cuda" and around and stored:
        twin = DeviceTwin.of(expert, around, stored, torch.device(device))

    def run() -> None:
        start = torch_generator(0, "student")
        student = Student(Mlp((hidden, hidden)), scales.mean, scales.scale, -ones, ones, start)
        fit(student.to(device), demonstrations, probes, ask if probes else None, settings, stream)

    def ask(sample: int) -> Answers:
        assert around is not None, "asked only with probes"
        assert stored is not None
        random, asked = np.random.default_rng(sample), twin and twin.values
        return ask_probes(expert, around, random, asked=asked) if sample else stored

    def stream(name: str) -> torch.Generator:
        return torch_generator(0, name)

    return run


def _expert(n: int, m: int, observations: np.ndarray) -> Expert:
    """Return an ONNX file of the usual size of an agent, 256 x 256, with weights by chance."""
    zeros, ones, bounds = np.zeros(n), np.ones(n), np.ones(m, np.float32)
    network = Student(Mlp((256, 256)), zeros, ones, -bounds, bounds, torch_generator(1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "expert.onnx"
        path.write_bytes(export(network, observations, {}, path))
        return load_expert(path)


def _floor(n: int, m: int, hidden: int) -> float:
    """Seconds that the products and the optimiser's traffic of a plain step take at best."""
    weights = n * hidden + hidden * hidden + hidden * m
    # Forward, gradients of the weights, gradients of the inputs of all layers but the first.
    products = 2 * BATCH * (3 * weights - n * hidden)
    # AdamW reads weights, gradients and two moments, and writes all but the gradients.
    traffic = 7 * 4 * weights
    left, right = torch.randn(1024, 1024), torch.randn(1024, 1024)
    rate = 2 * 1024**3 / min(_seconds(lambda: left @ right) for _ in range(5))
    source, target = torch.randn(weights), torch.empty(weights)
    memory = 8 * weights / min(_seconds(lambda: target.copy_(source)) for _ in range(20))
    return products / rate + traffic / memory


def _asking(cell: Cell) -> dict[str, Any]:
    """Rows a second through `Expert.ask`, and of the bare session at its best batch."""
    path = _path(cell)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    name, expert = session.get_inputs()[0].name, load_expert(path)
    assert expert.observation_size is not None
    rows = np.random.default_rng(0).standard_normal((16384, expert.observation_size))
    rows = rows.astype(np.float32)
    ours, bare = [], []

    def whole(batch: int) -> None:
        for start in range(0, len(rows), batch):
            session.run(None, {name: rows[start : start + batch]})

    for _ in range(ROUNDS):
        ours.append(len(rows) / _seconds(lambda: expert.ask(rows, "probe")))
        bare.append(len(rows) / min(_seconds(lambda b=b: whole(b)) for b in BATCHES))
    return {"rows_per_second": {"ours": ours, "bare": bare}}


def _stepping(cell: Cell) -> dict[str, Any]:
    """Seconds of a rollout of 25 episodes of 100 steps, and of the bare environment's steps."""
    ours, bare = [], []
    with EnvironmentPool(cell["expert"]) as pool:
        expert = load_expert(_path(cell))
        seeds = list(range(25))
        actions = rollout(follow(expert.policy("act")), pool, seeds, 100).actions
        environment = gymnasium.make(cell["expert"])
        for _ in range(ROUNDS):
            bare.append(_seconds(lambda: _bare(environment, actions)))
            ours.append(_seconds(lambda: rollout(follow(expert.policy("act")), pool, seeds, 100)))
        environment.close()
    return {"seconds": {"ours": ours, "bare": bare}}


def _stepping_together(cell: Cell) -> dict[str, Any]:
    """Seconds of a rollout of an episode in each of many environments, and of their steps."""
    count, ours, bare = cell["count"], [], []
    vector = gymnasium.make_vec(cell["expert"], count, vectorization_mode="sync")
    seeds = list(range(count))
    with EnvironmentPool(vector) as pool:
        act = np.zeros((1, pool.boxes.action_size), np.float32)
        idle = follow(lambda rows: np.repeat(act, len(rows), axis=0))
        still = np.repeat(act, count, axis=0)
        for _ in range(ROUNDS):
            bare.append(_seconds(lambda: _bare_together(vector, seeds, still)))
            ours.append(_seconds(lambda: rollout(idle, pool, seeds, 20)))
    vector.close()
    return {"seconds": {"ours": ours, "bare": bare}}


def _bare_together(vector: gymnasium.vector.VectorEnv, seeds: list[int], still: Any) -> None:
    vector.reset(seed=seeds)  # pyright: ignore[reportArgumentType]
    for _ in range(20):
        vector.step(still)


def _bare(environment: gymnasium.Env, actions: np.ndarray) -> None:
    for episode, sequence in enumerate(actions):
        environment.reset(seed=episode)
        for action in sequence:
            if environment.step(action)[2]:
                break


def _path(cell: Cell) -> str:
    return str(CONTROLLERS[cell["expert"]].path)


def _seconds(function: Callable[[], object]) -> float:
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


_MEASURES = {
    "step": _step,
    "step on a GPU": _step_on_a_gpu,
    "asking": _asking,
    "stepping": _stepping,
    "stepping together": _stepping_together,
}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table of ratios, each pair by pair: minimum and median."""
    lines: list[list[str]] = []
    for row in rows:
        cell, result = row["cell"], row["result"]
        if cell["what"] == "step":
            times, name = result["milliseconds"], _network(cell)
            for source in (str(source) for source in SOURCES[1:]):
                lines.append(
                    _line(f"step, {source}, {name}", "plain", times[source], times["None"])
                )
            lines.append(_line(f"plain step, {name}", "floor", times["None"], times["floor"]))
        elif cell["what"] == "step on a GPU":
            times, name = result["milliseconds"], f"{_network(cell)}, {result['gpu']}"
            # Rows of the H100 are older than fresh queries.
            for source in (source for source in map(str, SOURCES) if f"{source}, cuda" in times):
                what = f"step, {source.replace('None', 'plain')}, {name}"
                lines.append(_line(what, "CPU", times[f"{source}, cuda"], times[f"{source}, cpu"]))
            if (fresh := times.get("fresh, cuda")) is not None:
                stored = times["sphere:10, cuda"]
                lines.append(_line(f"step, fresh, {name}", "sphere:10", fresh, stored))
        elif cell["what"] == "asking":
            rates = result["rows_per_second"]
            lines.append(_line(f"rows, {cell['expert']}", "session", rates["ours"], rates["bare"]))
        else:
            times, count = result["seconds"], cell.get("count", 1)
            what = f"rollout, {cell['expert']}" + f", {count} together" * (count > 1)
            lines.append(_line(what, "env.step", times["ours"], times["bare"]))
    text = table(["what", "of", "ratio, minimum", "median"], lines)
    return {"speed.md": f"{text}\nOne thread.\n".encode()}


def _network(cell: Cell) -> str:
    return "{}/{}".format(*cell["size"]) + f", {cell['hidden']} wide"


def _line(what: str, of: str, ours: Sequence[float], theirs: Sequence[float]) -> list[str]:
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    return [what, of, f"{min(ratios):.2f}", f"{statistics.median(ratios):.2f}"]


BENCHMARK = Benchmark("speed", __doc__ or "", cells, measure, draw, alone=True)
