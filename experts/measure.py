"""Measure the returns of the shipped experts, and hold them against the manifest.

    python experts/measure.py                  all of them
    python experts/measure.py HalfCheetah-v5   one

Prints one line for each expert and horizon: what the manifest says, what was measured just now
over 100 episodes, and whether the two agree within four standard errors of their difference.
"""

import argparse
import math
import sys
import tomllib
from pathlib import Path

import torch

from fdtasil.experts.load import expert_in
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds

HERE = Path(__file__).parent
MANIFEST = HERE / "MANIFEST.toml"
HORIZONS = (300, 1000)
EPISODES = 100


def measure(path: Path, environment: str, horizon: int, seed: int) -> dict[str, float]:
    """Return mean and deviation of 100 returns, and the share of episodes that did not fall."""
    with EnvironmentPool(environment) as pool:
        expert = expert_in(path, pool)
        seeds = episode_seeds(seed, "measure", 0, EPISODES)
        episodes = rollout(follow(expert.policy("evaluate")), pool, seeds, horizon)
    return {
        "mean": round(float(episodes.returns.mean()), 2),
        "std": round(float(episodes.returns.std()), 2),
        "survival": round(float(1 - episodes.terminated.mean()), 3),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("experts", nargs="*", help="names in the manifest; all by default")
    parser.add_argument("--seed", type=int, default=1, help="the manifest was measured with 0")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    manifest, disagreements = tomllib.loads(MANIFEST.read_text()), 0
    for name in arguments.experts or manifest:
        entry = manifest[name]
        for horizon in HORIZONS:
            stated = entry["returns"][str(horizon)]
            found = measure(HERE / entry["file"], entry["environment"], horizon, arguments.seed)
            error = math.hypot(stated["std"], found["std"]) / EPISODES**0.5
            agrees = abs(stated["mean"] - found["mean"]) <= 4 * error
            disagreements += not agrees
            print(
                f"{name:28} T={horizon:<5} manifest {stated['mean']:9.1f}  "
                f"measured {found['mean']:9.1f} +- {found['std']:<7.1f} "
                f"survival {found['survival']:.2f}  {'ok' if agrees else 'DIFFERS'}",
                flush=True,
            )
    return min(disagreements, 1)


if __name__ == "__main__":
    sys.exit(main())
