"""Reading an agent: one torch module from raw observations to actions in environment units."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from torch import nn

from fdtasil.errors import ExpertError, SettingError
from fdtasil.sb3.archive import Archive, read_archive, read_file
from fdtasil.sb3.network import Clip, Normalise, Rescale, Statistics, build_network
from fdtasil.sb3.recipes import Recipe, find_recipe, read_activation
from fdtasil.sb3.spaces import Bounds, given_bounds, read_bounds, read_size
from fdtasil.storage import sha256

__all__ = ["Agent", "Trust", "VecNormalizePath", "read_agent"]

Trust = Literal["pickle"] | None
VecNormalizePath = str | Path | Literal[False] | None


@dataclass(frozen=True)
class Agent:
    """A trained agent of stable-baselines3.

    Attributes:
        algorithm: "SAC", "TD3", "DDPG", "TQC", "PPO", "A2C" or "TRPO".
        observation_size: n.
        action_low: (m,) float32, lower action bounds in environment units.
        action_high: (m,) float32, upper bounds.
        module: (B, n) float32 raw observations -> (B, m) float32 actions in environment units,
            what `agent.predict(observations, deterministic=True)` returns.
        source: The zip.
        sha256: Of the zip.
        library_version: Version of stable-baselines3 that wrote it, or "unknown".
        statistics_sha256: Of the VecNormalize file whose statistics are in `module`, or None.
    """

    algorithm: str
    observation_size: int
    action_low: np.ndarray
    action_high: np.ndarray
    module: nn.Module
    source: Path
    sha256: str
    library_version: str
    statistics_sha256: str | None


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
        path: The zip of a SAC, TD3, DDPG, TQC, PPO, A2C or TRPO agent with an MLP policy.
        trust: "pickle" to have stable-baselines3 load the zip. That runs any code that is in it,
            and is needed for gSDE, custom policies, feature extractors and activations, and for
            VecNormalize statistics.
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
    if trust not in (None, "pickle"):
        raise SettingError(f"trust={trust!r}", '"pickle" or None', 'write trust="pickle"')
    path = Path(path)
    archive = read_archive(path)
    statistics, statistics_sha256 = _statistics(path, vecnormalize, trust)
    recipe = find_recipe(archive.record, str(path))
    n, m = (
        read_size(archive.record, f"{kind}_space", str(path)) for kind in ("observation", "action")
    )
    given = given_bounds(action_low, action_high, m)
    read = _unpickled if trust else _rebuilt
    network, squashed, bounds = read(archive, recipe, (n, m), given)
    _check_bounds(bounds, squashed, str(path))
    parts: list[nn.Module] = [network, Rescale(bounds) if squashed else Clip(bounds)]
    if statistics is not None:
        _check_statistics(statistics, n, vecnormalize)
        parts.insert(0, Normalise(statistics))
    return Agent(
        recipe.algorithm,
        n,
        bounds.low,
        bounds.high,
        nn.Sequential(*parts).eval().requires_grad_(False),
        path,
        archive.sha256,
        archive.library_version(),
        statistics_sha256,
    )


def _rebuilt(
    archive: Archive, recipe: Recipe, sizes: tuple[int, int], given: Bounds | None
) -> tuple[nn.Module, bool, Bounds]:
    source = str(archive.path)
    activation = read_activation(archive.record, recipe, source)
    bounds = given or read_bounds(archive.record, sizes[1], source)
    network = build_network(archive.weights(), recipe, activation, sizes, source)
    return network, recipe.squashed, bounds


def _unpickled(
    archive: Archive, recipe: Recipe, sizes: tuple[int, int], given: Bounds | None
) -> tuple[nn.Module, bool, Bounds]:
    from fdtasil.sb3.trusted import unpickle_agent  # imports stable-baselines3

    network, squashed, bounds = unpickle_agent(archive, recipe)
    return network, squashed, given or bounds


def _statistics(
    path: Path, vecnormalize: VecNormalizePath, trust: Trust
) -> tuple[Statistics | None, str | None]:
    if vecnormalize is False:
        return None, None
    if vecnormalize is None:
        _check_neighbours(path)
        return None, None
    file = Path(vecnormalize)
    data = read_file(file)
    if trust != "pickle":
        raise ExpertError(
            f"{file} is a Python pickle, which runs any code when it is opened",
            "a file that you trust",
            'if you do, write trust="pickle" (--trust pickle on the command line)',
        )
    from fdtasil.sb3.trusted import unpickle_statistics

    statistics = unpickle_statistics(file, data)
    return statistics, sha256(data) if statistics is not None else None


def _check_neighbours(path: Path) -> None:
    """Refuse to leave out statistics that lie where stable-baselines3's tools put them."""
    # rl-zoo writes <agent folder>/<environment>/vecnormalize.pkl; the hub and callbacks write
    # vec_normalize.pkl and ..._vecnormalize_..._steps.pkl beside the zip.
    patterns = [f"{folder}*vec*normalize*.pkl" for folder in ("", "*/")]
    found = sorted(file for pattern in patterns for file in path.parent.glob(pattern))
    if found:
        raise ExpertError(
            f"{found[0]} lies beside {path.name}, and vecnormalize was not given",
            "the statistics that the agent was trained with, or none",
            f'write vecnormalize="{found[0]}" with trust="pickle", or vecnormalize=False',
        )


def _check_statistics(
    statistics: Statistics, observation_size: int, source: VecNormalizePath
) -> None:
    arrays = (statistics.mean, statistics.scale)
    shapes = [array.shape for array in arrays]
    finite = all(np.isfinite(array).all() for array in arrays)
    if shapes != [(observation_size,)] * 2 or not finite or not (statistics.scale > 0).all():
        raise ExpertError(
            f"{source} has statistics of shape {shapes[0]}",
            f"({observation_size},) finite numbers, as the agent's observations",
            "check that the two files belong together",
        )


def _check_bounds(bounds: Bounds, squashed: bool, source: str) -> None:
    if squashed and not np.isfinite([bounds.low, bounds.high]).all():
        raise ExpertError(
            f"{source}: action bounds {bounds.low} to {bounds.high}",
            "finite bounds, to which this policy's tanh is scaled",
            "write action_low=env.action_space.low, action_high=env.action_space.high",
        )
