"""Turn a trained agent into a shipped expert: ONNX file, measured returns, manifest entry.

    python experts/ship.py runs/experts/HalfCheetah-v5
    python experts/ship.py Walker2d-v5.zip --environment Walker2d-v5 --steps 550000
    python experts/ship.py best.zip --environment CartPole-v1 --name CartPole-v1-PPO --steps 100000

The source is a folder of train.py, or a stable-baselines3 zip (read without unpickling).
"""

import argparse
import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import torch
from actor import load_actor
from measure import EPISODES, HERE, HORIZONS, MANIFEST, measure

from fdtasil.experts.sb3.agent import read_agent
from fdtasil.files.onnx.export import export_module
from fdtasil.files.storage import sha256, write_bytes
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds


class ActorModule(torch.nn.Module):
    """The actor of actor.py in torch: (B, n) raw observations -> (B, m) actions."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        for name, array in vars(load_actor(path)).items():
            self.register_buffer(name, torch.from_numpy(array))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """See `Actor` in actor.py."""
        hidden = torch.relu(torch.nn.functional.linear(observations, self.w0, self.b0))
        hidden = torch.relu(torch.nn.functional.linear(hidden, self.w1, self.b1))
        squashed = torch.tanh(torch.nn.functional.linear(hidden, self.w_mean, self.b_mean))
        return self.low + (squashed + 1) / 2 * (self.high - self.low)


def from_folder(folder: Path) -> tuple[torch.nn.Module, dict[str, Any]]:
    """Return the best actor of a training, and what the manifest says of it."""
    training = json.loads((folder / "training.json").read_text())
    return ActorModule(folder / "actor.npz"), {
        "environment": training["environment"],
        "algorithm": f"{training['algorithm']} ({training['library']})",
        "steps": training["best_evaluation"]["steps"],
        "seed": training["seed"],
        "settings": {k: v for k, v in training["settings"].items() if v is not None},
        "versions": training["versions"],
    }


def from_zip(path: Path, environment: str, steps: int) -> tuple[torch.nn.Module, dict[str, Any]]:
    """Return the policy of a stable-baselines3 zip, and what the manifest says of it."""
    agent = read_agent(path)
    return agent.module, {
        "environment": environment,
        "algorithm": f"{agent.algorithm} (stable-baselines3)",
        "steps": steps,
        "source_sha256": agent.sha256,
    }


def visited_states(module: torch.nn.Module, environment: str) -> torch.Tensor:
    """Return states of three short episodes, which the export is compared on."""

    def act(observations):
        with torch.no_grad():
            return module(torch.from_numpy(observations)).numpy()

    with EnvironmentPool(environment) as pool:
        episodes = rollout(follow(act), pool, episode_seeds(0, "export", 0, 3), 300)
    return episodes.observations[episodes.valid]


def write_manifest(entries: dict[str, dict[str, Any]]) -> None:
    """Write the manifest; values are texts, numbers, and tables of them."""

    def lines(prefix: str, table: dict[str, Any]) -> list[str]:
        plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
        found = [f"{key} = {json.dumps(value)}" for key, value in plain.items()]
        found = [f"[{prefix}]", *found] if plain else []
        for key, value in table.items():
            if isinstance(value, dict):
                found += lines(f"{prefix}.{key}", value)
        return found

    head = "# The shipped experts. Returns: 100 episodes each, measured by ship.py; `python\n"
    head += "# experts/measure.py` measures them again. Licence of all: MIT, as the project's.\n"
    parts = ["\n".join(lines(name, entry)) for name, entry in sorted(entries.items())]
    write_bytes(MANIFEST, (head + "\n" + "\n\n".join(parts) + "\n").encode())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("--environment", help="of a zip, which does not say")
    parser.add_argument("--steps", type=int, help="environment steps that a zip was trained for")
    parser.add_argument("--name", help="of the expert; left out, the environment's")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    source = arguments.source
    if source.is_dir():
        module, entry = from_folder(source)
    else:
        module, entry = from_zip(source, arguments.environment, arguments.steps)
    environment = entry["environment"]
    name = arguments.name or environment
    data = export_module(module, visited_states(module, environment), {"environment": environment})
    write_bytes(HERE / f"{name}.onnx", data)
    if (source / "curve.png").exists():
        shutil.copy(source / "curve.png", HERE / f"{name}.png")
    entry |= {"file": f"{name}.onnx", "sha256": sha256(data), "licence": "MIT"}
    entry["returns"] = {
        str(horizon): measure(HERE / entry["file"], environment, horizon, seed=0)
        for horizon in HORIZONS
    }
    entries = tomllib.loads(MANIFEST.read_text()) if MANIFEST.exists() else {}
    write_manifest(entries | {name: entry})
    print(f"{name}: {entry['returns']} over {EPISODES} episodes, {len(data):,} bytes")


if __name__ == "__main__":
    main()
