"""What an expert goes through before it teaches."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.carrying import carry
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import (
    GATE_STATES,
    Finding,
    admit_expert,
    examine_expert,
    raise_problems,
)
from fdtasil.experts.load import ExpertLike, expert_in
from fdtasil.experts.memory import beginning_problem
from fdtasil.progress import Progress
from fdtasil.rollouts.behaviours import (
    farthest_apart,
    follow_answers,
    largest_action,
    random_behaviour,
)
from fdtasil.rollouts.environments import EnvironmentPool, resolve_horizon
from fdtasil.rollouts.episodes import Episodes, check_episodes
from fdtasil.rollouts.rollout import first_observations, rollout
from fdtasil.rollouts.trials import check_repeats
from fdtasil.seeding import episode_seeds, generator

__all__ = ["LOOKED_AT", "Looked", "check_first", "examine", "look_closely"]

LOOKED_AT = 32
"""States that a closer look is taken at."""
_SAME = 1e-4  # of two answers, relative to the largest action

_LONG = 600.0  # seconds of queries that are announced


def examine(
    expert: Expert,
    pool: EnvironmentPool,
    starts: list[int],
    horizon: int,
    progress: Progress,
    *,
    force: bool,
    rows: int = 0,
    largest: int = 0,
) -> Episodes:
    """Check an expert on first states, let it act, and check it on the states that it visited.

    Before it acts it is known how fast it is, and so how long its queries may take.

    Args:
        expert: Counts what it is asked under "check" and "evaluate".
        pool: The environment.
        starts: Seeds of the episodes.
        horizon: T, steps after which an episode is cut.
        progress: Progress bars.
        force: Go on with a warning where it fails a check but answers.
        rows: That the whole run may ask for; a long wait for them is announced.
        largest: Rows of the large batch that is asked too; see `large_batch`.

    Returns:
        Its episodes, which a student is compared with later.

    Raises:
        ExpertError: If it fails a check.
        EnvironmentFault: If nothing can be learnt from its episodes.
    """
    check_first(expert, pool, starts, force=force, rows=rows, largest=largest)
    with progress.bar("expert", "step", len(starts) * horizon) as bar:
        behaviour = follow_answers(expert.policy("evaluate"))
        episodes = rollout(behaviour, pool, starts, horizon, on_step=bar.move)
    check_episodes(episodes, pool.name)
    admit_expert(expert, episodes.spread(GATE_STATES), pool.boxes, force=force)
    return episodes


def check_first(
    expert: Expert,
    pool: EnvironmentPool,
    starts: list[int],
    *,
    force: bool,
    rows: int,
    largest: int = 0,
) -> None:
    """Check an expert on first states, before it acts; the arguments of `examine`.

    Raises:
        EnvironmentFault: If the environment remembers earlier episodes.
        ExpertError: If it fails a check.
    """
    check_repeats(pool, starts[0], force=force)
    first = first_observations(pool, [starts[e % len(starts)] for e in range(GATE_STATES)])
    raise_problems(_beginning(expert, first), force=force)
    announce = partial(_announce, rows=rows)
    admit_expert(expert, first, pool.boxes, force=force, largest=largest, announce=announce)


def _beginning(expert: Expert, first: np.ndarray) -> list[Finding]:
    """Look at the memory where episodes begin, (B, n) there; an expert without one has none."""
    memory = expert.memory
    if memory is None or memory.begin is None:
        return []
    size = len(expert.takes or range(first.shape[1])) - memory.size
    expert.count(2 * len(first), "check")
    problem = beginning_problem(memory, first[:, :size], expert.name)
    return [Finding("beginning", problem.found if problem else "a memory of zeros", problem)]


def _announce(seconds: float, rows: int) -> None:
    """Warn of queries that take long, before they are asked."""
    if seconds * rows > _LONG:
        warn(
            f"the expert takes {1000 * seconds:.3g} ms a row, so the {rows:,} rows that this run "
            f"may ask take up to {seconds * rows / 3600:.1f} h: lower probes, episodes, horizon "
            "or evaluation_episodes, or let load_expert(..., workers=) answer side by side"
        )


@dataclass(frozen=True)
class Looked:
    """What a closer look at a policy found.

    Attributes:
        findings: One for each check; opening and answers only, where it can't answer.
        expert: The policy, or None where it can't be opened.
        own: Its episodes, or None where it can't answer.
        chance: Episodes of random actions from the same starts, or None.
    """

    findings: list[Finding]
    expert: Expert | None = None
    own: Episodes | None = None
    chance: Episodes | None = None


def look_closely(
    source: ExpertLike,
    pool: EnvironmentPool,
    horizon: int | None,
    seed: int,
    episodes: int,
    *,
    with_chance: bool = True,
) -> Looked:
    """Open a policy, let it and chance act, and check it on states that it visited.

    Args:
        source: As in `load_expert`.
        pool: The environment.
        horizon: T, or None for the environment's own.
        seed: Of the episodes.
        episodes: How many.
        with_chance: Whether chance acts too.

    Raises:
        EnvironmentFault: If the environment can't be used.
        SettingError: If an argument can't be used.
    """
    boxes, length = pool.boxes, resolve_horizon(horizon, pool)
    sizes = boxes.observation_size, boxes.action_size
    try:
        expert = expert_in(source, pool)
    except ExpertError as error:
        return Looked([Finding("opening", error.found, error)])
    expert, _, remembered = carry(expert, pool)
    boxes, more = pool.boxes, f", remembers {remembered}" if remembered else ""
    opening = Finding("opening", f"{expert.name}: {sizes[0]} -> {sizes[1]} numbers{more}", None)
    starts = episode_seeds(seed, "evaluation", 0, episodes)
    try:
        own = rollout(follow_answers(expert.policy("act")), pool, starts, length)
    except ExpertError as error:
        return Looked([opening, Finding("answers", error.found, error)], expert)
    chance = None
    if with_chance:
        noise = [generator(seed, "random actions", episode) for episode in range(episodes)]
        chance = rollout(random_behaviour(pool), pool, starts, length, noise)
    states = own.spread(LOOKED_AT)
    begun = _beginning(expert, own.observations[:, 0])
    examined = [*begun, *examine_expert(expert, states, boxes), _batch_sizes(expert, states)]
    return Looked([opening, *examined], expert, own, chance)


def _batch_sizes(expert: Expert, states: np.ndarray) -> Finding:
    """Look at the batches that reveal a function of single rows: as many rows as coordinates."""
    name, width = "batch sizes", states.shape[1]
    rows = np.tile(states, (width // len(states) + 2, 1))[: width + 2]
    counts = (1, 2, width, width + 1)
    try:
        whole = expert.ask(rows, "check")
        parts = {count: expert.ask(rows[:count], "check") for count in counts}
    except ExpertError as error:
        return Finding(name, error.found, error)
    bound = _SAME * largest_action(whole)
    wrong = [n for n, part in parts.items() if farthest_apart(part, whole[:n]) > bound]
    if not wrong:
        return Finding(name, f"the same answers in batches of {_listed(counts)} rows", None)
    found = f"{expert.name} answers otherwise in batches of {_listed(wrong)} rows"
    advice = "return one row of actions for each row of observations"
    return Finding(name, found, ExpertError(found, "answers row by row", advice))


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
