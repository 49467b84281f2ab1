"""Writing an agent as one ONNX file that answers what the agent's `predict` answers."""

from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from fdtasil.checks import check_suffix
from fdtasil.compute import ask_module
from fdtasil.errors import ExpertError, ExportError, SettingError
from fdtasil.experts.sb3.agent import Agent, read_agent
from fdtasil.experts.sb3.observations import check_parts
from fdtasil.experts.sb3.statistics import VecNormalizePath
from fdtasil.experts.sb3.trust import Trust
from fdtasil.experts.sizes import size_hint
from fdtasil.files.onnx.export import export_module
from fdtasil.files.storage import write_bytes
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.version import __version__

__all__ = ["export_sb3"]

_SEEDS = (0, 1)
_HORIZON = 100


def export_sb3(
    agent_zip: str | Path,
    out: str | Path,
    *,
    env: EnvironmentLike | None = None,
    vecnormalize: VecNormalizePath = None,
    trust: Trust = None,
    action_low: ArrayLike | None = None,
    action_high: ArrayLike | None = None,
) -> Path:
    """Write an agent of stable-baselines3 as one ONNX file.

    The file's input `obs` is (batch, n) raw observations, its output `actions` (batch, m) in
    environment units, float32 and any batch: normalisation, squashing, scaling and clipping are
    in the graph. Its metadata say where it comes from.

    Args:
        agent_zip: The zip of a SAC, TD3, DDPG, TQC, PPO, A2C, TRPO, DQN or QR-DQN agent with an
            MLP policy, on vectors or on dictionaries of them.
        out: The file to write.
        env: The agent's environment. It is checked that it fits, and the file is compared with
            the agent on states of a short rollout; without it, on random states.
        vecnormalize: The VecNormalize file that the agent was trained with, which is a pickle and
            needs `trust`; False where there is none, although a file beside the zip looks like it.
        trust: "pickle" lets stable-baselines3 load what can't be read without running code that
            is in the files.
        action_low: (m,) or one number, instead of the bounds that the zip has as text.
        action_high: (m,) or one number; given together with `action_low`.

    Returns:
        `out`.

    Raises:
        ExpertError: If the agent can't be read, or does not fit the environment.
        SettingError: If an argument has a value that can't be used.
        ExportError: If it can't be exported, or the file and the agent differ by more than 1e-5.
        StorageError: If the file can't be written.

    Example::

        export_sb3("agents/HalfCheetah-v5.zip", "agent.onnx", env="HalfCheetah-v5")
    """
    agent = read_agent(
        agent_zip,
        trust=trust,
        vecnormalize=vecnormalize,
        action_low=action_low,
        action_high=action_high,
    )
    if agent.memory:
        raise ExportError(
            f"{agent.source}, which has a memory of {agent.memory} numbers, as one ONNX file",
            "an agent whose answer depends on the observation alone",
            'pass the zip itself: distill("agent.zip", env, history=3)',
        )
    _check_out(Path(out), agent.source)
    states, where = _random_states(agent) if env is None else _visited_states(agent, env)
    metadata = {**_metadata(agent), "compared_on": f"{len(states)} {where}"}
    write_bytes(Path(out), export_module(agent.module, states, metadata))
    return Path(out)


def _check_out(out: Path, source: Path) -> None:
    found = "is a folder" if out.is_dir() else ""
    found = "is the agent's own zip" if out.resolve() == source.resolve() else found
    if found:
        raise SettingError(
            f"out={str(out)!r} {found}",
            "the name of a file that may be written",
            f"write out={source.with_suffix('.onnx').name!r}",
        )
    check_suffix(out, ".onnx")


def _random_states(agent: Agent) -> tuple[np.ndarray, str]:
    random = np.random.default_rng(0)
    states = random.standard_normal((256, agent.observation_size), dtype=np.float32)
    return states, "standard normal states"


def _visited_states(agent: Agent, env: EnvironmentLike) -> tuple[np.ndarray, str]:
    with EnvironmentPool(env) as pool:
        _check_fit(agent, pool)
        episodes = rollout(follow(partial(ask_module, agent.module)), pool, _SEEDS, _HORIZON)
        return episodes.observations[episodes.valid], f"states of a rollout in {pool.name}"


def _check_fit(agent: Agent, pool: EnvironmentPool) -> None:
    boxes = pool.boxes
    found = (agent.observation_size, len(agent.action_low))
    expected = (boxes.observation_size, boxes.action_size)
    if found != expected:
        raise ExpertError(
            f"{agent.source} has {found[0]} observations and {found[1]} actions",
            f"{expected[0]} and {expected[1]}, as {pool.name}",
            size_hint(found[0], expected[0])
            if found[0] != expected[0]
            else "check the environment's version, options and wrappers",
        )
    check_parts(agent.parts, pool.spaces.observations, str(agent.source))
    pairs = ((agent.action_low, boxes.low), (agent.action_high, boxes.high))
    if not all(np.allclose(ours, theirs, rtol=1e-5) for ours, theirs in pairs):
        raise ExpertError(
            f"{agent.source} has action bounds {agent.action_low} to {agent.action_high}",
            f"{boxes.low} to {boxes.high}, as {pool.name}",
            "pass the environment with the wrappers that the agent was trained with",
        )


def _metadata(agent: Agent) -> dict[str, str]:
    metadata = {
        "algorithm": agent.algorithm,
        "source": agent.source.name,
        "source_sha256": agent.sha256,
        "source_stable_baselines3": agent.library_version,
        "observation_size": str(agent.observation_size),
        "action_low": _numbers(agent.action_low),
        "action_high": _numbers(agent.action_high),
        "fdtasil": __version__,
        "torch": torch.__version__,
    }
    if agent.statistics_sha256 is not None:
        metadata["vecnormalize_sha256"] = agent.statistics_sha256
    return metadata


def _numbers(values: np.ndarray) -> str:
    return ", ".join(str(value) for value in values)
