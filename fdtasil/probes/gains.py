"""The Jacobian of any expert by central differences, with an estimate of its error."""

from dataclasses import dataclass, field

import numpy as np

from fdtasil.checks import check_count, spelt
from fdtasil.errors import SettingError, warn
from fdtasil.experts.carrying import carry
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import ExpertLike, expert_in, load_expert
from fdtasil.probes.scales import least_steps, measure_scales
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool

__all__ = ["Gains", "gain_rows", "gains"]

_RUNGS = 4.0 ** np.arange(-9, 1)  # of the ladder, in units of the scale, ascending
_RAYS = 64  # one coordinate of one state each
_WINDOW = 2  # rungs below the best one that the error's law is fitted to; above, curves bend
# Between derivatives at the radius and at half of it lie 5 parts of the noise's square. What is
# more than that may be truncation, of which it is 9/16, or noise that steps hide from the ladder,
# of which it is 5: the geometric mean is at most 1.7 times off.
_BEYOND = (16 / 9 / 5) ** 0.5
_ROUNDING = float(np.finfo(np.float32).eps)
_RATIO = 4.0  # of a rung to the one below it
_HEARD = 10.0  # times the noise of an action, that it changes by along coordinates that move
_FAR = 0.01  # of the scale: who does not change at all within it has no derivative but 0
_UNSURE = 0.3  # error, as a share of the Jacobian, above which nothing is left of it


@dataclass(frozen=True, repr=False)
class Gains:
    """Jacobians of an expert, K(x) of a controller.

    Attributes:
        jacobian: (N, m, n) derivatives of each action by each coordinate of the observation.
        error: (m, n) the standard error that is expected of each of them, over the states.
        radius: Half the distance of a difference, in units of `scale`.
        scale: (n,) unit of each coordinate.
        noise_floor: (m,) root mean square error of an action, as differences show it.
        queries: Rows asked.
        still: Coordinates that stand still in the states, beside others: their scale of 1 is no
            measured one, and norms leave them out where the others count for more than noise.
        unmoved: (m,) radius up to which an action does not change at all, where it is at an end
            at every state, such as a bound, or switches; 0 for others. Between its derivatives,
            which are 0, and differences at `radius` lies the whole `error`.
    """

    jacobian: np.ndarray
    error: np.ndarray
    radius: float
    scale: np.ndarray
    noise_floor: np.ndarray
    queries: int
    still: tuple[int, ...] = ()
    unmoved: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def relative_error(self) -> float:
        """Norm of the errors as a share of the derivatives' norm, coordinates in their units."""
        sizes = np.sqrt(np.nanmean(self.jacobian**2, axis=0))
        units = np.where(np.isin(np.arange(len(self.scale)), self.still), 0.0, self.scale)
        if np.linalg.norm(sizes * units) <= _HEARD * np.linalg.norm(self.noise_floor):
            units = self.scale  # it answers to coordinates that stand still alone
        error, size = (float(np.linalg.norm(part * units)) for part in (self.error, sizes))
        if size == 0:
            return 0.0 if error == 0 else float("inf")
        return error / size

    def __repr__(self) -> str:
        """Return a line, not the arrays."""
        (count, m, n), error = self.jacobian.shape, f"{self.relative_error:.1%}"
        return f"Gains({count:,} states, Jacobians of {m} x {n}, error {error} of their norm)"

    def __str__(self) -> str:
        sizes = np.sqrt(np.nanmean((self.jacobian * self.scale) ** 2, axis=0))
        rows = [
            ("states", f"{len(self.jacobian)}, Jacobians of {sizes.shape[0]} x {sizes.shape[1]}"),
            ("radius", f"{self.radius:.2g} of each coordinate's scale"),
            ("error", f"{self.relative_error:.1%} of the Jacobian's norm, estimated"),
            ("noise", f"{float(self.noise_floor.max()):.1e} in an action, at most"),
            ("queries", f"{self.queries:,}"),
        ]
        if self.relative_error > _UNSURE:
            within, why = self.unmoved.max(initial=0), "the expert answers in steps, or with noise"
            if within > 0:
                why = f"an action does not change within {within:.2g}, where they are 0"
            rows.append(("note", f"these are no derivatives: {why}"))
        if self.still:
            listed = ", ".join(map(str, self.still[:6])) + ", ..." * (len(self.still) > 6)
            rows.append(("still", f"{listed}: moved by parts of 1; scale= says how far they go"))
        strongest = np.argsort(sizes, axis=None)[::-1][:5]
        for action, coordinate in zip(*np.unravel_index(strongest, sizes.shape), strict=True):
            about = f"{sizes[action, coordinate]:.3g} for its scale"
            rows.append((f"action {action}", f"coordinate {coordinate}: {about}"))
        return "\n".join(f"{name:10} {text}" for name, text in rows)


def gains(
    expert: ExpertLike,
    states: np.ndarray,
    *,
    env: EnvironmentLike | None = None,
    scale: np.ndarray | None = None,
    seed: int = 0,
) -> Gains:
    """Return the Jacobian of an expert at states, without its help.

    The distance is found first, on a ladder of them: the error of a central difference is
    noise / radius at near ones, and curvature * radius^2 at far ones. States without an answer
    around them have NaN. At a kink nearer than the radius, as ReLU networks have them, a
    difference is the mean of both sides, and the estimate does not count that as an error.

    Args:
        expert: As in `load_expert`.
        states: (N, n) observations; of an expert with a memory, with that behind them.
        env: Its environment, as in `distill`: of an expert that takes dictionaries or gives
            choices, or that has a memory and is not opened.
        scale: (n,) by how much each coordinate usually differs; measured over the states if left
            out, and 1 where they are a single one or do not differ.
        seed: Of the ladder's states and coordinates.

    Returns:
        Jacobians and their errors, from 4 n rows for each state and about 1,300 for the ladder;
        where an action seems to be at a bound, from 2 n + 1 more for each state.

    Raises:
        SettingError: If states or scale can't be used.
        ExpertError: If the expert can't be asked.

    Example:
        >>> import numpy as np
        >>> found = gains(lambda rows: np.sin(rows[:, :1]), np.zeros((1, 2)))
        >>> found.jacobian.round(3), found.relative_error < 1e-3
        (array([[[1., 0.]]]), True)
    """
    rows = _checked(states)
    if env is not None:
        with EnvironmentPool(env) as pool:
            expert, _, _ = carry(expert_in(expert, pool), pool)
            return gains(expert, rows, scale=scale, seed=seed)
    units = _units(rows, scale)
    # One with a memory is asked about observations with the memory behind them.
    known = isinstance(expert, Expert) and expert.memory is not None
    asked = load_expert(expert) if known else load_expert(expert, rows.shape[1])
    wanted = asked.observation_size
    if known and wanted is not None and rows.shape[1] != wanted:
        raise SettingError(
            f"states of {rows.shape[1]} numbers for {asked.name}, which has a memory",
            f"{wanted}: an observation, and what is remembered behind it",
            "take those of a run: result.demonstrations.observations",
        )
    random = np.random.default_rng(check_count("seed", seed, 0))
    noise, curvature, nearest, unmoved = _law(asked, rows, units, random)
    radius = _best_radius(noise, curvature, nearest)
    jacobian, near = (_jacobian(asked, rows, units * reach) for reach in (radius, radius / 2))
    # On average over the states: what is left of single ones is more chance than error.
    spread = (noise / radius)[:, None] / units
    apart = np.nanmean((jacobian - near) ** 2, axis=0)
    beyond = np.maximum(apart - 5 * spread**2, 0) * _BEYOND
    at_a_bound = unmoved >= _FAR
    if at_a_bound.any():
        at_a_bound &= _one_sided(asked, rows, units)
    unmoved = np.where(at_a_bound, unmoved, 0.0)
    whole = np.sqrt(np.nanmean(jacobian**2, axis=0))
    if at_a_bound.any():
        listed = ", ".join(map(str, np.flatnonzero(at_a_bound)[:6]))
        warn(
            f"{asked.name} does not change its actions ({listed}) at all within "
            f"{unmoved.max():.2g} of the scale of these states: it is at a bound there, where its "
            "derivatives are 0, or it switches; differences farther away are none of them"
        )
    return Gains(
        jacobian,
        np.where(at_a_bound[:, None], whole, np.sqrt(beyond + spread**2)),
        radius,
        units,
        noise * 2**0.5,
        asked.queries["probe"],
        () if scale is not None else _still(rows),
        unmoved,
    )


def gain_rows(states: int, observation_size: int) -> int:
    """Return the rows that `gains` asks for."""
    return 2 * len(_RUNGS) * _RAYS + 4 * states * observation_size


def _checked(states: object) -> np.ndarray:
    try:
        rows = np.asarray(states, np.float32)
        if rows.ndim != 2 or not rows.size or not np.isfinite(rows).all():
            raise ValueError
    except (TypeError, ValueError):
        raise SettingError(
            f"{spelt('states', states)[:80]}",
            "(N, n) finite observations",
            "pass for example result.demonstrations.observations[:10]",
        ) from None
    return rows


def _still(rows: np.ndarray) -> tuple[int, ...]:
    """Return the coordinates that do not move in some states, where others do."""
    if (rows == rows[0]).all():
        return ()
    return tuple(np.flatnonzero(~measure_scales(rows).live).tolist())


def _units(rows: np.ndarray, scale: np.ndarray | None) -> np.ndarray:
    if scale is None:
        return measure_scales(rows).units_beside(rows)
    least = least_steps(rows)
    units = np.asarray(scale, np.float64)
    if units.shape != rows.shape[1:] or not (np.isfinite(units) & (units > 0)).all():
        found = f"scale of shape {units.shape}, from {units.min(initial=0):g}"
        raise SettingError(found, f"({rows.shape[1]},) positive numbers", "leave it out")
    if (small := np.flatnonzero(units < least)).size:
        raise SettingError(
            f"scale {units[small[0]]:g} of coordinate {small[0]}, whose values reach "
            f"{np.abs(rows[:, small[0]]).max():g}",
            "units that float32 does not round away beside them",
            "raise that one, or leave scale out",
        )
    return units


def _law(
    expert: Expert, rows: np.ndarray, units: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Return (m,) a and b of the error of a derivative, a / radius and b * radius^2.

    The third is the smallest radius that may be used: float32 rounds none of its halves away. The
    last are the (m,) radii up to which no action changes. Derivatives at a radius and at a quarter
    of it differ by the errors of both.
    """
    from scipy.optimize import nnls  # loads for a moment, and few need it

    states = rows[random.integers(len(rows), size=_RAYS)]
    axes = random.integers(rows.shape[1], size=_RAYS)
    steps = np.zeros_like(states, np.float64)
    steps[np.arange(_RAYS), axes] = units[axes]
    asked = [_slope(expert, states, steps * rung) for rung in _RUNGS]
    slopes = np.stack([found / rung for (found, _), rung in zip(asked, _RUNGS, strict=True)])
    # Answers are rounded themselves: of few rays, some agree to the bit by luck.
    rounded = _ROUNDING / 24**0.5 * np.sqrt(np.mean([size for _, size in asked], axis=0))
    first = [_moves(states, steps * rung) for rung in _RUNGS].index(True)
    slopes, rungs = slopes[first:], _RUNGS[first:]
    apart = np.nanmean(np.diff(slopes, axis=0) ** 2, axis=1)  # (rungs - 1, m)
    sizes = np.nanmean(slopes[1:] ** 2 + slopes[:-1] ** 2, axis=1)
    wide = rungs[1:]
    law = np.stack([(1 + _RATIO**2) / wide**2, (1 - _RATIO**-2) ** 2 * wide**4], axis=1)
    noise, curvature = np.zeros((2, apart.shape[1]))
    for action, (squares, size) in enumerate(zip(apart.T, sizes.T, strict=True)):
        told = size > 0  # steps smaller than those of the expert say nothing
        if not told.any():
            continue
        # Differences that agree to the bit agree to float32's rounding, and no better.
        least = np.where(told, size, 1) * _ROUNDING**2 + law[:, 0] * rounded[action] ** 2
        squares = np.maximum(squares, least)
        best = int(np.where(told, squares / np.where(told, size, 1), np.inf).argmin())
        window = np.arange(max(0, best - _WINDOW), min(len(squares), best + 2))
        window = window[told[window]]
        design = law[window] / squares[window, None]
        lengths = np.linalg.norm(design, axis=0)  # the columns lie twenty powers of ten apart
        fitted, _ = nnls(design / lengths, np.ones(len(design)))
        noise[action], curvature[action] = np.sqrt(fitted / lengths)
    near = np.logical_and.accumulate((np.nan_to_num(slopes) == 0).all(axis=1), axis=0)
    unmoved = (near * rungs[:, None]).max(axis=0)
    return noise, curvature, 2 * float(rungs[0]), unmoved


def _one_sided(expert: Expert, rows: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return which (m,) actions are at an end at every state, the largest around it or the least.

    The ladder's rays are few, and may miss the coordinates that an action depends on; and answers
    in steps change to both sides. One that never changes is at no end.
    """
    count, n = rows.shape
    points = np.concatenate([rows, *_ends(*_along_each(rows, units))])
    here, *there = np.split(expert.ask(points, "probe"), [count, count + count * n])
    change = np.stack([one.reshape(count, n, -1) for one in there]) - here[None, :, None]
    up, down = (change > 0).any(axis=(0, 2)), (change < 0).any(axis=(0, 2))
    return np.asarray(~(up & down).any(axis=0) & (up | down).any(axis=0))


def _best_radius(noise: np.ndarray, curvature: np.ndarray, nearest: float) -> float:
    """Return where the errors of all actions together are smallest, within the ladder."""
    a, b = float((noise**2).sum()), float((curvature**2).sum())
    if b == 0:
        return float(_RUNGS[-1])
    return float(np.clip((a / (2 * b)) ** (1 / 6), max(nearest, _RUNGS[1]), _RUNGS[-1]))


def _jacobian(expert: Expert, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return (N, m, n) central differences along each coordinate."""
    count, n = rows.shape
    found, _ = _slope(expert, *_along_each(rows, steps))
    slopes = found / steps[np.tile(np.arange(n), count), None]
    return slopes.reshape(count, n, -1).transpose(0, 2, 1)


def _along_each(rows: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N n, n) states and displacements: each state once along each coordinate."""
    count, n = rows.shape
    return np.repeat(rows, n, axis=0), np.tile(np.diag(steps), (count, 1))


def _ends(states: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (R, n) float32 points, ahead of the states and behind them."""
    return (states + steps).astype(np.float32), (states - steps).astype(np.float32)


def _moves(states: np.ndarray, steps: np.ndarray) -> bool:
    """Whether float32 tells both ends of every difference from one another."""
    ahead, behind = _ends(states, steps)
    return bool((ahead != behind).any(axis=1).all())


def _slope(expert: Expert, states: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (R, m) changes for each whole step, over the distance that float32 really moves.

    Beside them the (m,) mean squares of the answers.
    """
    ahead, behind = _ends(states, steps)
    lengths = np.linalg.norm(ahead.astype(np.float64) - behind, axis=1)
    shares = lengths / np.linalg.norm(steps, axis=1)
    answers = expert.ask(np.concatenate([ahead, behind]), "probe").astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # a step that float32 rounds away
        changes = (answers[: len(states)] - answers[len(states) :]) / shares[:, None]
    heard = (~np.isnan(answers)).sum(axis=0)  # none, where nobody answers
    return changes, np.nansum(answers**2, axis=0) / np.maximum(heard, 1)
