"""Demonstrations from arrays that somebody has, with neither rewards nor an expert."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdtasil.demonstrations.dataset import Dataset, check_dataset, warn_of_bounds
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import SettingError, in_one_line, shown, warn
from fdtasil.rollouts.flattening import unbounded
from fdtasil.rollouts.narrowing import Narrowing
from fdtasil.rollouts.spaces import to_numpy

__all__ = ["from_arrays"]

_AFTER_THE_LAST = (
    "leave out the observation after each episode's last action, which no action answers: "
    "observations[:-1]"
)
_CHOICES = 20  # of how many there is a choice at most, where actions are whole numbers


def from_arrays(
    observations: Any,
    actions: Any,
    *,
    episode_ends: Any = None,
    low: Any = None,
    high: Any = None,
    environment: str = "arrays",
) -> Dataset:
    """Make a dataset of plain arrays, which `distill(dataset=...)` learns from.

    With an expert beside it, `distill(expert, dataset=...)` also asks the probes around its
    states, without an environment.

    Args:
        observations: (N, n) states, or a list of them, (T, n) for each episode.
        actions: (N, m) what the expert did there, in the environment's units; or such a list. Of
            one action, (N,) will do.
        episode_ends: (N,) booleans, true at the last state of each episode, or the number of
            states up to each end, as Minari and D4RL have them. Left out, all are of one.
        low: (m,) lower action bounds, or one number; left out, there are none, or those of the
            environment that is given beside the dataset.
        high: (m,) upper bounds.
        environment: What to call where they are from.

    Raises:
        SettingError: If the arrays do not go together, or are not finite.

    Example:
        >>> import numpy as np
        >>> states = np.random.default_rng(0).standard_normal((6, 3))
        >>> data = from_arrays(states, np.tanh(states[:, :1]), episode_ends=[2, 6], low=-1, high=1)
        >>> data.demonstrations.episode.tolist()
        [0, 0, 1, 1, 1, 1]
    """
    if isinstance(observations, list | tuple) and observations and np.ndim(observations[0]) == 2:
        observations, actions, episode_ends = _joined(observations, actions, episode_ends)
    wide, labels = _numbers("observations", observations), _columns(_numbers("actions", actions))
    rows = np.ascontiguousarray(wide, np.float32)
    if rows.ndim != 2 or labels.ndim != 2 or len(rows) != len(labels) or not len(rows):
        raise SettingError(
            f"observations of shape {rows.shape} and actions of shape {labels.shape}",
            "(N, n) and (N, m), a row for each state",
            _AFTER_THE_LAST
            if rows.ndim == labels.ndim == 2 and len(rows) == len(labels) + 1
            else "reshape them; episodes stand one behind the other",
        )
    count, m = labels.shape
    none = np.full(m, np.inf)
    least, most = _bound("low", low, -none, m), _bound("high", high, none, m)
    states = Demonstrations(
        rows,
        np.ascontiguousarray(labels, np.float32),
        _episodes(episode_ends, count),
        np.zeros(count, np.int32),
        np.array(labels, np.float32),
        np.zeros(count),
        np.zeros(count, bool),
    )
    found = check_dataset(Dataset(states, None, None, least, most, environment))
    narrowing = Narrowing(rows.shape[1], environment)
    narrowing.see(wide, rows)
    narrowing.judge_a_log()
    warn_of_bounds(found)
    _warn_of_choices(labels)
    return found


def _warn_of_choices(actions: np.ndarray) -> None:
    """Warn of actions that seem to be numbers of choices: as such, 2 is no mean of 1 and 3."""
    least, count = int(actions.min()), int(actions.max()) + 1
    single = actions.dtype.kind in "bui" and actions.shape[1] == 1
    if single and least >= 0 and least + 1 < count <= _CHOICES:
        warn(
            f"actions of {actions.dtype} are learnt as numbers; if they are choices, from 0 on, "
            f"write scores: np.eye({count})[np.ravel(actions).astype(int)] - 1 / {count}"
        )


def _joined(
    observations: Sequence[Any], actions: Any, ends: Any
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return the arrays of some episodes as one each, and where the episodes end."""
    if ends is not None:
        raise SettingError(
            f"episode_ends= beside {len(observations)} episodes",
            "one of the two: a list of episodes says where they end",
            "leave episode_ends= out",
        )
    parts = [to_numpy(part) for part in observations]
    listed = isinstance(actions, list | tuple)
    labels = [_columns(to_numpy(part)) for part in actions] if listed else []
    shapes, theirs = [part.shape for part in parts], [part.shape for part in labels]
    good = [len(shape) == 2 and shape[0] > 0 for shape in shapes + theirs]
    widths = [{shape[-1] for shape in of if shape} for of in (shapes, theirs)]
    lengths = [shape[0] for shape in shapes if shape]
    if not all(good) or lengths != [s[0] for s in theirs if s] or max(map(len, widths)) > 1:
        one_more = bool(lengths) and lengths == [s[0] + 1 for s in theirs if s]
        look = "look at the first episode whose arrays are of other lengths or widths"
        raise SettingError(
            f"episodes of observations of shapes {shown(shapes)}, of actions {shown(theirs)}",
            "lists of as many arrays, (T, n) and (T, m), T at least 1 and the same in both",
            _AFTER_THE_LAST if one_more else look,
        )
    return np.concatenate(parts), np.concatenate(labels), np.cumsum(lengths).tolist()


def _columns(actions: np.ndarray) -> np.ndarray:
    """Return actions as a matrix, where they are numbers of a single one."""
    return actions[:, None] if actions.ndim == 1 else actions


def _numbers(name: str, given: Any) -> np.ndarray:
    try:
        found = to_numpy(given)
    except ValueError:  # numpy's, of lists of several lengths
        found = np.array(None)
    if found.dtype.kind in "biuf" and not np.ma.is_masked(given):
        return found
    raise SettingError(f"{name} of {found.dtype}", "an array of plain numbers", "convert them")


def _bound(name: str, given: Any, usual: np.ndarray, m: int) -> np.ndarray:
    try:
        told = np.asarray(usual if given is None else given, np.float32)
        return np.broadcast_to(unbounded(told), (m,))
    except (TypeError, ValueError):
        raise SettingError(
            f"{name}={given!r}", f"{m} numbers, or one for all", f"write {name}=-1.0"
        ) from None


def _episodes(ends: Any, count: int) -> np.ndarray:
    """Return (N,) int32, the episode of each state."""
    if ends is None:
        return np.zeros(count, np.int32)
    try:
        given = np.asarray(ends)
    except ValueError:  # lists of several lengths
        given = np.zeros((0, 0))
    listed = in_one_line(np.array2string(given, threshold=6) if given.size else shown(ends))
    said, flags = f"episode_ends={listed}", given.dtype == bool
    if flags and given.shape == (count,):
        given = np.flatnonzero(given) + 1
    # Compared one by one: differences of unsigned numbers are never negative.
    grow = given.ndim == 1 and given.dtype.kind in "iu" and bool((given[1:] > given[:-1]).all())
    if not grow or not given.size or given[0] < 1 or given[-1] > count:
        raise SettingError(
            said,
            f"({count},) True at the last state of each episode, or growing numbers up to {count}",
            "write for example episode_ends=[300, 600]",
        )
    if given[-1] == count - 1 and not flags:
        warn(
            "the last episode is a single state: each of episode_ends is the number of states up "
            f"to an end, so that the last one is {count}, and no index"
        )
    return np.searchsorted(given, np.arange(count), side="right").astype(np.int32)
