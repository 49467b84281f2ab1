"""Reading an agent: one torch module from raw observations to actions in environment units."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from torch import nn

from fdtasil.errors import ExpertError, FdtasilError, SettingError, shown
from fdtasil.experts.sb3.archive import Archive, read_archive
from fdtasil.experts.sb3.network import (
    Clip,
    MeanOfQuantiles,
    Normalise,
    Rescale,
    build_network,
)
from fdtasil.experts.sb3.observations import Observed, read_observed
from fdtasil.experts.sb3.recipes import Recipe, check_policy, find_recipe, read_activation
from fdtasil.experts.sb3.recurrent import (
    RECURRENT,
    RecurrentNetwork,
    is_recurrent,
    read_lstm,
)
from fdtasil.experts.sb3.spaces import (
    Bounds,
    choice_sizes,
    given_bounds,
    no_bounds,
    read_bounds,
    read_size,
)
from fdtasil.experts.sb3.statistics import VecNormalizePath, read_statistics
from fdtasil.experts.sb3.trust import ITSELF, TRUST, Trust, check_trust
from fdtasil.files.border import reads

__all__ = ["Agent", "read_agent"]


_MOST_QUANTILES = 10_000


@dataclass(frozen=True)
class Agent:
    """A trained agent of stable-baselines3.

    Attributes:
        algorithm: "SAC", "TD3", "DDPG", "TQC", "PPO", "A2C", "TRPO", "DQN", "QRDQN" or
            "RecurrentPPO".
        observation_size: n.
        parts: Name and size of each part of a dictionary that it observes, as they stand side by
            side in the flat form; () for one array.
        action_low: (m,) float32, lower action bounds in environment units; scores have none.
        action_high: (m,) float32, upper bounds.
        module: (B, n) float32 raw observations -> (B, m) float32 actions in environment units,
            what `agent.predict(observations, deterministic=True)` returns; of an agent that
            chooses, the scores (logits or values), the best of which it takes.
        source: The zip.
        sha256: Of the zip.
        library_version: Version of stable-baselines3 that wrote it, or "unknown".
        statistics_sha256: Of the VecNormalize file whose statistics are in `module`, or None.
        memory: k, how many numbers it carries along an episode; the module then takes
            (B, n) observations and (B, k) memories, and returns both. 0 for none.
    """

    algorithm: str
    observation_size: int
    parts: tuple[tuple[str, int], ...]
    action_low: np.ndarray
    action_high: np.ndarray
    module: nn.Module
    source: Path
    sha256: str
    library_version: str
    statistics_sha256: str | None
    memory: int = 0


@reads(
    "an agent that can be read",
    "a zip written by save() of stable-baselines3",
    'save the agent again, or write trust="pickle" if you trust the file',
    ExpertError,
    passes=FdtasilError,
)
def read_agent(
    path: str | Path,
    *,
    trust: Trust = None,
    vecnormalize: VecNormalizePath = None,
    action_low: ArrayLike | None = None,
    action_high: ArrayLike | None = None,
) -> Agent:
    """Read an agent that stable-baselines3 saved, since its version 0.6, without unpickling.

    Args:
        path: The zip of a SAC, TD3, DDPG, TQC, PPO, A2C, TRPO, DQN or QR-DQN agent with an MLP
            policy, on vectors or on dictionaries of them, or of a RecurrentPPO with an LSTM
            before one; its ".zip" may be left out, as in stable-baselines3.
        trust: "pickle" to have stable-baselines3 load what can't be read otherwise: gSDE, custom
            policies, feature extractors and activations, and the statistics of VecNormalize. That
            runs any code that is in such a file.
        vecnormalize: The file with the statistics of VecNormalize that the agent was trained
            with, which becomes part of the module; False where there are none, although a file
            beside the zip looks like them.
        action_low: (m,) or one number, instead of the bounds that the zip has as text.
        action_high: (m,) or one number; given together with `action_low`.

    Returns:
        The agent.

    Raises:
        ExpertError: If the zip is damaged, is not such an agent, or can't be read without trust.
        SettingError: If an argument has a value that can't be used.

    Example::

        agent = read_agent("agents/HalfCheetah-v5.zip")
        actions = agent.module(torch.from_numpy(observations))
    """
    check_trust(trust)
    path = _find(path)
    archive = read_archive(path)
    check_policy(archive.record, str(path))
    observed = read_observed(archive.record, str(path))
    n, m = observed.size, read_size(archive.record, "action_space", str(path))
    given = given_bounds(action_low, action_high, m)
    statistics, statistics_sha256 = read_statistics(archive, vecnormalize, observed, trust)
    if is_recurrent(archive.record):
        before = nn.Identity() if statistics is None else Normalise(statistics)
        module, bounds = _recurrent(archive, (n, m), given, before)
        return Agent(
            RECURRENT.algorithm,
            n,
            observed.parts,
            bounds.low,
            bounds.high,
            module.eval().requires_grad_(False),
            path,
            archive.sha256,
            archive.library_version(),
            statistics_sha256,
            module.memory_size,
        )
    recipe = find_recipe(archive.record, str(path))
    network, squashed, bounds = _read_network(archive, recipe, observed, m, given, trust)
    _check_bounds(bounds, squashed, str(path))
    parts: list[nn.Module] = [network]
    if not choice_sizes(archive.record):
        parts.append(Rescale(bounds) if squashed else Clip(bounds))
    if statistics is not None:
        parts.insert(0, Normalise(statistics))
    return Agent(
        recipe.algorithm,
        n,
        observed.parts,
        bounds.low,
        bounds.high,
        nn.Sequential(*parts).eval().requires_grad_(False),
        path,
        archive.sha256,
        archive.library_version(),
        statistics_sha256,
    )


def _find(path: str | Path) -> Path:
    if not isinstance(path, (str, Path)):
        raise SettingError(
            f"an agent of type {type(path).__name__}",
            "the path of a zip",
            'save it first: agent.save("agent.zip"); distill(agent, env) takes the agent itself',
        )
    path = Path(path)
    return path.with_suffix(".zip") if not path.suffix and not path.exists() else path


def _read_network(
    archive: Archive,
    recipe: Recipe,
    observed: Observed,
    actions: int,
    given: Bounds | None,
    trust: Trust,
) -> tuple[nn.Module, bool, Bounds]:
    """Return the network, whether its actions are to be rescaled, and the bounds.

    Trust in statistics, which always need it, is no reason to run code of a zip that needs none.
    """
    sizes = observed.size, actions
    try:
        return _rebuilt(archive, recipe, sizes, given)
    except ExpertError as refusal:
        if (observed.parts or choice_sizes(archive.record)) and refusal.next_step == TRUST:
            raise ExpertError(refusal.found, refusal.expected, ITSELF) from refusal
        if trust is None or refusal.next_step != TRUST:
            raise
    from fdtasil.experts.sb3.trusted import unpickle_agent

    network, squashed, bounds = unpickle_agent(archive, recipe, sizes)
    return network, squashed, given or bounds


def _rebuilt(
    archive: Archive, recipe: Recipe, sizes: tuple[int, int], given: Bounds | None
) -> tuple[nn.Module, bool, Bounds]:
    source = str(archive.path)
    activation = read_activation(archive.record, recipe, source)
    if not choice_sizes(archive.record):
        bounds = given or read_bounds(archive.record, sizes[1], source)
        network = build_network(archive.weights(), recipe, activation, sizes, source)
        return network, recipe.squashed, bounds
    n, m = sizes
    each = _quantiles(archive, recipe)
    network = build_network(archive.weights(), recipe, activation, (n, each * m), source)
    if each > 1:
        network.append(MeanOfQuantiles(each))
    return network, False, no_bounds(m)


def _recurrent(
    archive: Archive, sizes: tuple[int, int], given: Bounds | None, before: nn.Module
) -> tuple[RecurrentNetwork, Bounds]:
    source, (n, m) = str(archive.path), sizes
    try:
        activation, weights = read_activation(archive.record, RECURRENT, source), archive.weights()
    except ExpertError as refusal:
        if refusal.next_step != TRUST:
            raise
        raise ExpertError(refusal.found, refusal.expected, ITSELF) from refusal
    lstm = read_lstm(weights, n, source)
    after = build_network(weights, RECURRENT, activation, (lstm.hidden_size, m), source)
    if choice_sizes(archive.record):
        return RecurrentNetwork(before, lstm, after), no_bounds(m)
    bounds = given or read_bounds(archive.record, m, source)
    return RecurrentNetwork(before, lstm, nn.Sequential(after, Clip(bounds))), bounds


def _quantiles(archive: Archive, recipe: Recipe) -> int:
    """Return how many numbers stand for each score."""
    count = archive.record.get(recipe.quantiles) if recipe.quantiles else 1
    if isinstance(count, int) and 0 < count <= _MOST_QUANTILES:
        return count
    raise ExpertError(
        f"{archive.path} has {recipe.quantiles} {shown(count)}",
        f"1 to {_MOST_QUANTILES:,} quantiles",
        "save the agent again",
    )


def _check_bounds(bounds: Bounds, squashed: bool, source: str) -> None:
    if squashed and not np.isfinite([bounds.low, bounds.high]).all():
        raise ExpertError(
            f"{source}: action bounds {bounds.low} to {bounds.high}",
            "finite bounds, to which this policy's tanh is scaled",
            "write action_low=env.action_space.low, action_high=env.action_space.high",
        )
