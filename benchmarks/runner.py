"""Runs the cells of a benchmark: what is done is skipped, what fails is kept and shown."""

import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed, parallel_config
from tqdm import tqdm

from fdtasil.run.report import versions

__all__ = [
    "BACKENDS",
    "Benchmark",
    "Cell",
    "Row",
    "due_cells",
    "known_results",
    "provenance",
    "read_rows",
    "results_of",
    "run",
]

HERE = Path(__file__).parent
RESULTS = HERE / "results"
FIGURES = HERE / "figures"

Cell = Mapping[str, Any]
"""One configuration with one seed, as plain JSON values; the row of a cell is found by it."""
Row = Mapping[str, Any]
"""`cell`, `result` or `error`, `seconds`, `versions`, `commit`, `machine`; `from`, the benchmark
whose cell it was, where another one has run it."""


@dataclass(frozen=True)
class Benchmark:
    """One figure or table.

    Attributes:
        name: Of the results file and the command.
        about: What it shows, in one sentence.
        cells: Whether to be quick -> the cells, the most telling first.
        run: A cell, and the device to train on -> its result, as plain JSON values. Runs in a
            process of one thread.
        draw: The rows that have a result -> files by name, for the folder of figures.
        alone: Whether a cell measures time, and must not run beside another.
        arguments: A cell -> the arguments of the distillation that it is. Benchmarks share the
            results of equal ones. None where a cell is something else.
    """

    name: str
    about: str
    cells: Callable[[bool], Sequence[Cell]]
    run: Callable[[Cell, str], dict[str, Any]]
    draw: Callable[[Sequence[Row]], Mapping[str, bytes]]
    alone: bool = False
    arguments: Callable[[Cell], Mapping[str, Any]] | None = None

    def results(self, folder: Path) -> Path:
        """Return the results file in a folder."""
        return folder / f"{self.name}.jsonl"


def run(
    benchmark: Benchmark,
    cells: Sequence[Cell],
    path: Path,
    *,
    workers: int = 1,
    backend: str = "loky",
    device: str = "cpu",
    known: Mapping[str, Row] | None = None,
) -> list[Row]:
    """Run the cells that have no result yet, and append their rows to the results file.

    Args:
        benchmark: What is run.
        cells: Which cells; one that has a result, from whichever machine, is not run again.
        path: The results file, one JSON object a line; made if it is not there.
        workers: Processes at once, one thread each.
        backend: One of `BACKENDS`.
        device: Where students are trained; processes share a GPU.
        known: From `known_results`: rows of other benchmarks, taken over where the arguments
            and the versions are the same. Each keeps its machine and commit: that the library
            still does the same is the caller's to know.

    Returns:
        The rows of those cells that failed now.
    """
    due = due_cells(cells, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.read_text().endswith("\n"):
        with path.open("a") as file:
            file.write("\n")  # a kill cut the last line short: leave it to itself
    about = {"commit": _commit(), "versions": versions()}
    reused = _reused(benchmark, due, known or {}, about["versions"])
    due = [cell for cell in due if _key(cell) not in reused]
    failed = []
    with path.open("a") as file:
        file.writelines(json.dumps(row) + "\n" for row in reused.values())
        file.flush()
        job = partial(_timed, benchmark.run, device)
        rows = BACKENDS[backend](job, due, 1 if benchmark.alone else workers)
        for row in tqdm(rows, total=len(due), desc=benchmark.name, unit="cell", mininterval=5):
            # The parent alone writes, whole lines at once: a kill loses the cells under way.
            file.write(json.dumps({**row, **about}) + "\n")
            file.flush()
            if "error" in row:
                failed.append(row)
                tqdm.write(f"FAILED {json.dumps(row['cell'])}\n{row['error']}", file=sys.stderr)
    return failed


def due_cells(cells: Sequence[Cell], path: Path) -> list[Cell]:
    """Return those cells that have no result in a results file."""
    done = {_key(row["cell"]) for row in read_rows(path) if "result" in row}
    return [cell for cell in cells if _key(cell) not in done]


def known_results(benchmarks: Iterable[Benchmark], folder: Path) -> dict[str, Row]:
    """Return the rows of distillations by their arguments, whichever benchmark ran them.

    Args:
        benchmarks: Whose results are looked at.
        folder: Of the results files.
    """
    found: dict[str, Row] = {}
    for benchmark in benchmarks:
        if benchmark.arguments is None:
            continue
        rows = {_key(row["cell"]): row for row in results_of(read_rows(benchmark.results(folder)))}
        for cell in benchmark.cells(False):
            if (row := rows.get(_key(cell))) is not None:
                found[_key(benchmark.arguments(cell))] = {"from": benchmark.name, **row}
    return found


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a results file, without a last line that a kill cut short."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def results_of(rows: Iterable[Row]) -> list[Row]:
    """Return the newest row with a result of each cell."""
    return list({_key(row["cell"]): row for row in rows if "result" in row}.values())


def provenance(rows: Iterable[Row]) -> str:
    """Return, in a sentence, on which machines and at which commits rows were made."""
    made = sorted({(row["machine"], row["commit"] or "no commit") for row in rows})
    parts = (
        f"{machine} ({', '.join(commit for other, commit in made if other == machine)})"
        for machine in dict.fromkeys(machine for machine, _ in made)
    )
    return f"Made on {'; '.join(parts)}."


def _reused(
    benchmark: Benchmark,
    cells: Sequence[Cell],
    known: Mapping[str, Row],
    here: Mapping[str, str],
) -> dict[str, Row]:
    """Return the rows of those cells that another benchmark has run with these versions."""
    if benchmark.arguments is None:
        return {}
    return {
        _key(cell): {**row, "cell": dict(cell)}
        for cell in cells
        if (row := known.get(_key(benchmark.arguments(cell)))) is not None
        and row["versions"] == here
    }


def _on_loky(job: Callable[[Cell], Row], cells: Sequence[Cell], workers: int) -> Iterable[Row]:
    if workers == 1:
        return map(job, cells)
    jobs = (delayed(job)(cell) for cell in cells)
    with parallel_config(backend="loky", inner_max_num_threads=1):
        return Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)(jobs)


def _on_ray(job: Callable[[Cell], Row], cells: Sequence[Cell], workers: int) -> Iterator[Row]:
    """Run each cell as a task of one core; the cluster says how many run at once.

    joblib's Ray backend gives no result before the last one is there: a killed sweep would lose
    everything.
    """
    import ray

    if not ray.is_initialized():
        # Variables of the environment, not arguments, reach numpy and torch before they load.
        variables = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(HERE.parent)}
        ray.init(runtime_env={"env_vars": variables}, log_to_driver=False)
    task = ray.remote(num_cpus=1)(lambda cell: job(cell))
    under_way = {task.remote(cell): cell for cell in cells}
    while under_way:
        (ready,), _ = ray.wait(list(under_way), num_returns=1)
        cell = under_way.pop(ready)
        try:
            yield ray.get(ready)
        except ray.exceptions.RayError as error:  # the worker died, not the cell's own code
            yield {"cell": dict(cell), "error": str(error), "seconds": 0.0, "machine": "lost"}


BACKENDS = {"loky": _on_loky, "ray": _on_ray}
"""Where cells run: processes of this machine, or a Ray cluster (RAY_ADDRESS, or a local one)."""


def _timed(function: Callable[[Cell, str], dict[str, Any]], device: str, cell: Cell) -> Row:
    # Several processes of several threads each are many times slower than of one each.
    os.environ["OMP_NUM_THREADS"] = "1"
    started = time.perf_counter()
    try:
        outcome: dict[str, Any] = {"result": function(cell, device)}
    except Exception:  # one failed cell must not stop the others; it is kept and shown
        outcome = {"error": traceback.format_exc(limit=-4)}
    seconds = round(time.perf_counter() - started, 2)
    return {"cell": dict(cell), **outcome, "seconds": seconds, "machine": _machine(device)}


def _key(cell: Cell) -> str:
    return json.dumps(cell, sort_keys=True)


def _machine(device: str) -> str:
    """Return what bytes depend on: one name of a processor stands for several generations."""
    model, cpuinfo = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        said = {
            key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)
        }
        model = said.get("model name", model)
        if "cpu family" in said:
            vectors = "AVX-512" if "avx512f" in said["flags"] else "no AVX-512"
            model += f" (family {said['cpu family']}, model {said['model']}, {vectors})"
    names = [model, f"{os.cpu_count()} cores"]
    if device != "cpu":
        names.append(torch.cuda.get_device_name(device))
    return ", ".join(names)


def _commit() -> str | None:
    """Return the commit of the code, "-dirty" where that was changed; rows are no code."""
    commit = _git("describe", "--always")
    changed = _git("status", "--porcelain", "--untracked-files=no", ":/", f":(exclude){RESULTS}")
    return f"{commit}-dirty" if commit and changed else commit or None


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True).stdout.strip()
