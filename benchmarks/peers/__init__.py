"""Other packages for the same purpose, measured beside this one.

    python -m benchmarks.peers.environment    # once: minutes, and some gigabytes
    python -m benchmarks run peers

Each peer runs as a process in an environment of its own. Nothing of it is imported here.
"""

from benchmarks.peers.benchmark import cells, draw, run
from benchmarks.runner import Benchmark

__all__ = ["BENCHMARK"]

BENCHMARK = Benchmark("peers", __doc__.splitlines()[0], cells, run, draw, alone=True)
