"""Hands a job to a peer's own process, and takes its answer: JSON and arrays, by files."""

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.environment import ROOT, check_peer, python_of

__all__ = ["ask_peer", "command_of", "variables"]

HERE = Path(__file__).parent

Arrays = Mapping[str, np.ndarray]


def ask_peer(name: str, job: Mapping[str, Any], given: Arrays) -> tuple[dict[str, Any], Arrays]:
    """Run a job in a peer's environment, on one thread.

    Args:
        name: Of the peer, whose side of this is the file `NAME_process.py`.
        job: Plain JSON values.
        given: Arrays that the job needs.

    Raises:
        PeerMissing: If its environment is not there.
        RuntimeError: If its process fails, with the end of what it said.
    """
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "job.json").write_text(json.dumps(job))
        np.savez(folder / "given.npz", **given)  # pyright: ignore[reportArgumentType]
        # It works there: do-mpc leaves files where it stands.
        ran = subprocess.run(
            command_of(name), cwd=folder, env=variables(), capture_output=True, text=True
        )
        if ran.returncode:
            raise RuntimeError(f"{name} ended with {ran.returncode}:\n{ran.stderr[-2000:]}")
        with np.load(folder / "found.npz") as found:
            return json.loads((folder / "result.json").read_text()), dict(found)


def command_of(name: str) -> list[str]:
    """Return the command of a peer's process.

    Raises:
        PeerMissing: If its environment is not there.
    """
    check_peer(name)
    # -P: files beside the script must not stand in for packages.
    return [str(python_of(name)), "-P", str(HERE / f"{name}_process.py")]


def variables() -> dict[str, str]:
    """Return a peer's variables of the environment: one thread, and this repository's files."""
    one = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    return {**os.environ, **one, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
