"""Paired evaluation: student and expert from the same starts, with an interval."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from fdtasil.checks import spelt
from fdtasil.errors import SettingError, first_line, warn
from fdtasil.experts.expert import Expert
from fdtasil.files.plain import from_plain, to_plain
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Progress
from fdtasil.results.smoothness import smoothness_of
from fdtasil.results.stability import distances
from fdtasil.rollouts.behaviours import Behaviour, has_none, random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.rollouts.spaces import Layout
from fdtasil.seeding import generator

__all__ = [
    "Constraints",
    "Evaluation",
    "check_constraints",
    "evaluate_pair",
    "evaluation_rows",
    "interval_text",
    "rows_html",
    "score_text",
]

Constraints = Mapping[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]
"""Name -> function of (N, n) observations and the (N, m) actions taken there: (N,) numbers,
positive where the constraint is violated."""

_RESAMPLES = 2000


@dataclass(frozen=True)
class Evaluation:
    """How a student did beside its expert, from the same starts.

    Attributes:
        episodes: E, number of paired episodes.
        horizon: T, steps after which an episode was cut.
        expert_return: Mean undiscounted return of the expert.
        student_return: Mean undiscounted return of the student.
        reference_return: What counts as zero: 0 where the expert's median return is positive,
            else the mean return of uniformly random actions.
        normalized_return: (student - reference) / (expert - reference); 1 is the expert. None
            where the expert is no better than the reference, and the share means nothing.
        ci95: 95 % bootstrap interval of the normalised return, over paired episodes; None with it,
            or for a single pair.
        survival: Share of the student's episodes that neither the environment ended, nor a policy
            without an answer.
        expert_survival: The same for the expert.
        action_error: Mean Euclidean distance of the student's action to the expert's, on the
            student's own states, in action units.
        imitation_gap: Largest distance between the two trajectories of a pair while both last,
            in the expert's standard deviations (root mean square over coordinates), averaged over
            pairs (TaSIL, section 2). Chaotic systems drift apart whatever the student does.
        expert_returns: (E,) return of each episode.
        student_returns: (E,) return of each episode, in the same order.
        expert_physics_resets: Episodes of the expert in which the simulator put itself back.
        physics_resets: The same for the student; where they are more than half, the returns mean
            nothing and there is no normalised one.
        violations: Of each constraint its name, and the share of the steps at which the expert
            and the student violated it.
        agreement: Where actions are choices, the share of the student's own states at which it
            chooses as the expert does; else None.
        roughness: How much the student's actions change from step to step; see `Smoothness`.
        expert_roughness: The same for the expert.
        high_frequency: Share of the power of the student's actions that is fast.
        expert_high_frequency: The same for the expert.
    """

    episodes: int
    horizon: int
    expert_return: float
    student_return: float
    reference_return: float
    normalized_return: float | None
    ci95: tuple[float, float] | None
    survival: float
    expert_survival: float
    action_error: float
    imitation_gap: float
    expert_returns: tuple[float, ...]
    student_returns: tuple[float, ...]
    expert_physics_resets: int = 0
    physics_resets: int = 0
    violations: tuple[tuple[str, float, float], ...] = ()
    agreement: float | None = None
    roughness: float | None = None
    expert_roughness: float | None = None
    high_frequency: float | None = None
    expert_high_frequency: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the evaluation as plain JSON values."""
        return to_plain(self)

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> "Evaluation":
        """Read what `to_json` returned."""
        return from_plain(cls, fields)

    def _repr_html_(self) -> str:
        return rows_html(evaluation_rows(self))

    def __str__(self) -> str:
        expert = f"{self.expert_return:10.1f}   survival {self.expert_survival:.2f}"
        student = f"{self.student_return:10.1f}   survival {self.survival:.2f}"
        share = f"{score_text(self.normalized_return):>10}   95 % {interval_text(self.ci95)}"
        kept = "".join(
            f"\n  {name:17} violated at {theirs:.2%} of the expert's steps, {ours:.2%} of the "
            "student's"
            for name, theirs, ours in self.violations
        )
        agrees = self.agreement
        same = "" if agrees is None else f"\n  agreement         {agrees:10.3f}   of its choices"
        return (
            f"{self.episodes} paired episodes of {self.horizon} steps\n"
            f"  expert            {expert}\n"
            f"  student           {student}\n"
            f"  normalised return {share}\n"
            f"  action error      {self.action_error:10.3f}   on the student's own states"
            f"{same}{self._rough()}{kept}"
        )

    def _rough(self) -> str:
        if self.roughness is None or self.expert_roughness is None:
            return ""
        told = f"{self.roughness:10.3f}   expert {self.expert_roughness:.3f}, change in a step"
        return f"\n  roughness         {told}"


def rows_html(rows: Sequence[tuple[str, str]]) -> str:
    """Return names and texts as a table of HTML."""
    apart = 'style="padding-right: 1em"'
    lines = "".join(
        f"<tr><td {apart}>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows
    )
    return f"<table>{lines}</table>"


def evaluation_rows(found: Evaluation) -> list[tuple[str, str]]:
    """Return an evaluation as names and texts."""
    rows = [
        (
            "normalised return",
            f"{score_text(found.normalized_return)} {interval_text(found.ci95)}",
        ),
        ("return", f"{found.student_return:,.1f}, the expert's {found.expert_return:,.1f}"),
        ("survival", f"{found.survival:.2f}, the expert's {found.expert_survival:.2f}"),
        ("episodes", f"{found.episodes} from equal starts, of {found.horizon} steps"),
        ("action error", f"{found.action_error:.3g} on the student's own states"),
    ]
    if found.agreement is not None:
        rows.append(("agreement", f"{found.agreement:.3f} of its choices"))
    if found.roughness is not None and found.expert_roughness is not None:
        told = f"{found.roughness:.3g}, the expert's {found.expert_roughness:.3g}"
        rows.append(("change of an action in a step", told))
    for name, theirs, ours in found.violations:
        rows.append((f"{name} violated", f"{ours:.2%} of the steps, the expert {theirs:.2%}"))
    return rows


def evaluate_pair(
    student: Behaviour,
    expert: Expert,
    expert_episodes: Episodes,
    pool: EnvironmentPool,
    horizon: int,
    seed: int,
    progress: Progress,
    constraints: Constraints | None = None,
    own: int | None = None,
) -> Evaluation:
    """Run a policy from the starts of the expert's episodes, and compare.

    Args:
        student: Who acts.
        expert: Answers on the student's states, counted under "evaluate".
        expert_episodes: (E, T) the expert's own, already recorded.
        pool: The environment.
        horizon: T.
        seed: Of the bootstrap, and of the random actions where they are the reference.
        progress: Progress bars.
        constraints: What is counted where it is violated.
        own: Length of the environment's own observations, which constraints are functions of; the
            whole of them if left out.
    """
    broken = {
        name: _violated(name, constraint, expert_episodes, pool, own)  # before hours of steps
        for name, constraint in (constraints or {}).items()
    }
    seeds = [int(s) for s in expert_episodes.seeds]
    with progress.bar("evaluation", "step", len(seeds) * horizon) as bar:
        student_episodes = rollout(student, pool, seeds, horizon, on_step=bar.move)
    reference = _reference_return(expert_episodes, pool, seeds, horizon, seed)
    ours, theirs = student_episodes.returns, expert_episodes.returns
    meaningful = float(theirs.mean()) > reference
    if not meaningful:
        least = "0" if np.median(theirs) > 0 else f"{reference:.4g}, that of random actions"
        warn(
            f"the expert's return {theirs.mean():.4g} is not above {least}: no normalised return; "
            "check that expert and environment belong together"
        )
    for who, episodes in (("expert", expert_episodes), ("policy", student_episodes)):
        if episodes.given_up.any():
            warn(
                f"{episodes.given_up.sum()} of {len(seeds)} episodes of the {who} were ended, "
                "for it had no answer for long; their returns are of shorter episodes"
            )
    reset = student_episodes.physics_resets > 0
    if reset.mean() > 0.5:  # more than one start each: not the returns of this policy
        meaningful = False
    visited = student_episodes.observations[student_episodes.valid]
    acted = student_episodes.actions[student_episodes.valid]
    said = expert.ask(visited, "evaluate")
    heard = ~has_none(said)  # where the expert has an answer
    distance = np.linalg.norm(acted[heard] - said[heard], axis=1)
    our_smoothness = smoothness_of(student_episodes, pool)
    their_smoothness = smoothness_of(expert_episodes, pool)
    return Evaluation(
        episodes=len(seeds),
        horizon=horizon,
        expert_return=float(theirs.mean()),
        student_return=float(ours.mean()),
        reference_return=reference,
        normalized_return=_share(ours - reference, theirs - reference) if meaningful else None,
        ci95=_interval(ours - reference, theirs - reference, seed) if meaningful else None,
        survival=_survival(student_episodes),
        expert_survival=_survival(expert_episodes),
        action_error=float(distance.mean()) if len(distance) else float("nan"),
        imitation_gap=_imitation_gap(student_episodes, expert_episodes),
        expert_returns=tuple(theirs.tolist()),
        student_returns=tuple(ours.tolist()),
        expert_physics_resets=int((expert_episodes.physics_resets > 0).sum()),
        physics_resets=int(reset.sum()),
        violations=tuple(
            (name, broken[name], _violated(name, constraint, student_episodes, pool, own))
            for name, constraint in (constraints or {}).items()
        ),
        agreement=_agreement(pool.spaces.actions, acted[heard], said[heard]),
        roughness=our_smoothness.roughness,
        expert_roughness=their_smoothness.roughness,
        high_frequency=our_smoothness.high_frequency,
        expert_high_frequency=their_smoothness.high_frequency,
    )


def _agreement(actions: Layout, ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """Return the share of the rows whose choices are all the same."""
    if not actions.choices or not len(ours):
        return None
    return float((actions.best(ours) == actions.best(theirs)).all(axis=1).mean())


def _survival(episodes: Episodes) -> float:
    """Return the share of the episodes that nothing ended before their time."""
    return float(1 - (episodes.terminated | episodes.given_up).mean())


def check_constraints(constraints: object) -> Constraints:
    """Refuse what are no constraints.

    Raises:
        SettingError: If they are something else.
    """
    good = isinstance(constraints, Mapping) and all(
        isinstance(name, str) and callable(one) for name, one in constraints.items()
    )
    if not good:
        raise SettingError(spelt("constraints", constraints), _CONSTRAINTS, _LIMIT)
    return constraints  # pyright: ignore[reportReturnType]


_CONSTRAINTS = "names, each with a function of (N, n) observations and (N, m) actions"
_LIMIT = 'write for example constraints={"rail": lambda x, u: abs(x[:, 0]) - 1}'


def _violated(
    name: str,
    constraint: Callable[[np.ndarray, np.ndarray], np.ndarray],
    episodes: Episodes,
    pool: EnvironmentPool,
    own: int | None,
) -> float:
    """Return the share of the steps at which a constraint is violated."""
    states = episodes.observations[episodes.valid][:, :own]
    actions, _ = pool.bounds.put_inside(episodes.actions[episodes.valid])
    try:
        found = np.asarray(constraint(states.copy(), actions.copy()), np.float64)
    except Exception as error:
        said = f"constraints: {name!r} raised {type(error).__name__}: {first_line(error)}"
        raise SettingError(said, _CONSTRAINTS, _LIMIT) from error
    if found.shape != (len(states),) or np.isnan(found).any():
        nan = "NaN in " if np.isnan(found).any() else ""
        said = f"constraints: {name!r} returned {nan}shape {found.shape}"
        raise SettingError(said, f"({len(states)},) numbers, positive where violated", _LIMIT)
    return float((found > 0).mean())


def _reference_return(
    expert: Episodes, pool: EnvironmentPool, seeds: list[int], horizon: int, seed: int
) -> float:
    if np.median(expert.returns) > 0:
        return 0.0
    noise = [generator(seed, "random actions", episode) for episode in range(len(seeds))]
    return float(rollout(random_behaviour(pool), pool, seeds, horizon, noise).returns.mean())


def score_text(share: float | None) -> str:
    """Return a normalised return for a table."""
    return "n/a" if share is None else f"{share:.3f}"


def interval_text(interval: tuple[float, float] | None) -> str:
    """Return an interval for a table."""
    return "n/a" if interval is None else f"[{interval[0]:.3f}, {interval[1]:.3f}]"


def _share(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(ours.mean() / theirs.mean())


def _interval(ours: np.ndarray, theirs: np.ndarray, seed: int) -> tuple[float, float] | None:
    from scipy import stats  # loads for most of a second, and many runs end before it

    def ratio(a: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
        return a.mean(axis=axis) / b.mean(axis=axis)

    if len(ours) < 2:
        return None
    if np.array_equal(ours * theirs[0], theirs * ours[0]):  # one ratio for all: nothing to draw
        point = _share(ours, theirs)
        return point, point
    result = stats.bootstrap(
        (ours, theirs),
        ratio,
        paired=True,
        vectorized=True,
        method="percentile",
        n_resamples=_RESAMPLES,
        rng=generator(seed, "bootstrap"),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _imitation_gap(student: Episodes, expert: Episodes) -> float:
    scales = measure_scales(expert.observations[expert.valid])
    return float(distances(expert, student, scales).mean())
