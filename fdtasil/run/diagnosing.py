"""Is it trained well enough, and what does the expert forgive: what can be measured of both."""

import html
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fdtasil.checks import check_count, check_flag
from fdtasil.compute import torch_settings
from fdtasil.errors import SettingError
from fdtasil.experts.examination import examine
from fdtasil.experts.load import ExpertLike, expert_in, sized
from fdtasil.files.plain import to_plain, without_infinities
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Progress
from fdtasil.results.conditions import Condition, Errors, conditions_of, errors_of
from fdtasil.results.distilled import Distilled
from fdtasil.results.fidelity import GOOD, USUAL, Fidelity, fidelity_of
from fdtasil.results.linearisation import Linearisation, linearise
from fdtasil.results.stability import Stability, distances, stability_of
from fdtasil.rollouts.behaviours import Policy, follow, follow_answers
from fdtasil.rollouts.environments import (
    EnvironmentLike,
    EnvironmentPool,
    resolve_horizon,
    simulator_warnings,
)
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.judging import (
    finished_run,
    judged_in,
    judged_through,
    warn_of_another_environment,
)
from fdtasil.run.subject import visible
from fdtasil.seeding import episode_seeds, generator
from fdtasil.student.view import View, view_size

__all__ = ["Diagnosis", "diagnose"]

_STATES = 64
_NORMED = 8  # whose whole derivative is measured
_LOOKED = 4  # episodes whose loop is linearised, at three states each


@dataclass(frozen=True)
class Diagnosis:
    """What was measured of a student and its expert.

    Attributes:
        fidelity: Errors of the student's differences, by radius, beside the expert's roughness.
        stability: What the expert's closed loop makes of small disturbances of its actions.
        largest_error: Largest error of the student on its own paths, in units of half an action's
            range, where the expert has an answer.
        disturbed: How far disturbances of the expert led that were as large, in deviations; None
            where none were, or the student makes no error.
        by_law: gamma(largest_error): how far that leads by the measured law; None where no law was
            found, or the student makes no error. Both are lower estimates of what can happen, and
            no bounds.
        gap: How far it did lead: largest distance of the two paths of any episode.
        ended: Of how many episodes the student's path ended before the expert's: their distance
            is at least what was seen.
        unanswered: Share of the student's states at which the expert has no answer.
        queries: Rows that the expert answered.
        linearisation: Eigenvalues of both closed loops along the expert's path; None where the
            environment is no MuJoCo environment of gymnasium, or its actions are no controls.
        errors: Of the student's action and derivative at states of the expert's first steps, as
            the theorems ask for; None where no law was found, the expert has no answer around
            them, or not one coordinate moves, or more than 1,000.
        conditions: TaSIL's statements that are about such a loop, with these constants; none where
            no law was found.
    """

    fidelity: Fidelity
    stability: Stability
    largest_error: float
    disturbed: float | None
    by_law: float | None
    gap: float
    ended: int
    unanswered: float
    queries: int
    linearisation: Linearisation | None = None
    errors: Errors | None = None
    conditions: tuple[Condition, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis as plain JSON values; null for what is no number, or infinite."""
        return without_infinities(to_plain(self))[0]

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"

    def __str__(self) -> str:
        lines = [*_of_fidelity(self.fidelity), *_of_stability(self.stability)]
        silent = f", not known at {self.unanswered:.0%} of it" if self.unanswered else ""
        lines.append(
            f"the student's largest error on its own path: {self.largest_error:.2g}{silent}"
        )
        least = f", at least: {self.ended} ended before the expert's" if self.ended else ""
        lines.append(f"its distance to the expert's path: {self.gap:.2g} deviations{least}")
        if self.disturbed is not None:
            lines.append(f"  disturbances of the expert as large led {self.disturbed:.2g} away")
        if self.by_law is not None and self.stability.law is not None:
            most = self.stability.law.reach[1]
            beyond = f"; it was measured up to {most:.1g}" if self.largest_error > most else ""
            lines.append(f"  by the measured law: {self.by_law:.2g}{beyond}")
        if self.linearisation is not None:
            lines.append(f"linearised loops: {self.linearisation}")
        if self.errors is not None:
            lines.append(f"on the expert's path: {self.errors}")
        if self.conditions:
            lines.append("TaSIL's conditions, were these constants true everywhere")
            lines += [f"  {condition}" for condition in self.conditions]
        return "\n".join(lines)


def _of_fidelity(found: Fidelity) -> list[str]:
    if np.isnan(found.error):
        first = f"its expert does not react at a radius of {USUAL}, or has no answers there"
    elif np.isinf(found.error):
        first = f"it has no answer at some states, at a radius of {USUAL} from its expert's"
    else:
        first = (
            f"its reactions are off by {found.error:.0%} of its expert's at a radius of {USUAL}"
        )
        first += f"; {GOOD}"
    lines = [first, "derivatives, error relative to the expert's own differences (its roughness)"]
    for radius, error, rough in zip(found.radii, found.errors, found.roughness, strict=True):
        lines.append(f"  radius {radius:<5g} {_percent(error):>8}   ({_percent(rough)})")
    lines.append(f"  actions      {_percent(found.action_error):>8}   of how the expert's vary")
    if found.answered < 1:
        lines.append(f"  the expert has answers at {found.answered:.0%} of the moved states")
    return lines


def _percent(share: float) -> str:
    return f"{share:.1%}" if np.isfinite(share) else "-" if np.isnan(share) else "infinite"


def _of_stability(loop: Stability) -> list[str]:
    lines = ["the expert's closed loop, disturbance -> largest deviation"]
    for size, deviation, ended in zip(loop.sizes, loop.deviations, loop.ended, strict=True):
        early = f"   ({ended} episodes ended early)" if ended else ""
        lines.append(f"  {size:<8.2g} {deviation:10.2g}{early}")
    law = "no power law: rounding, as large as the states vary, or another shape"
    lines.append(f"  {loop.law or law}")
    if loop.rate is not None:
        between = loop.rate_interval
        interval = f" [{between[0]:.3g}, {between[1]:.3g}]" if between else ""
        lines.append(f"  after one disturbed action: times {loop.rate:.3g}{interval} in each step")
    return lines


def diagnose(
    student: ExpertLike | Distilled,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 10,
    horizon: int | None = None,
    steps: int = 25,
    seed: int = 0,
    force: bool = False,
    progress: bool = True,
) -> Diagnosis:
    """Measure how well a student's derivatives are its expert's, and what the expert forgives.

    Nothing is trained, and the student may be anybody's: a result or the folder of a run, an ONNX
    file, a function.
    The expert is asked some ten thousand times beside its episodes, and 48 times more for each
    coordinate where its loop follows a law.

    What it can't say: the fitted law is of these starts, these steps and these disturbances.
    TaSIL's theorems ask for one that holds everywhere. What another disturbance leads to can be
    more, so no bound is measured; and the errors are those of these paths.

    Args:
        student: Who is looked at: as `policy` of `evaluate`.
        expert: Who it is to be like.
        env: As in `distill`.
        episodes: From as many starts.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        steps: From the start of each episode, how many steps are disturbed and followed. Legged
            robots are chaotic: after a few dozen the smallest disturbance has led elsewhere.
        seed: Of starts and directions.
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        SettingError: If actions are choices, which nothing is between, or all that is observed
            is choices, flags or whole numbers.
        ExpertError: If one of the two can't be opened, or the expert fails the gate.
        EnvironmentFault: If the environment can't be used, or misbehaves.

    Example:
        >>> def swing(rows):
        ...     return np.clip(-8 * np.arctan2(rows[:, 1:2], rows[:, :1]) - 2 * rows[:, 2:], -2, 2)
        >>> found = diagnose(swing, swing, "Pendulum-v1", episodes=2, horizon=20, progress=False)
        >>> found.fidelity.error, found.gap
        (0.0, 0.0)
    """
    count, bars = check_count("episodes", episodes, 2), Progress(check_flag("progress", progress))
    check_count("seed", seed, 0, 2**32 - 1)
    force = check_flag("force", force)
    student = finished_run(student)
    looked_at, student_obs, history = judged_through(student, None, 1)
    if history > 1:
        raise SettingError(
            f"a student that sees {history} observations", "one that sees one", "see evaluate()"
        )
    with EnvironmentPool(env) as pool, torch_settings(torch.device("cpu")):
        if pool.spaces.actions.choices:
            raise SettingError(
                f"{pool.name}, whose actions are choices",
                "actions that are numbers: nothing is between two choices",
                "see evaluate(...).agreement",
            )
        n, length = pool.boxes.observation_size, resolve_horizon(horizon, pool)
        asked = expert_in(expert, pool)
        judged = judged_in(looked_at, pool, view_size(student_obs, n), whole=student_obs is None)
        if asked.memory is not None or judged.memory is not None:
            raise SettingError(
                "a policy with a memory", "two that depend on the observation", "see evaluate()"
            )
        starts = episode_seeds(seed, "evaluation", 0, count)
        own = examine(asked, pool, starts, length, bars, force=force)
        visited = own.observations[own.valid]
        seen = judged.columns if student_obs is None else student_obs
        view = View.of(visible(seen, n, 0), visited[:256])
        act = view.policy(sized(judged, view.size, pool.boxes.action_size).policy("check"))
        warn_of_another_environment(student, pool)
        scales, boxes = measure_scales(visited), pool.boxes
        held = pool.spaces.observations.held
        if not np.delete(scales.probed("whitened"), list(held)).any():
            raise SettingError(
                f"{pool.name}, of whose observations nothing can be moved a little",
                "coordinates that are numbers, and not the same in every state",
                "see evaluate(...).agreement",
            )
        with np.errstate(invalid="ignore"):  # of infinite bounds, which are not chosen
            units = np.where(boxes.bounded, (boxes.high - boxes.low) / 2, 1.0)
        ours, theirs = (_inside(policy, pool) for policy in (act, asked.policy("check")))
        random = generator(seed, "held-out directions")
        fidelity = fidelity_of(ours, theirs, own.spread(_STATES), units, scales, random, held)
        draws = episode_seeds(seed, "disturbances", 0, count)
        short = min(check_count("steps", steps), length)
        first = rollout(follow_answers(asked.policy("evaluate")), pool, starts, short)
        stability = stability_of(asked, first, pool, short, units, scales, draws)
        path = rollout(follow(act), pool, starts, short)
        there = path.observations[path.valid]
        error = np.linalg.norm((ours(there) - theirs(there)) / units, axis=1)
        known = ~np.isnan(error)
        largest = float(np.max(error, where=known, initial=0.0))
        looked = sorted({0, short // 2, short - 1})
        with simulator_warnings():
            loops = linearise(pool, asked.policy("evaluate"), act, starts[:_LOOKED], looked)
        law, found = stability.law, None
        if law is not None:
            asking = generator(seed, "directions of the theorems")
            found = errors_of(ours, theirs, first.spread(_NORMED), units, scales, asking, held)
        return Diagnosis(
            fidelity,
            stability,
            largest,
            stability.reached(largest) if largest else None,
            law.gamma(largest) if law and largest else None,
            float(distances(first, path, scales).max()),
            int((path.lengths < first.lengths).sum()),
            float((~known).mean()),
            sum(asked.queries.values()),
            loops,
            found,
            conditions_of(found, law) if found and law else (),
        )


def _inside(policy: Policy, pool: EnvironmentPool) -> Policy:
    """Return a policy whose actions are what the environment takes them for."""
    return lambda observations: pool.bounds.put_inside(policy(observations))[0]
