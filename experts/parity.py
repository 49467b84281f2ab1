"""Train each algorithm of stable-baselines3 afresh; compare what fdtasil makes of it to predict().

    python experts/parity.py                                    all, two minutes of one core
    python experts/parity.py --algorithms SAC PPO --environments Pendulum-v1 --steps 120

Prints a Markdown table. A row is one agent: the zip as the installed version writes it, with and
without VecNormalize, and in the first environment also as 0.6 (2020) and 1.5 (2022) wrote it. The
last two columns are the largest absolute differences to `predict(deterministic=True)` on the
states of a rollout of that agent: of the ONNX file, and of the module that is read from the zip.
After its short training an agent answers about 0 everywhere, which would prove little: so its
weights get noise, and the table shows which share of the action range the rollout uses. Exit code
1 if a difference exceeds 1e-5, or if code of a hostile zip has run.
"""

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from fdtasil.errors import ExpertError
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.export import export_sb3
from fdtasil.files.onnx.model import read_model
from fdtasil.files.onnx.session import open_session, run_session

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from sb3_agents import LAYOUTS, OFF_POLICY, algorithm_class, booby_trap, old_layout, shake

ALGORITHMS = ("SAC", "TD3", "DDPG", "TQC", "PPO", "A2C")
ENVIRONMENTS = ("HalfCheetah-v5", "Ant-v5", "Pendulum-v1")
TOLERANCE = 1e-5
ROLLOUT = 300
HEADER = """
| algorithm | environment | zip | VecNormalize | range used | ONNX - predict | module - predict |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Trained:
    """An agent after its training.

    Attributes:
        algorithm: Name of its class.
        environment: Gymnasium id.
        states: (300, n) float32 raw observations of a rollout.
        actions: (300, m) what predict() answered to them, normalised where the agent wants it.
        span: Share of the action range that the rollout uses, mean over the actions' coordinates.
        zip: The saved agent.
        statistics: The saved VecNormalize, or None.
    """

    algorithm: str
    environment: str
    states: np.ndarray
    actions: np.ndarray
    span: float
    zip: Path
    statistics: Path | None


def train(algorithm: str, environment: str, steps: int, normalised: bool, folder: Path) -> Trained:
    """Train for a few hundred steps, save, and record a rollout."""
    venv: VecEnv = make_vec_env(environment, seed=0)
    if normalised:
        venv = VecNormalize(venv, clip_obs=3.0)
    settings = {"learning_starts": 50} if algorithm in OFF_POLICY else {"n_steps": 64}
    kind = algorithm_class(algorithm)
    agent = shake(kind("MlpPolicy", venv, seed=0, device="cpu", **settings).learn(steps))
    agent.save(folder / "agent.zip")
    statistics = None
    if isinstance(venv, VecNormalize):
        statistics = folder / "statistics.pkl"
        venv.save(str(statistics))
    states, actions = roll_out(agent, venv)
    width = agent.action_space.high - agent.action_space.low
    span = float((np.ptp(actions, axis=0) / width).mean())
    return Trained(algorithm, environment, states, actions, span, folder / "agent.zip", statistics)


def roll_out(agent: Any, venv: VecEnv) -> tuple[np.ndarray, np.ndarray]:
    """Return raw states, and what predict() answers to them as the agent was trained to see."""
    if isinstance(venv, VecNormalize):
        venv.training = False
    seen, states, actions = venv.reset(), [], []
    for _ in range(ROLLOUT):
        raw = venv.get_original_obs() if isinstance(venv, VecNormalize) else seen
        action, _ = agent.predict(seen, deterministic=True)
        states.append(raw.astype(np.float32))
        actions.append(action)
        seen, *_ = venv.step(action)
    return np.concatenate(states), np.concatenate(actions)


def differences(trained: Trained, zipped: Path) -> tuple[float, float]:
    """Return the largest difference to predict() of the ONNX file, and of the module."""
    statistics = trained.statistics
    options: dict[str, Any] = {"vecnormalize": False}
    if statistics is not None:
        options = {"vecnormalize": statistics, "trust": "pickle"}
    out = export_sb3(zipped, zipped.with_suffix(".onnx"), env=trained.environment, **options)
    session = open_session(read_model(out)[0], out.name)
    from_file = run_session(session, "actions", trained.states)
    module = read_agent(zipped, **options).module
    with torch.no_grad():
        from_module = module(torch.from_numpy(trained.states)).numpy()
    # In float64, so that NaN and infinity stay what they are and nothing rounds.
    expected = trained.actions.astype(np.float64)
    found = [float(np.abs(x - expected).max()) for x in (from_file, from_module)]
    return found[0], found[1]


def rows(trained: Trained, layouts: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Yield the row of an agent and the rows of its old layouts, each with its difference."""
    zips = {stable_baselines3.__version__: trained.zip}
    for version in layouts:
        old = trained.zip.with_name(f"old-{version}.zip")
        zips[f"{version} layout"] = old_layout(shutil.copy(trained.zip, old), version)
    for version, zipped in zips.items():
        onnx, module = differences(trained, zipped)
        normalised = "no" if trained.statistics is None else "yes"
        head = f"| {trained.algorithm} | {trained.environment} | {version} | {normalised} "
        tail = f"| {trained.span:.0%} | {onnx:.1e} | {module:.1e} |"
        # max() would lose a NaN that comes second.
        yield head + tail, float(np.max([onnx, module]))


def markers_written(zipped: Path) -> int:
    """Read zips that write a file when they are unpickled, and count the files."""
    folder = zipped.parent
    for member in ("data", "policy.pth"):
        hostile = Path(shutil.copy(zipped, folder / f"hostile-{member}.zip"))
        booby_trap(hostile, folder / f"marker-{member}", member)
        # The record is read around its pickles; weights that are not plain are refused.
        with suppress(ExpertError) if member == "policy.pth" else nullcontext():
            read_agent(hostile, vecnormalize=False)
    return len(list(folder.glob("marker-*")))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS)
    parser.add_argument("--environments", nargs="+", default=ENVIRONMENTS)
    parser.add_argument("--steps", type=int, default=200)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    started, worst, markers = time.monotonic(), [], 0
    print(HEADER.strip())
    cases = itertools.product(arguments.algorithms, arguments.environments, (False, True))
    for algorithm, environment, normalised in cases:
        first = environment == arguments.environments[0] and not normalised
        with tempfile.TemporaryDirectory() as folder:
            trained = train(algorithm, environment, arguments.steps, normalised, Path(folder))
            for row, difference in rows(trained, LAYOUTS if first else ()):
                print(row, flush=True)
                worst.append(difference)
            markers += markers_written(trained.zip) if first else 0
    largest = float(np.max(worst))
    print(
        f"\n{len(worst)} rows in {time.monotonic() - started:.0f} s, largest difference "
        f"{largest:.1e} (allowed: {TOLERANCE:.0e}).\nMarker files that the code in hostile zips "
        f"has written: {markers} (tests/test_sb3_trust.py shows that trust would have)."
    )
    return int(not largest <= TOLERANCE or markers > 0)


if __name__ == "__main__":
    sys.exit(main())
