"""The environments that the peers run in: where they are, and what they hold.

What a peer needs would hold this project's own packages back, so each has one of its own.
"""

import os
from pathlib import Path

__all__ = ["FOLDER", "PEERS", "ROOT", "PeerMissing", "check_peer", "python_of"]

ROOT = Path(__file__).parent.parent.parent
FOLDER = Path(os.environ.get("FDTASIL_PEERS", ROOT / ".peers"))

PEERS: dict[str, tuple[list[str], ...]] = {
    # imitation asks for gymnasium 0.29, which has none of the experts' environments. It runs on
    # the newer packages all the same, so it is put beside them without what it asks for.
    "imitation": (
        ["torch", "stable-baselines3", "gymnasium[mujoco]", "onnxruntime"],
        ["datasets", "jsonpickle", "rich", "tensorboard", "tqdm"],
        ["--no-deps", "huggingface-sb3==3.0", "imitation==1.0.1"],
    ),
    "do_mpc": (["torch", "casadi", "gymnasium", "do-mpc==5.1.2"],),
    "jax": (["jax==0.10.2", "optax==0.2.8"],),
}
"""By name: what pip installs, one call after another."""


class PeerMissing(RuntimeError):
    """A peer's environment is not there."""


def python_of(name: str) -> Path:
    """Return where the interpreter of a peer's environment is, made or not."""
    inside = "Scripts/python.exe" if os.name == "nt" else "bin/python"
    return FOLDER / name / inside


def check_peer(name: str) -> None:
    """Say what to do where a peer's environment is not there.

    Raises:
        PeerMissing: If it is not.
    """
    if not (FOLDER / name / "ready").exists():
        raise PeerMissing(
            f"no environment of {name} in {FOLDER}; make it: python -m benchmarks.peers {name}"
        )
