"""Train an agent with an LSTM on a pendulum whose speed nobody sees, by RecurrentPPO.

    python experts/train_memory.py --out runs/experts/hidden

An evaluation after every 10,000 steps, of 10 episodes; the best is kept as `best.zip`, which is
shipped as InvertedPendulum-v5-hidden.zip. About ten minutes on one core, so it does not resume.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import json
import sys
from pathlib import Path

import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

sys.path.insert(0, str(Path(__file__).parent.parent))

from benchmarks.memory import Hidden

STEPS, INTERVAL, ENOUGH = 200_000, 10_000, 999


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    model = RecurrentPPO(
        "MlpLstmPolicy",
        make_vec_env(Hidden, 8, seed=0),
        n_steps=128,
        batch_size=256,
        n_epochs=10,
        gae_lambda=0.95,
        gamma=0.99,
        learning_rate=lambda left: 1e-3 * left,
        policy_kwargs={"lstm_hidden_size": 32, "net_arch": [32]},
        seed=0,
        device="cpu",
    )
    history: list[dict[str, float]] = []
    while len(history) < STEPS // INTERVAL and (not history or history[-1]["mean"] < ENOUGH):
        model.learn(INTERVAL, reset_num_timesteps=not history)
        mean, std = evaluate_policy(model, make_vec_env(Hidden, 1, seed=1000), 10)
        if mean > max((entry["mean"] for entry in history), default=-1.0):
            model.save(out / "best.zip")
        history.append({"steps": model.num_timesteps, "mean": float(mean), "std": float(std)})
        print(history[-1], flush=True)
        (out / "training.json").write_text(json.dumps(history, indent=1) + "\n")


if __name__ == "__main__":
    main()
