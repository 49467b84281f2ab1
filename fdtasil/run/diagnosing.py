"""Is it trained well enough, and what does the expert forgive: both are measured here."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch

from fdtasil.checks import check_count, check_flag
from fdtasil.compute import torch_settings
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.carrying import carry
from fdtasil.experts.examination import examine
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import ExpertLike, expert_in
from fdtasil.probes.calibration import calibrate
from fdtasil.probes.scales import (
    Scales,
    action_units,
    all_but,
    measure_following,
    measure_scales,
)
from fdtasil.progress import Progress
from fdtasil.results.conditions import conditions_of, errors_of
from fdtasil.results.diagnosis import Diagnosis
from fdtasil.results.distilled import Distilled
from fdtasil.results.fidelity import fidelity_of
from fdtasil.results.linearisation import linearise
from fdtasil.results.stability import distances, stability_of
from fdtasil.rollouts.behaviours import Policy, follow, follow_answers
from fdtasil.rollouts.environments import (
    EnvironmentLike,
    EnvironmentPool,
    resolve_horizon,
    simulator_warnings,
)
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.judging import (
    acting,
    finished_run,
    judged_in,
    judged_through,
    seen_by,
    warn_of_another_environment,
    warn_of_another_expert,
)
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import episode_seeds, generator
from fdtasil.student.view import StudentObservation

__all__ = ["diagnose"]

_STATES = 64
_NORMED = 8  # whose whole derivative is measured
_LOOKED = 4  # episodes whose loop is linearised, at three states each


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
    file, a function. Of one that sees several observations, the present one is moved alone; of
    one that sees a part, what follows linearly from that part is moved along.
    The expert is asked some eleven thousand times beside its episodes, and 48 times more for each
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
        steps: From the start of each episode, how many steps are disturbed and followed, at
            most `horizon`. Legged robots are chaotic: after a few dozen the smallest disturbance
            has led elsewhere.
        seed: Of starts and directions.
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        SettingError: If actions are choices, which nothing is between, all that is observed is
            choices, flags or whole numbers, or one of the two has a memory.
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
    followed, force = check_count("steps", steps), check_flag("force", force)
    student = finished_run(student)
    looked_at, student_obs, history = judged_through(student, None, 1)
    with EnvironmentPool(env) as pool, torch_settings(torch.device("cpu")):
        _check_numbers(pool)
        length = resolve_horizon(horizon, pool)
        starts = episode_seeds(seed, "evaluation", 0, count)
        present = np.arange(pool.boxes.observation_size)
        asked, judged = _opened(expert, looked_at, student_obs, pool, history)
        own = examine(asked, pool, starts, length, bars, force=force)
        visited = own.observations[own.valid]
        m = pool.boxes.action_size
        act = acting(judged, student_obs, visited, m, purpose="check")
        warn_of_another_environment(student, pool)
        warn_of_another_expert(student, asked)
        view = seen_by(judged, student_obs, visited)
        scales = _moved(visited, view.seen, present, pool.spaces.observations.held)
        units = action_units(pool.boxes.low, pool.boxes.high, own.actions[own.valid])
        pair = _Pair(pool, asked, act, scales, units, starts, seed, history > 1)
        pair.check_movable()
        return pair.diagnose(own, min(followed, length))


def _moved(
    visited: np.ndarray, seen: np.ndarray, present: np.ndarray, held: Sequence[int]
) -> Scales:
    """Return the scales of (N, n) states; what the student does not see, and follows, is led.

    What it does not see and follows from nothing is moved too: its expert answers to that.
    """
    n = visited.shape[1]
    free = np.isin(np.arange(n), present) & all_but(held, n)
    scales = measure_scales(visited)
    scales = replace(scales, live=scales.live & np.isin(np.arange(n), present))
    following = measure_following(visited, replace(scales, seen=seen & free), ~seen & free)
    led = replace(scales, following=following)
    return replace(led, seen=all_but(led.followers, n))


def _check_numbers(pool: EnvironmentPool) -> None:
    """Refuse an environment whose actions are choices."""
    if pool.spaces.actions.choices:
        raise SettingError(
            f"{pool.name}, whose actions are choices",
            "actions that are numbers: nothing is between two choices",
            "see evaluate(...).agreement",
        )


def _opened(
    expert: ExpertLike,
    student: ExpertLike,
    student_obs: StudentObservation | None,
    pool: EnvironmentPool,
    history: int,
) -> tuple[Expert, Expert]:
    """Return both policies, neither of which has a memory, in a pool that shows the past."""
    asked, judged = expert_in(expert, pool), judged_in(student, pool, student_obs, history)
    if asked.memory is not None or judged.memory is not None:
        raise SettingError(
            "a policy with a memory", "two that depend on the observation", "see evaluate()"
        )
    return carry(asked, pool, history)[0], judged


@dataclass(frozen=True)
class _Pair:
    """Expert and student in one environment.

    Attributes:
        pool: The environment.
        expert: Who is asked.
        act: (B, n) -> (B, m) of the student.
        scales: Of the states that the expert visits; of a past behind them nothing is live.
        units: (m,) that actions are measured in.
        starts: Seeds of the episodes.
        seed: Of directions and disturbances.
        shows_past: Whether the student sees more than the present observation.
    """

    pool: EnvironmentPool
    expert: Expert
    act: Policy
    scales: Scales
    units: np.ndarray
    starts: Sequence[int]
    seed: int
    shows_past: bool

    @property
    def _held(self) -> tuple[int, ...]:
        return self.pool.spaces.observations.held

    def check_movable(self) -> None:
        """Refuse states of which nothing can be moved a little."""
        if not np.delete(self.scales.probed("whitened"), list(self._held)).any():
            raise SettingError(
                f"{self.pool.name}, of whose observations nothing can be moved a little",
                "coordinates that are numbers, and not the same in every state",
                "see evaluate(...).agreement",
            )

    def diagnose(self, own: Episodes, steps: int) -> Diagnosis:
        """Measure both.

        Args:
            own: Episodes of the expert.
            steps: From the start of each episode, those that are disturbed and followed.
        """
        pool, scales, units, held = self.pool, self.scales, self.units, self._held
        ours, theirs = self._inside(self.act), self._inside(self.expert.policy("check"))
        random = generator(self.seed, "held-out directions")
        fidelity = fidelity_of(ours, theirs, own.spread(_STATES), units, scales, random, held)
        answers = self.expert.policy("evaluate")
        first = rollout(follow_answers(answers), pool, self.starts, steps)
        draws = episode_seeds(self.seed, "disturbances", 0, len(self.starts))
        stability = stability_of(self.expert, first, pool, steps, units, scales, draws)
        path = rollout(follow(self.act), pool, self.starts, steps)
        largest, unanswered = self._largest_error(path.observations[path.valid])
        looked = sorted({0, steps // 2, steps - 1})
        with simulator_warnings():
            loops = linearise(pool, answers, self.act, self.starts[:_LOOKED], looked)
        regime = self._regime(own)
        # The theorems are about students that see the present alone.
        beyond = regime == "steps" or self.shows_past
        law, errors = None if beyond else stability.law, None
        if law is not None:
            random = generator(self.seed, "directions of the theorems")
            errors = errors_of(ours, theirs, first.spread(_NORMED), units, scales, random, held)
        return Diagnosis(
            fidelity,
            stability,
            largest,
            stability.reached(largest) if largest else None,
            stability.law.gamma(largest) if stability.law and largest else None,
            float(distances(first, path, scales).max()),
            int((path.lengths < first.lengths).sum()),
            unanswered,
            sum(self.expert.queries.values()),
            loops,
            errors,
            conditions_of(errors, law) if errors and law else (),
            regime,
        )

    def _regime(self, own: Episodes) -> str | None:
        """Return how the expert answers; None where it does not, or always the same."""
        visited = own.observations[own.valid]
        moved = self.scales.live & all_but(self._held, visited.shape[1])
        about = measure_scales(visited, moved), generator(self.seed, "calibration")
        with suppress(ExpertError):
            found = calibrate(
                self.expert, visited, *about, PRESETS["standard"].radius, units=self.units
            )
            return found.regime if any(found.change) else None
        return None

    def _inside(self, policy: Policy) -> Policy:
        """Return a policy whose actions are what the environment takes them for."""
        return lambda observations: self.pool.bounds.put_inside(policy(observations))[0]

    def _largest_error(self, states: np.ndarray) -> tuple[float, float]:
        """Return the student's largest error, and the share of states without an answer."""
        theirs = self._inside(self.expert.policy("check"))
        apart = self._inside(self.act)(states) - theirs(states)
        error = np.linalg.norm(apart / self.units, axis=1)
        known = ~np.isnan(error)
        return float(np.max(error, where=known, initial=0.0)), float((~known).mean())
