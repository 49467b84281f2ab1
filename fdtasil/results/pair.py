"""Paired evaluation: student and expert from the same starts, with an interval."""

from dataclasses import replace

import numpy as np

from fdtasil.errors import warn
from fdtasil.experts.expert import Expert
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Progress
from fdtasil.results.constraints import Constraints, violated
from fdtasil.results.evaluation import Evaluation
from fdtasil.results.smoothness import smoothness_of
from fdtasil.results.stability import distances
from fdtasil.rollouts.behaviours import Behaviour, has_none, random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import generator

__all__ = ["evaluate_pair"]

_RESAMPLES = 2000
_OUTSIDE = 0.05  # share of the draws beyond the ends of an interval


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
    limits = constraints or {}
    broken = violated(limits, expert_episodes, pool, own)  # before hours of steps
    seeds = [int(s) for s in expert_episodes.seeds]
    with progress.bar("evaluation", "step", len(seeds) * horizon) as bar:
        student_episodes = rollout(student, pool, seeds, horizon, on_step=bar.move)
    reference = _reference_return(expert_episodes, pool, seeds, horizon, seed)
    ours, theirs = student_episodes.returns, expert_episodes.returns
    _warn(expert_episodes, student_episodes, reference)
    reset = student_episodes.physics_resets > 0
    # A reset in most episodes: more than one start each, not the returns of this policy.
    meaningful = float(theirs.mean()) > reference and reset.mean() <= 0.5
    error, agreement = _nearness(student_episodes, expert, pool)
    our_violations = violated(limits, student_episodes, pool, own)
    our_smoothness = smoothness_of(student_episodes, pool, expert_episodes)
    their_smoothness = smoothness_of(expert_episodes, pool, expert_episodes)
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
        action_error=error,
        imitation_gap=_imitation_gap(student_episodes, expert_episodes, own),
        expert_returns=tuple(theirs.tolist()),
        student_returns=tuple(ours.tolist()),
        expert_physics_resets=int((expert_episodes.physics_resets > 0).sum()),
        physics_resets=int(reset.sum()),
        violations=tuple((name, broken[name], our_violations[name]) for name in limits),
        agreement=agreement,
        roughness=our_smoothness.roughness,
        expert_roughness=their_smoothness.roughness,
        high_frequency=our_smoothness.high_frequency,
        expert_high_frequency=their_smoothness.high_frequency,
        given_up=int(student_episodes.given_up.sum()),
        expert_given_up=int(expert_episodes.given_up.sum()),
    )


def _warn(expert: Episodes, student: Episodes, reference: float) -> None:
    """Warn of returns that mean less than they seem to."""
    mean = expert.returns.mean()
    if not mean > reference:  # also where it is no number
        chance = "" if np.median(expert.returns) > 0 else ", that of random actions"
        warn(
            f"the expert's return {mean:.4g} is not above {reference:.4g}{chance}: no normalised "
            "return; check that expert and environment belong together"
        )
    for who, episodes in (("expert", expert), ("policy", student)):
        ended = episodes.given_up
        if ended.any():
            warn(
                f"{ended.sum()} of {len(ended)} episodes of the {who} were ended, for it had no "
                "answer for long; their returns are of shorter episodes"
            )


def _nearness(
    student: Episodes, expert: Expert, pool: EnvironmentPool
) -> tuple[float, float | None]:
    """Ask the expert on the student's own states.

    Returns:
        The mean distance of the actions as the environment takes them, NaN where the expert has no
        answer anywhere; and, where actions are choices, the share of the rows whose choices are
        all the same.
    """
    layout = pool.spaces.actions
    said = expert.ask(student.observations[student.valid], "evaluate")
    heard = ~has_none(said)  # where the expert has an answer
    if not heard.any():
        return float("nan"), None
    acted, said = (
        layout.centred(pool.bounds.put_inside(rows[heard])[0].astype(np.float64))
        for rows in (student.actions[student.valid], said)
    )
    distance = float(np.linalg.norm(acted - said, axis=1).mean())
    if not layout.choices:
        return distance, None
    return distance, float((layout.best(acted) == layout.best(said)).all(axis=1).mean())


def _survival(episodes: Episodes) -> float:
    """Return the share of the episodes that nothing ended before their time."""
    return float(1 - (episodes.terminated | episodes.given_up).mean())


def _reference_return(
    expert: Episodes, pool: EnvironmentPool, seeds: list[int], horizon: int, seed: int
) -> float:
    if np.median(expert.returns) > 0:
        return 0.0
    noise = [generator(seed, "random actions", episode) for episode in range(len(seeds))]
    return float(rollout(random_behaviour(pool), pool, seeds, horizon, noise).returns.mean())


def _share(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(ours.mean() / theirs.mean())


def _interval(ours: np.ndarray, theirs: np.ndarray, seed: int) -> tuple[float, float] | None:
    """Bootstrap the ratio of the means over pairs.

    A draw whose expert is not above the reference may stand for any ratio: it counts below the
    lower end and above the upper one. Where there are many of them, there is no interval.
    """
    if len(ours) < 2:
        return None
    largest = np.abs(theirs).argmax()  # a pair of zeros has every ratio
    if np.array_equal(ours * theirs[largest], theirs * ours[largest]):
        point = _share(ours, theirs)
        return point, point
    draws = generator(seed, "bootstrap").integers(len(ours), size=(_RESAMPLES, len(ours)))
    above, mine = theirs[draws].mean(axis=1), ours[draws].mean(axis=1)
    ratios = np.divide(mine, above, out=np.full(_RESAMPLES, np.inf), where=above > 0)
    low = np.quantile(np.where(above > 0, ratios, -np.inf), _OUTSIDE / 2, method="lower")
    high = np.quantile(ratios, 1 - _OUTSIDE / 2, method="higher")
    return (float(low), float(high)) if np.isfinite([low, high]).all() else None


def _imitation_gap(student: Episodes, expert: Episodes, own: int | None) -> float:
    """Return how far the paths are apart, in the environment's own observations."""
    theirs, ours = (
        replace(path, observations=path.observations[..., :own]) for path in (expert, student)
    )
    scales = measure_scales(theirs.observations[theirs.valid])
    return float(distances(theirs, ours, scales).mean())
