"""Is it trained well enough, and what does the expert forgive: measured and bounded."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fdtasil.checks import check_count, check_flag
from fdtasil.compute import torch_settings
from fdtasil.errors import SettingError
from fdtasil.experts.examination import examine
from fdtasil.experts.load import ExpertLike, expert_in, sized
from fdtasil.files.plain import to_plain
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Progress
from fdtasil.results.conditions import Condition, Errors, conditions_of, errors_of
from fdtasil.results.distilled import Distilled
from fdtasil.results.fidelity import GOOD, USUAL, Fidelity, fidelity_of
from fdtasil.results.linearisation import Linearisation, linearise
from fdtasil.results.stability import Stability, distances, stability_of
from fdtasil.rollouts.behaviours import Policy, follow
from fdtasil.rollouts.environments import (
    EnvironmentLike,
    EnvironmentPool,
    resolve_horizon,
    simulator_warnings,
)
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.judging import judged_in, judged_through
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
        fidelity: Errors of the student's differences, by radius, beside the expert's noise.
        stability: What the expert's closed loop makes of small disturbances of its actions.
        largest_error: Largest error of the student on its own path, in units of half an action's
            range, averaged over episodes.
        bound: gamma(largest_error): how far from the expert's path that can lead, in deviations;
            None where no law was found.
        gap: How far it did lead: largest distance of the two paths, averaged over episodes.
        queries: Rows that the expert answered.
        linearisation: Eigenvalues of both closed loops along the expert's path; None where the
            environment is no MuJoCo environment of gymnasium.
        errors: Of the student's action and derivative at states of the expert's first steps, as
            the theorems ask for; None where no law was found, the expert has no answer around
            them, or not one coordinate moves, or more than 1,000.
        conditions: TaSIL's statements that are about such a loop, with these constants; none where
            no law was found.
    """

    fidelity: Fidelity
    stability: Stability
    largest_error: float
    bound: float | None
    gap: float
    queries: int
    linearisation: Linearisation | None = None
    errors: Errors | None = None
    conditions: tuple[Condition, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis as plain JSON values."""
        return to_plain(self)

    def __str__(self) -> str:
        found, loop = self.fidelity, self.stability
        lines = [
            f"its reactions are off by {found.error:.0%} of its expert's at a radius of {USUAL}; "
            f"{GOOD}",
            "derivatives, error relative to the expert's own differences (expert's noise)",
        ]
        for radius, error, floor in zip(found.radii, found.errors, found.floors, strict=True):
            lines.append(f"  radius {radius:<5g} {error:8.1%}   ({floor:.1%})")
        lines.append(f"  actions      {found.action_error:8.1%}   of how the expert's vary")
        lines.append("the expert's closed loop, disturbance -> largest deviation")
        for size, deviation in zip(loop.sizes, loop.deviations, strict=True):
            lines.append(f"  {size:<8g} {deviation:10.2g}")
        if loop.exponent is None or loop.interval is None:
            lines.append("  no power law: deviations are rounding, or as large as the states vary")
        else:
            low, high = loop.interval
            order = "none up to 9" if loop.order is None else str(loop.order)
            lines.append(
                f"  gamma(e) = {loop.constant:.2g} * e^{loop.exponent:.2f} [{low:.2f}, {high:.2f}]"
                f"; order that theorem 3.2 asks for: {order}"
            )
        if loop.rate is not None:
            lines.append(f"  after one disturbed action: times {loop.rate:.3g} in each step")
        law = "no law, no bound" if self.bound is None else f"at most {self.bound:.2g} by that law"
        lines.append(f"the student's largest error on its own path: {self.largest_error:.2g}")
        lines.append(f"its distance to the expert's path: {self.gap:.2g} deviations ({law})")
        if self.linearisation is not None:
            lines.append(f"linearised loops: {self.linearisation}")
        if self.errors is not None:
            lines.append(f"on the expert's path: {self.errors}")
        if self.conditions:
            lines.append("TaSIL's conditions with these constants, measured at a few states")
            lines += [f"  {condition}" for condition in self.conditions]
        return "\n".join(lines)


def diagnose(
    student: ExpertLike | Distilled,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 10,
    horizon: int | None = None,
    steps: int = 25,
    seed: int = 0,
    progress: bool = True,
) -> Diagnosis:
    """Measure how well a student's derivatives are its expert's, and what the expert forgives.

    Nothing is trained, and the student may be anybody's: a result or the folder of a run, an ONNX
    file, a function.
    The expert is asked some thousand times beside its episodes, and 48 times more for each
    coordinate where its loop follows a law.

    What it can't say: the fitted law is of these starts, these steps and lasting disturbances of
    one direction. TaSIL's theorems ask for one that holds everywhere. The bound of the student's
    path is exact for a law that does, and the measured errors are those of one path.

    Args:
        student: Who is looked at: as `policy` of `evaluate`.
        expert: Who it is to be like.
        env: As in `distill`.
        episodes: From as many starts.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        steps: From the start of each episode, how many steps are disturbed and followed. Legged
            robots are chaotic: after a few dozen the smallest disturbance has led elsewhere.
        seed: Of starts and directions.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        SettingError: If actions are choices, which nothing is between.
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
        own = examine(asked, pool, starts, length, bars, force=False)
        visited = own.observations[own.valid]
        seen = judged.columns if student_obs is None else student_obs
        view = View.of(visible(seen, n, 0), visited[:256])
        act = view.policy(sized(judged, view.size, pool.boxes.action_size).policy("check"))
        scales, boxes = measure_scales(visited), pool.boxes
        with np.errstate(invalid="ignore"):  # of infinite bounds, which are not chosen
            units = np.where(boxes.bounded, (boxes.high - boxes.low) / 2, 1.0)
        random = generator(seed, "held-out directions")
        held = pool.spaces.observations.held
        fidelity = fidelity_of(act, asked, own.spread(_STATES), scales, random, held)
        noise = [generator(seed, "disturbances", number) for number in range(count)]
        short = min(check_count("steps", steps), length)
        first = rollout(follow(asked.policy("evaluate")), pool, starts, short)
        stability = stability_of(asked, first, pool, short, units, scales, noise)
        path = rollout(follow(act), pool, starts, short)
        errors = np.zeros(path.valid.shape)
        there = path.observations[path.valid]
        ours, theirs = (_inside(policy, pool) for policy in (act, asked.policy("check")))
        apart = (ours(there) - theirs(there)) / units
        errors[path.valid] = np.linalg.norm(np.nan_to_num(apart), axis=1)
        largest = float(errors.max(axis=1).mean())
        gap = float(distances(first, path, scales).mean())
        looked = sorted({0, short // 2, short - 1})
        with simulator_warnings():
            loops = linearise(pool, asked.policy("evaluate"), act, starts[:_LOOKED], looked)
        found = None
        if stability.constant is not None:
            asking = generator(seed, "directions of the theorems")
            found = errors_of(ours, theirs, first.spread(_NORMED), units, scales, asking, held)
        return Diagnosis(
            fidelity,
            stability,
            largest,
            stability.gamma(largest),
            gap,
            sum(asked.queries.values()),
            loops,
            found,
            () if found is None else conditions_of(found, stability),
        )


def _inside(policy: Policy, pool: EnvironmentPool) -> Policy:
    """Return a policy whose actions are what the environment takes them for."""
    return lambda observations: pool.bounds.put_inside(policy(observations))[0]
