"""Train an expert controller with SAC or TQC, resumably, and write its actor as plain arrays.

    python experts/train.py HalfCheetah-v5 --out runs/experts/HalfCheetah-v5

The output folder then holds

    actor.npz         the best deterministic actor (layout: class `Actor` in actor.py)
    training.json     what produced it: library, versions, settings, seed, steps, evaluations
    evaluations.csv   one row per evaluation, and curve.png, the same drawn
    best.zip          the whole best agent as its library saves it (critics included)
    checkpoint-*/     the newest state, with replay/: the transitions, one file per interval

Running the same command again continues from the newest checkpoint, also after `kill -9`: every
file gets its final name only once it is complete, so at most one interval of training is lost.
A larger --steps continues a finished run.
"""

import os

# One thread: on so small networks more threads cost up to 28 times the work they share out. The
# libraries read these when they are imported, hence before the imports.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import argparse
import contextlib
import csv
import json
import math
import shutil
import time
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from actor import check_actor, evaluate, extract_actor, load_actor, save_actor
from gymnasium.wrappers import DtypeObservation
from matplotlib.figure import Figure
from stable_baselines3.common.env_util import make_vec_env
from tqdm import tqdm


@dataclass(frozen=True)
class Recipe:
    """The settings of one environment; everything not named here is the library's default."""

    target: float  # return at T=1000 that makes a usable expert (for the curve and the record)
    steps: int = 1_000_000
    stop_return: float | None = None  # an evaluation this good ends the training early
    gamma: float = 0.99
    # One update per transition; 8 environments stepped together spread the cost of each call, and
    # batches of 128 (256 is the default) double the updates a second: 420 steps/s on one core.
    environments: int = 8
    gradient_steps: int = 8
    batch_size: int = 128
    learning_starts: int = 10_000
    interval: int = 25_000  # steps between two evaluations, each followed by a checkpoint
    library: str = "sbx"
    algorithm: str = "SAC"


RECIPES = {
    "HalfCheetah-v5": Recipe(target=8000),
    "Walker2d-v5": Recipe(target=4000),
    # With gamma 0.99 Swimmer stays near 50: a stroke pays only well after it is made.
    "Swimmer-v5": Recipe(target=300, gamma=0.9999, steps=500_000),
    # TQC's actor is SAC's; its quantile critics reach the same return in fewer steps.
    "Ant-v5": Recipe(target=4000, algorithm="TQC"),
    "Humanoid-v5": Recipe(target=5000, algorithm="TQC"),
    # An arm that is told where to go: the goal is part of the observation, and stands still.
    "Reacher-v5": Recipe(target=-4, steps=200_000, learning_starts=2_000, interval=10_000),
    # Tiny, for tests: minutes to the best possible return, about 9360.
    "InvertedDoublePendulum-v5": Recipe(
        target=9300, stop_return=9300, steps=100_000, learning_starts=1_000, interval=2_500
    ),
}

BUFFER_FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
EVALUATION_SEED = 10_000
FINAL_EVALUATION_SEED = 20_000  # other episodes than those the best actor was chosen on
PACKAGES = ("stable-baselines3", "sbx-rl", "torch", "jax", "gymnasium", "mujoco", "numpy")


def load_algorithm(recipe):
    """The class that trains; sbx is imported only when asked for, it needs jax."""
    module = {
        "sbx": "sbx",
        "sb3": "sb3_contrib" if recipe.algorithm == "TQC" else "stable_baselines3",
    }
    return getattr(import_module(module[recipe.library]), recipe.algorithm)


def make_environments(environment_id, recipe, seed):
    # float32 observations halve the replay buffer; the networks compute in float32 anyway.
    return make_vec_env(
        environment_id,
        n_envs=recipe.environments,
        seed=seed,
        wrapper_class=DtypeObservation,
        wrapper_kwargs={"dtype": np.float32},
    )


def new_model(environment_id, recipe, seed):
    return load_algorithm(recipe)(
        "MlpPolicy",
        make_environments(environment_id, recipe, seed),
        seed=seed,
        gamma=recipe.gamma,
        train_freq=1,
        gradient_steps=recipe.gradient_steps,
        batch_size=recipe.batch_size,
        learning_starts=recipe.learning_starts,
        policy_kwargs={"net_arch": [256, 256]},
        device="cpu",
    )


def newest_checkpoint(out):
    """The newest complete checkpoint folder, or None."""
    return max(out.glob("checkpoint-*"), default=None)


def load_model(checkpoint, environment_id, recipe, seed):
    """The model of a checkpoint with its replay buffer, its random streams seeded afresh."""
    steps = int(checkpoint.name.removeprefix("checkpoint-"))
    algorithm = load_algorithm(recipe)
    environments = make_environments(environment_id, recipe, seed + steps)
    model = algorithm.load(checkpoint / "model.zip", env=environments, device="cpu")
    model.set_random_seed(seed + steps)  # loading seeds with `seed`: the first episodes again
    load_replay(model, checkpoint.parent / "replay")
    return model


def replay_rows(model):
    """Rows ever written to the replay buffer (one row: one transition of every environment)."""
    return model.num_timesteps // model.n_envs


def save_replay(model, folder, first):
    """Write the rows since row `first` as one file, and drop files the buffer has overwritten.

    Earlier rows lie in earlier files already: rewriting gigabytes every interval is not needed.
    """
    last = replay_rows(model)
    buffer = model.replay_buffer
    places = np.arange(first, last) % buffer.buffer_size
    folder.mkdir(exist_ok=True)
    partial = folder / "partial.npz"
    np.savez(partial, **{name: getattr(buffer, name)[places] for name in BUFFER_FIELDS})
    partial.rename(folder / f"{first:09d}-{last:09d}.npz")
    for path in folder.glob("*-*.npz"):
        if int(path.stem.split("-")[1]) <= last - buffer.buffer_size:
            path.unlink()


def load_replay(model, folder):
    """Fill the replay buffer from the files up to the model's step."""
    rows, buffer = replay_rows(model), model.replay_buffer
    for path in sorted(folder.glob("*-*.npz")):
        first, last = map(int, path.stem.split("-"))
        if last > rows:
            continue  # written just before a kill; its checkpoint was not completed
        places = np.arange(first, last) % buffer.buffer_size
        with np.load(path) as arrays:
            for name in BUFFER_FIELDS:
                getattr(buffer, name)[places] = arrays[name]
    buffer.pos, buffer.full = rows % buffer.buffer_size, rows >= buffer.buffer_size


def save_checkpoint(model, out, record, improved):
    """A new checkpoint folder with the best actor so far inside; then the older go."""
    older = sorted(out.glob("checkpoint-*"))
    checkpoint = out / f"checkpoint-{model.num_timesteps:09d}"
    partial = out / "partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    model.save(partial / "model.zip")
    if improved:
        save_actor(extract_actor(model), partial / "actor.npz")
        shutil.copy(partial / "model.zip", partial / "best.zip")
    else:
        for name in ("actor.npz", "best.zip"):
            shutil.copy(older[-1] / name, partial / name)
    (partial / "record.json").write_text(json.dumps(record, indent=1))
    partial.rename(checkpoint)
    for path in older:
        shutil.rmtree(path)
    return checkpoint


def publish(checkpoint, out, final_evaluation=None):
    """Bring the files for readers in line with the checkpoint (repeatable after a kill)."""
    record = json.loads((checkpoint / "record.json").read_text())
    for name in ("actor.npz", "best.zip"):
        shutil.copy(checkpoint / name, out / "partial-file")
        (out / "partial-file").rename(out / name)
    history = record.pop("history")
    best = max(history, key=lambda evaluation: evaluation["mean_return"])
    record |= {"best_evaluation": best, "final_evaluation": final_evaluation}
    (out / "partial-file").write_text(json.dumps(record, indent=1) + "\n")
    (out / "partial-file").rename(out / "training.json")
    with (out / "evaluations.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, history[0])
        writer.writeheader()
        writer.writerows(history)
    draw_curve(history, record, out / "curve.png")


def draw_curve(history, record, path):
    steps = [evaluation["steps"] for evaluation in history]
    means = np.array([evaluation["mean_return"] for evaluation in history])
    deviations = np.array([evaluation["std_return"] for evaluation in history])
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, means, marker=".")
    axes.fill_between(steps, means - deviations, means + deviations, alpha=0.25)
    axes.axhline(record["settings"]["target"], color="grey", linestyle="--", label="target")
    axes.set(xlabel="environment steps", ylabel="return", title=record["environment"])
    axes.legend()
    figure.savefig(path, dpi=120)


def installed_versions():
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):  # sbx and jax are optional
            versions[package] = version(package)
    return versions


def new_record(environment_id, recipe, seed):
    return {
        "environment": environment_id,
        "library": recipe.library,
        "algorithm": recipe.algorithm,
        "settings": asdict(recipe),
        "versions": installed_versions(),
        "seed": seed,
        "steps": 0,
        "seconds": 0.0,
        "history": [],
    }


def check_same_settings(record, recipe):
    """A run continues with the settings it began with; only how long it lasts may change."""
    duration = {"steps": recipe.steps, "stop_return": recipe.stop_return, "target": recipe.target}
    if record["settings"] | duration != asdict(recipe):
        raise SystemExit(f"begun with other settings, give another --out: {record['settings']}")
    record["settings"] = asdict(recipe)


def train(environment_id, recipe, out, seed, episodes):
    """Train, or continue, until recipe.steps or recipe.stop_return; returns the checkpoint."""
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = newest_checkpoint(out)
    if checkpoint is None:
        model = new_model(environment_id, recipe, seed)
        record = new_record(environment_id, recipe, seed)
    else:
        record = json.loads((checkpoint / "record.json").read_text())
        check_same_settings(record, recipe)
        model = load_model(checkpoint, environment_id, recipe, seed)
        publish(checkpoint, out)
    history = record["history"]
    bar = tqdm(total=recipe.steps, initial=model.num_timesteps, mininterval=30, unit="step")
    bar.set_description(environment_id)

    def advance(_locals, _globals):
        bar.update(recipe.environments)
        return True

    best = max((evaluation["mean_return"] for evaluation in history), default=-math.inf)
    enough = math.inf if recipe.stop_return is None else recipe.stop_return
    while model.num_timesteps < recipe.steps and best < enough:
        started, first = time.monotonic(), replay_rows(model)
        interval = min(recipe.interval, recipe.steps - model.num_timesteps)
        model.learn(interval, callback=advance, reset_num_timesteps=False)
        actor = extract_actor(model)
        difference = check_actor(model, actor)
        result = evaluate(actor, environment_id, episodes, EVALUATION_SEED)
        record["steps"] = model.num_timesteps
        record["seconds"] += time.monotonic() - started
        history.append({"steps": record["steps"], "seconds": round(record["seconds"]), **result})
        history[-1]["actor_difference"] = difference
        tqdm.write(f"{environment_id} {json.dumps(history[-1])}")
        improved = result["mean_return"] > best
        best = max(best, result["mean_return"])
        save_replay(model, out / "replay", first)
        checkpoint = save_checkpoint(model, out, record, improved)
        publish(checkpoint, out)
    bar.close()
    return checkpoint


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("environment", choices=RECIPES)
    parser.add_argument("--steps", type=int, help="train to this many steps in all")
    parser.add_argument("--out", type=Path, help="default: runs/experts/<environment>")
    parser.add_argument("--library", choices=("sb3", "sbx"), help="default: the recipe's")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=10, help="per evaluation")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    recipe = RECIPES[arguments.environment]
    recipe = replace(
        recipe,
        steps=arguments.steps or recipe.steps,
        library=arguments.library or recipe.library,
    )
    out = arguments.out or Path("runs/experts") / arguments.environment
    checkpoint = train(arguments.environment, recipe, out, arguments.seed, arguments.episodes)
    actor = load_actor(checkpoint / "actor.npz")
    final = evaluate(actor, arguments.environment, 20, FINAL_EVALUATION_SEED)
    publish(checkpoint, out, final)
    print(f"{arguments.environment} final evaluation {json.dumps(final)}")


if __name__ == "__main__":
    main()
