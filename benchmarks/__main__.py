"""`python -m benchmarks list | run NAME | draw NAME`.

A benchmark is a module of this package with a `BENCHMARK`; no other file names it.
"""

import argparse
import pkgutil
import sys
from importlib import import_module
from pathlib import Path

import benchmarks
from benchmarks.runner import (
    BACKENDS,
    FIGURES,
    RESULTS,
    Benchmark,
    due_cells,
    known_results,
    provenance,
    read_rows,
    results_of,
    run,
)
from fdtasil.compute import pick_device
from fdtasil.errors import SettingError
from fdtasil.files.storage import write_bytes


def _found() -> dict[str, Benchmark]:
    """Return the benchmarks of this package by name, in the order of the alphabet."""
    names = sorted(module.name for module in pkgutil.iter_modules(benchmarks.__path__))
    modules = [import_module(f"benchmarks.{name}") for name in names if name != "__main__"]
    held = [module.BENCHMARK for module in modules if hasattr(module, "BENCHMARK")]
    return {benchmark.name: benchmark for benchmark in held}


BENCHMARKS = _found()


def main() -> int:
    """Run the command line; exit code 1 where a cell failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=benchmarks.__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="show the benchmarks, and how much of each is done")
    running = commands.add_parser("run", help="run the cells that have no result yet")
    running.add_argument("name", choices=BENCHMARKS)
    running.add_argument("--quick", action="store_true", help="a smoke run of minutes")
    running.add_argument("--workers", type=int, default=1, help="processes of one thread each")
    running.add_argument("--backend", choices=BACKENDS, default="loky")
    running.add_argument(
        "--device",
        default="cpu",
        help="where students are trained: cpu, cuda; cells that have a result are not run again",
    )
    running.add_argument(
        "--reuse",
        nargs="+",
        choices=BENCHMARKS,
        default=[],
        help="take over equal distillations of these, if run with the versions of here",
    )
    running.add_argument("--out", type=Path, default=RESULTS, help="folder of the results files")
    drawing = commands.add_parser("draw", help="draw the figures and tables of a results file")
    drawing.add_argument("name", choices=BENCHMARKS)
    drawing.add_argument("--results", type=Path, default=RESULTS, help="folder of the results")
    drawing.add_argument("--out", type=Path, default=FIGURES, help="folder of the figures")
    arguments = parser.parse_args()
    if arguments.command == "list":
        return _list()
    benchmark = BENCHMARKS[arguments.name]
    if arguments.command == "draw":
        return _draw(benchmark, arguments.results, arguments.out)
    if arguments.device != "cpu":
        _check_device(arguments.device, arguments.backend, benchmark, parser)
    path = benchmark.results(arguments.out)
    cells = benchmark.cells(arguments.quick)
    failed = run(
        benchmark,
        cells,
        path,
        workers=arguments.workers,
        backend=arguments.backend,
        device=arguments.device,
        known=known_results((BENCHMARKS[name] for name in arguments.reuse), arguments.out),
    )
    print(f"{benchmark.name}: {len(cells)} cells, {len(failed)} failed now; results in {path}")
    return min(len(failed), 1)


def _check_device(
    device: str, backend: str, benchmark: Benchmark, parser: argparse.ArgumentParser
) -> None:
    """End the program where a benchmark can't train there."""
    if backend == "ray":
        parser.error(f"--device {device} beside --backend ray: tasks there ask for a core, no GPU")
    if benchmark.alone:
        parser.error(f"--device {device}: {benchmark.name} says itself what it measures where")
    try:
        pick_device(device)
    except SettingError as error:
        parser.error(str(error))


def _list() -> int:
    for name, benchmark in BENCHMARKS.items():
        cells = benchmark.cells(False)  # of the experts that are here
        done = len(cells) - len(due_cells(cells, benchmark.results(RESULTS)))
        print(f"{name:20}{done:5} of {len(cells):5} cells  {benchmark.about}")
    return 0


def _draw(benchmark: Benchmark, results: Path, out: Path) -> int:
    rows = results_of(read_rows(benchmark.results(results)))
    if not rows:
        print(f"no results of {benchmark.name} in {results}: run it first", file=sys.stderr)
        return 1
    files = benchmark.draw(rows)
    if not files:
        print(f"no part of {benchmark.name} is complete yet: run it on", file=sys.stderr)
        return 1
    for name, data in files.items():
        if name.endswith(".md"):
            data += f"\n{provenance(rows)}\n".encode()
        write_bytes(out / name, data)
        print(out / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
