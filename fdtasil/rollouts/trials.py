"""A few steps with drawn actions: whether an environment does twice what it did once."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from fdtasil.errors import EnvironmentFault, FdtasilError, warn
from fdtasil.rollouts.behaviours import random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool, simulator_warnings
from fdtasil.rollouts.flattening import Flat
from fdtasil.rollouts.history import WithHistory
from fdtasil.rollouts.playing import InTurn, Playing, SideBySide
from fdtasil.rollouts.recording import Recording
from fdtasil.rollouts.remembering import Remembering
from fdtasil.rollouts.stepping import step_together

__all__ = [
    "Trial",
    "check_repeats",
    "differ",
    "fingerprint",
    "other_environment",
    "stages_of",
]

_STEPS = 3  # a wrapper that remembers shows it at the first, a simulator that is shared as well
# Of two numbers that are the same but for the rounding of a simulator: relative to the value, and
# to the largest one beside it (a coordinate may be all rounding).
_SAME, _BESIDE = 1e-4, 1e-6
# Of a coordinate's size, what counts as movement beside how far it moves. One of 100,000 pascals
# would hide how another moves by a centimetre, and itself how it moves by a few pascals.
_STILL = 0.05


@dataclass(frozen=True)
class Trial:
    """The first steps of an episode.

    Attributes:
        observations: (T, n) float32, before each step.
        rewards: (T, 1) float64.
    """

    observations: np.ndarray
    rewards: np.ndarray

    def equals(self, other: "Trial") -> bool:
        """Whether two trials are equal to the bit."""
        ours, theirs = vars(self).values(), vars(other).values()
        return all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))

    def other_than(self, other: "Trial") -> str | None:
        """Return what differs by more than rounding, or None."""
        if len(self.rewards) != len(other.rewards):
            return "length of the episode"
        moves = np.ptp(self.observations, axis=0)
        if differ(self.observations[0], other.observations[0], moves):
            return "first observation"
        if differ(self.rewards, other.rewards):
            return "reward"
        return "observation" if differ(self.observations, other.observations, moves) else None


def differ(ours: np.ndarray, theirs: np.ndarray, moves: np.ndarray | None = None) -> bool:
    """Whether two arrays of one shape differ by more than a simulator's rounding.

    Args:
        ours: (..., n).
        theirs: The same.
        moves: (n,) how far each coordinate moves; None where only its size tells.

    Example:
        >>> first, again = np.array([1e-7, 3.0]), np.array([1.1e-7, 3.0])
        >>> differ(first, again), differ(first, 2 * again)
        (False, True)
    """
    largest = np.maximum(np.abs(ours), np.abs(theirs)).astype(np.float64)
    sizes = largest.reshape(-1, largest.shape[-1]).max(axis=0)
    if moves is None or not (moving := moves > _BESIDE * sizes).any():
        bound = _SAME * sizes + _BESIDE * sizes.max()
    else:  # what is computed from those that move has their rounding, at least
        beside = max(_BESIDE * moves.max(), np.finfo(np.float32).eps * sizes[moving].max())
        bound = _SAME * np.minimum(sizes, moves + _STILL * sizes) + beside
    return not (np.abs(ours.astype(np.float64) - theirs) <= bound).all()


def check_repeats(pool: EnvironmentPool, seed: int, *, force: bool = False) -> None:
    """Look whether equal seeds and actions give equal episodes.

    Args:
        pool: The environment.
        seed: Of the reset.
        force: Only warn of what remembers.

    Raises:
        EnvironmentFault: If it, or a wrapper of it, remembers earlier episodes: an expert would
            not even be as good as itself.
    """
    first, again = _tried(pool, seed)
    what = first.other_than(again)
    if what is None:
        if not first.equals(again):
            warn(
                f"{pool.name} repeats an episode of one seed only up to rounding, so equal runs "
                "differ in their last digits"
            )
        return
    layer = None if pool.together is not None else _culprit(pool, seed)
    if layer is None or not _remembers(pool, layer, first, seed):
        warn(
            f"{pool.name} does not give the same {what} twice with one seed, so equal "
            "runs differ, and expert and student are not compared from the same starts: seed it "
            "in reset(), and take off wrappers with a memory (NormalizeObservation)"
        )
        return
    kind = type(layer).__name__
    found = f"{pool.name}: {kind} remembers earlier episodes: one seed, another {what}"
    if force:
        warn(f"{found} (forced)")
        return
    mend = "or let its reset() clear all that it keeps"
    if hasattr(layer, "update_running_mean"):
        mend = "or set its update_running_mean = False"
    leave = f"leave {kind} out of the environment, {mend}"
    if not isinstance(layer, gymnasium.Wrapper):
        leave = f"let reset() of {kind} clear all that it keeps"
    raise EnvironmentFault(
        found,
        "equal episodes for equal seeds and actions: returns could not be compared",
        f"{leave}; force=True goes on as it is",
    )


def fingerprint(pool: EnvironmentPool, seed: int) -> dict[str, Any] | None:
    """Return what tells an environment from another, as plain JSON values.

    Args:
        pool: The environment.
        seed: Of the reset.

    Returns:
        `seed`, `observation` (the first one), and `after` and `reward` of one step; six digits
        each. None where the environment does not repeat itself.
    """
    first, again = _tried(pool, seed)
    if first.other_than(again) is not None:
        return None
    return {
        "seed": seed,
        "observation": _written(first.observations[0]),
        "after": _written(first.observations[1:2].ravel()),
        "reward": _written(first.rewards[0]),
    }


_KEPT = 64  # numbers of an observation, in a fingerprint
_LISTED = 4
_SHOWN = {
    "observation": "its first observation",
    "after": "its observation after one step",
    "reward": "its first reward",
}


def other_environment(before: Any, now: Any) -> list[str]:
    """Return in words what tells two environments apart, by their fingerprints.

    Args:
        before: What `fingerprint` returned once, as it is in a file; anything may be.
        now: What it returns today.
    """
    if not isinstance(before, dict) or now is None or before.get("seed") != now["seed"]:
        return []  # of a run of an earlier fdtasil, or nothing that could be compared
    return [
        f"{words} from seed {now['seed']} {_changed(before.get(name), now[name])}"
        for name, words in _SHOWN.items()
        if _apart(before.get(name), now[name])
    ]


def _apart(before: Any, now: list[float]) -> bool:
    try:
        ours, theirs = np.asarray(before, np.float64), np.asarray(now, np.float64)
        return ours.shape != theirs.shape or (ours.size > 0 and differ(ours, theirs))
    except (TypeError, ValueError, OverflowError):  # a file that was changed
        return True


def _changed(before: Any, now: list[float]) -> str:
    """Return what two that are apart are, and where they are farthest apart if they are long."""
    if isinstance(before, list) and len(before) != len(now):
        return f"had {len(before)} numbers, has {len(now)}"
    if len(now) <= _LISTED or not isinstance(before, list):
        return f"was {_some(before)}, is {_some(now)}"
    try:
        was = np.asarray(before, np.float64).reshape(len(now))
        place = int(np.abs(was - now).argmax())
    except (TypeError, ValueError, OverflowError):  # a file that was changed
        place = 0
    where = f" at coordinate {place}" if len(now) < _KEPT else ""  # of more, not all are kept
    return f"was {_some(before[place])}, is {_some(now[place])}{where}"


def _some(values: Any) -> str:
    listed = values if isinstance(values, list) else [values]
    return f"[{', '.join(map(str, listed[:_LISTED]))}{', ...' * (len(listed) > _LISTED)}]"


def stages_of(
    pool: EnvironmentPool, record: Recording, count: int
) -> Callable[[Sequence[int]], Iterator[Playing]]:
    """Return what plays episodes in a pool, some at a time.

    Args:
        pool: The environment.
        record: Where they are recorded.
        count: How many copies of it are made, where it does not step together.
    """
    together = pool.together
    members = [] if together is not None else _independent_copies(pool, count)
    size = len(members) if together is None else together.count

    def stages(episodes: Sequence[int]) -> Iterator[Playing]:
        for first in range(0, len(episodes), size):
            chunk = episodes[first : first + size]
            if together is not None:
                yield SideBySide(record, together, pool.spaces, chunk)
            else:
                yield InTurn(record, dict(zip(chunk, members, strict=False)))

    return stages


def _independent_copies(pool: EnvironmentPool, count: int) -> list[gymnasium.Env]:
    """Return up to `count` copies that don't disturb each other; one where they do."""
    members = pool.take(count)
    if len(members) == 1 or pool.independent:
        return members
    alone = _trial(pool, members[:1])
    if alone.other_than(_trial(pool, members[:2])) and not alone.other_than(
        _trial(pool, members[:1])  # who does not even repeat itself can't be judged so
    ):
        warn(
            f"copies of {pool.name} share one simulator: stepping one moves the others, so "
            "episodes are played one after another, in the first copy"
        )
        pool.keep_to_one()
        return members[:1]
    pool.independent = True
    return members


def _tried(pool: EnvironmentPool, seed: int) -> tuple[Trial, Trial]:
    """Return two trials of one seed; the same two, whenever they are asked for."""
    if seed not in pool.trials:
        pool.trials[seed] = _trial(pool, None, seed), _trial(pool, None, seed)
    return pool.trials[seed]


def _trial(
    pool: EnvironmentPool, environments: Sequence[gymnasium.Env] | None, seed: int = 0
) -> Trial:
    """Play in the first environment, with the others beside it; in the pool's own for None."""
    seeds = range(seed, seed + len(environments or (0,)))
    record, noise = Recording(seeds, _STEPS, pool), [np.random.default_rng(s) for s in seeds]
    if environments is not None:
        playing: Playing = InTurn(record, dict(enumerate(environments)))
    elif pool.together is not None:
        playing = SideBySide(record, pool.together, pool.spaces, range(1))
    else:
        playing = InTurn(record, dict(enumerate(pool.take(1))))
    with simulator_warnings():
        step_together(record, playing, random_behaviour(pool), noise, _STEPS)
    valid = record.valid[0]
    return Trial(record.observations[0, valid], record.rewards[0, valid, None])


def _culprit(pool: EnvironmentPool, seed: int) -> gymnasium.Env:
    """Return the innermost layer of an environment that does not repeat itself.

    One whose spaces are no flat boxes can't be tried alone: then the outermost of these.
    """
    (member,) = pool.take(1)
    layers = list(reversed(list(_layers(member))))
    known = [layer for layer in layers if getattr(layer, "update_running_mean", False)]
    for layer in known or layers:
        with suppress(FdtasilError):  # it may have other spaces than the whole
            if _trial(pool, [layer], seed).other_than(_trial(pool, [layer], seed)):
                return _theirs(layer)
    return known[0] if known else _theirs(member)


def _theirs(layer: gymnasium.Env) -> gymnasium.Env:
    """Return the outermost layer that is not one of this library's."""
    while isinstance(layer, Flat | WithHistory | Remembering):
        layer = layer.env
    return layer


def _remembers(pool: EnvironmentPool, layer: gymnasium.Env, first: Trial, seed: int) -> bool:
    """Whether a layer that does not repeat itself has a memory, and is not merely unseeded."""
    if getattr(layer, "update_running_mean", False):
        return True
    fresh = pool.take(2)[1:]  # who is unseeded is so from the start
    return bool(fresh) and _trial(pool, fresh, seed).other_than(first) is None


def _layers(environment: gymnasium.Env) -> Iterator[gymnasium.Env]:
    yield environment
    while isinstance(environment, gymnasium.Wrapper):
        environment = environment.env
        yield environment


def _written(values: np.ndarray) -> list[float]:
    """Return some of the numbers, evenly spread, with six digits: more than rounding leaves."""
    chosen = values[np.linspace(0, len(values) - 1, min(len(values), _KEPT)).astype(int)]
    return [float(f"{value:.6g}") for value in chosen]
