"""What an expert goes through before it teaches."""

import warnings

import numpy as np

from fdtasil.errors import FdtasilWarning
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import GATE_STATES, check_expert
from fdtasil.progress import Stages
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes, check_episodes
from fdtasil.rollouts.rollout import first_observations, rollout

__all__ = ["check_first", "examine"]

_LONG = 600.0  # seconds of questions that are announced


def examine(
    expert: Expert,
    pool: EnvironmentPool,
    starts: list[int],
    horizon: int,
    stages: Stages,
    *,
    force: bool,
    rows: int = 0,
) -> Episodes:
    """Check an expert on first states, let it act, and check it on the states that it visited.

    Before it acts it is known how fast it is, and so how long its questions may take.

    Args:
        expert: Counts what it is asked under "check" and "evaluate".
        pool: The environment.
        starts: Seeds of the episodes.
        horizon: T, steps after which an episode is cut.
        stages: Progress bars.
        force: Go on with a warning where it fails a check but answers.
        rows: That the whole run may ask for; a long wait for them is announced.

    Returns:
        Its episodes, which a student is compared with later.

    Raises:
        ExpertError: If it fails a check.
        EnvironmentFault: If nothing can be learnt from its episodes.
    """
    check_first(expert, pool, starts, force=force, rows=rows)
    with stages.stage("expert", len(starts) * horizon, "step") as move:
        behaviour = follow(expert.policy("evaluate"))
        episodes = rollout(behaviour, pool, starts, horizon, on_step=move)
    check_episodes(episodes, pool.name)
    check_expert(expert, episodes.spread(GATE_STATES), pool.boxes, force=force)
    return episodes


def check_first(
    expert: Expert, pool: EnvironmentPool, starts: list[int], *, force: bool, rows: int
) -> None:
    """Check an expert on first states, before it acts; the arguments of `examine`.

    Raises:
        ExpertError: If it fails a check.
    """
    first = first_observations(pool, [starts[e % len(starts)] for e in range(GATE_STATES)])
    if not np.array_equal(first_observations(pool, starts[:1])[0], first[0]):
        warnings.warn(
            f"{pool.name} does not start from the same observation twice with one seed, so equal "
            "runs differ, and expert and student are not compared from the same starts: seed it "
            "in reset(), and take off wrappers with a memory (NormalizeObservation)",
            FdtasilWarning,
            stacklevel=5,
        )
    _announce(check_expert(expert, first, pool.boxes, force=force), rows)


def _announce(seconds: float, rows: int) -> None:
    """Warn of questions that take long, before they are asked."""
    if seconds * rows > _LONG:
        warnings.warn(
            f"the expert takes {1000 * seconds:.3g} ms a row, so the {rows:,} rows that this run "
            f"may ask take up to {seconds * rows / 3600:.1f} h: lower probes, episodes, horizon "
            "or evaluation_episodes, or let load_expert(..., workers=) answer side by side",
            FdtasilWarning,
            stacklevel=6,
        )
