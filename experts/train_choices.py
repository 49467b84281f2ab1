"""Train an agent that chooses among actions with stable-baselines3, and keep its best zip.

    python experts/train_choices.py LunarLander-v3 PPO --out runs/experts/LunarLander-v3-PPO
    python experts/ship.py runs/experts/LunarLander-v3-PPO/best.zip \
        --environment LunarLander-v3 --name LunarLander-v3-PPO --steps 1000000

Ten evaluations on the way, of 20 episodes each; the folder holds `best.zip` and `training.json`.
LunarLander needs `pip install "gymnasium[box2d]"`. Minutes on one core, so it does not resume.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

ALGORITHMS = {"PPO": PPO, "DQN": DQN}
EVALUATIONS, EPISODES, FIRST_SEED = 10, 20, 1000

# Steps, environments and settings, those of rl-baselines3-zoo; what is not named is the
# library's default.
RECIPES: dict[tuple[str, str], tuple[int, int, dict[str, Any]]] = {
    ("CartPole-v1", "PPO"): (
        100_000,
        8,
        {
            "n_steps": 32,
            "batch_size": 256,
            "gae_lambda": 0.8,
            "gamma": 0.98,
            "n_epochs": 20,
            "learning_rate": lambda left: 1e-3 * left,
            "clip_range": lambda left: 0.2 * left,
        },
    ),
    ("CartPole-v1", "DQN"): (
        50_000,
        1,
        {
            "learning_rate": 2.3e-3,
            "batch_size": 64,
            "buffer_size": 100_000,
            "learning_starts": 1000,
            "target_update_interval": 10,
            "train_freq": 256,
            "gradient_steps": 128,
            "exploration_fraction": 0.16,
            "exploration_final_eps": 0.04,
            "policy_kwargs": {"net_arch": [256, 256]},
        },
    ),
    ("LunarLander-v3", "PPO"): (
        1_000_000,
        16,
        {
            "n_steps": 1024,
            "batch_size": 64,
            "gae_lambda": 0.98,
            "gamma": 0.999,
            "n_epochs": 4,
            "ent_coef": 0.01,
        },
    ),
    ("LunarLander-v3", "DQN"): (
        300_000,
        1,
        {
            "learning_rate": 6.3e-4,
            "batch_size": 128,
            "buffer_size": 50_000,
            "learning_starts": 0,
            "target_update_interval": 250,
            "gradient_steps": -1,
            "exploration_fraction": 0.12,
            "exploration_final_eps": 0.1,
            "policy_kwargs": {"net_arch": [256, 256]},
        },
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("environment", choices=sorted({name for name, _ in RECIPES}))
    parser.add_argument("algorithm", choices=ALGORITHMS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    name, out = arguments.environment, arguments.out
    steps, count, settings = RECIPES[name, arguments.algorithm]
    out.mkdir(parents=True, exist_ok=True)
    model = ALGORITHMS[arguments.algorithm](
        "MlpPolicy",
        make_vec_env(name, count, seed=arguments.seed),
        seed=arguments.seed,
        device="cpu",
        **settings,
    )
    history: list[dict[str, float]] = []
    for part in range(EVALUATIONS):
        model.learn(steps // EVALUATIONS, reset_num_timesteps=part == 0)
        mean, std = evaluate_policy(model, make_vec_env(name, 1, seed=FIRST_SEED), EPISODES)
        if mean > max((entry["mean"] for entry in history), default=-float("inf")):
            model.save(out / "best.zip")
        history.append({"steps": model.num_timesteps, "mean": float(mean), "std": float(std)})
        print(f"{name} {arguments.algorithm} {history[-1]}", flush=True)
        (out / "training.json").write_text(json.dumps(history, indent=1) + "\n")


if __name__ == "__main__":
    main()
