"""The VecNormalize statistics that an agent was trained with: found, read with trust, checked."""

import shlex
from collections.abc import Collection
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Literal

import numpy as np

from fdtasil.errors import ExpertError, SettingError, warn
from fdtasil.experts.sb3.archive import Archive, read_file
from fdtasil.experts.sb3.network import ObservationStatistics
from fdtasil.experts.sb3.observations import Observed
from fdtasil.experts.sb3.trust import Trust
from fdtasil.files.storage import sha256

__all__ = ["VecNormalizePath", "read_statistics", "statistics_beside"]

VecNormalizePath = str | Path | Literal[False] | None


def read_statistics(
    agent: Archive, given: VecNormalizePath, observed: Observed, trust: Trust
) -> tuple[ObservationStatistics | None, str | None]:
    """Read what an agent's observations are normalised with.

    Args:
        agent: The zip, for a look at what it says, and at what lies beside it.
        given: The file, False (or the word "False", as a shell says it) where there is none, or
            None where nothing was said.
        observed: What the agent observes.
        trust: Must be "pickle" where there is a file.

    Returns:
        The statistics and the sha256 of their file; None, None where nothing is normalised.

    Raises:
        ExpertError: If the file needs trust, can't be used, belongs to another agent, or was not
            given although it lies beside the zip.
        SettingError: If `given` is no path.
    """
    if given in (False, "False"):
        return None, None
    if given is None:
        _check_neighbours(agent.path)
        _check_record(agent)
        return None, None
    if not isinstance(given, (str, Path)):
        raise SettingError(f"vecnormalize={given!r}", "a path, or False", "name the file")
    file = Path(given)
    data = read_file(file)
    if trust != "pickle":
        raise ExpertError(
            f"{file} is a Python pickle, which runs any code when it is opened",
            "a file that you trust",
            'if you do, write trust="pickle" (--trust pickle on the command line)',
        )
    from fdtasil.experts.sb3.trusted import unpickle_statistics

    statistics = unpickle_statistics(file, data, observed)
    if statistics is None:
        return None, None
    _check(statistics, observed.size, file)
    return statistics, sha256(data)


def _check_neighbours(agent: Path) -> None:
    """Refuse to leave out statistics that lie where stable-baselines3's tools put them."""
    folder = agent.parent
    patterns = ("*.pkl", "*/vecnormalize.pkl", "*/config.yml")
    found = statistics_beside(agent, {path for p in patterns for path in folder.glob(p)})
    if not found:
        return
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    raise ExpertError(
        f"{found[0]}{more} lies beside {agent.name} and looks like its observation statistics",
        "one ONNX file of both, or the word that the agent was trained without them",
        f"{_command(agent, found[0])} (or --vecnormalize False), then use the ONNX file",
    )


_KEPT = {f"<class '{name}'>" for name in ("numpy.ndarray", "dict", "collections.OrderedDict")}


def _check_record(agent: Archive) -> None:
    """Warn of an agent that was trained in VecNormalize, whose statistics are not here.

    PPO and its like, which alone have a gae_lambda, keep an observation of before the normalising
    only where there is one; SAC, TD3 and DQN keep one always.
    """
    kept = agent.record.get("_last_original_obs")
    kind = kept.get(":type:") if isinstance(kept, dict) else None
    if "gae_lambda" not in agent.record or kind not in _KEPT:
        return
    warn(
        f"{agent.path} was trained in VecNormalize, and its statistics are not given: if it "
        "normalised observations, the agent is asked about others than it knows. Pass the agent "
        f"with its environment, as PPO.load({agent.path.name!r}, env=VecNormalize.load("
        f"'stats.pkl', venv)), or write `{_command(agent.path, Path('stats.pkl'))}`, and use the "
        "ONNX file (--vecnormalize False if it normalised rewards alone)"
    )


def _command(agent: Path, file: PurePath) -> str:
    named, out, pkl = (shlex.quote(str(part)) for part in (agent, f"{agent.stem}.onnx", file))
    return f"fdtasil export-sb3 {named} --out {out} --vecnormalize {pkl} --trust pickle"


def statistics_beside(agent: PurePath, files: Collection[PurePath]) -> list[PurePath]:
    """Return what looks like an agent's statistics, the likeliest first.

    Args:
        agent: The zip.
        files: All that lies beside it and one folder below.
    """

    def belongs(file: PurePath) -> bool:
        if file.parent == agent.parent:
            # The hub and users save vec_normalize.pkl, callbacks ..._vecnormalize_..._steps.pkl.
            return fnmatchcase(file.name, "*vec*norm*.pkl")
        # rl-zoo writes <environment>/vecnormalize.pkl with its settings; any other folder below
        # may belong to any other agent.
        own = file.parent.name == agent.stem or file.parent / "config.yml" in files
        return file.parent.parent == agent.parent and file.name == "vecnormalize.pkl" and own

    # Of the checkpoints ..._1000_steps, ..._2000_steps the one of the same step comes first.
    return sorted(
        filter(belongs, files),
        key=lambda file: (file.stem.replace("vecnormalize_", "") != agent.stem, file),
    )


def _check(statistics: ObservationStatistics, observation_size: int, source: Path) -> None:
    arrays = (statistics.mean, statistics.scale)
    shapes = [array.shape for array in arrays]
    finite = all(np.isfinite(array).all() for array in arrays)
    if shapes != [(observation_size,)] * 2 or not finite or not (statistics.scale > 0).all():
        raise ExpertError(
            f"{source} has statistics of shape {shapes[0]}",
            f"({observation_size},) finite numbers, as the agent's observations",
            "check that the two files belong together",
        )
