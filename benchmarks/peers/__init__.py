"""Other packages for the same purpose, measured beside this one.

    python -m benchmarks.peers    # once: makes the environments, some gigabytes
    python -m benchmarks run peers

Each peer runs as a process in an environment of its own, in `.peers/` or the folder that
FDTASIL_PEERS names. Nothing of it is imported here. All seconds are the processor's.
"""

from benchmarks.peers.benchmark import cells, draw, run
from benchmarks.runner import Benchmark

__all__ = ["BENCHMARK"]

BENCHMARK = Benchmark("peers", __doc__.splitlines()[0], cells, run, draw, alone=True)
