"""Recording and labelling the episodes of a round, whoever its trainer lets act."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.states import label
from fdtasil.demonstrations.trainers import Situation, Trainer
from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.progress import Progress
from fdtasil.rollouts.behaviours import Behaviour, Policy, farthest_apart
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes, check_episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.rollouts.survivors import SURVIVORS, survivors
from fdtasil.run.checkpoints import Collected
from fdtasil.seeding import episode_seeds, generator

__all__ = ["Collecting"]

_ASKED_AGAIN = 16  # states of an interrupted run
_SAME = 1e-3  # of two answers, relative to the largest of an action


@dataclass(frozen=True)
class Collecting:
    """Records episodes.

    Attributes:
        trainer: Who acts in which round.
        expert: Labels what was visited.
        pool: The environment.
        horizon: T, steps after which an episode is cut.
        seed: Of starts and noise.
        progress: Progress bars.
        keep: Which of the expert's own episodes are kept.
        history: How many observations the student sees.
        remembered: Length of the expert's memory.
    """

    trainer: Trainer
    expert: Expert
    pool: EnvironmentPool
    horizon: int
    seed: int
    progress: Progress
    keep: str
    history: int
    remembered: int

    def record(
        self, round_: int, count: int, before: Collected | None, student: Policy | None
    ) -> Collected:
        """Record and label `count` episodes.

        Args:
            round_: The round.
            count: Number of episodes.
            before: What earlier rounds have collected.
            student: The last round's policy; None in round 0.

        Returns:
            The dataset of these episodes alone, and the counts of all.
        """
        first = before.episodes if before else 0
        behaviour = self._behaviour(round_, student)
        episodes = self._episodes(behaviour, "rollout", first, count)
        if round_ == 0:  # every trainer's expert acts there
            check_episodes(episodes, self.pool.name)
        replaced = 0
        if round_ == 0 and self.keep == SURVIVORS:

            def further(first: int, places: Sequence[int]) -> Episodes:
                behaviour = self._behaviour(0, None, places)
                return self._episodes(behaviour, "survivors", first, len(places))

            episodes, replaced = survivors(episodes, further, self.pool.name)
        states = label(episodes, self.expert, first, round_)
        boxes, counts = self.pool.boxes, Counter(before.counts if before else {})
        counts["clipped_actions"] += episodes.clipped_actions
        counts["physics_resets"] += int(episodes.physics_resets.sum())
        counts["terminated_episodes"] += int(episodes.terminated.sum())
        counts["replaced_episodes"] += replaced
        counts["given_up_episodes"] += int(episodes.given_up.sum())
        spaces = self.pool.spaces.unless_plain
        about = self.pool.name, spaces, self.history, self.remembered
        dataset = Dataset(states, None, None, boxes.low, boxes.high, *about)
        return Collected(dataset, first + len(episodes.valid), counts)

    def check_kept(self, kept: Collected) -> None:
        """Refuse to go on where another expert labelled the states that are there.

        Args:
            kept: What an interrupted run has collected.

        Raises:
            SettingError: If the expert answers otherwise than it did.
        """
        states = kept.dataset.demonstrations
        chosen = np.linspace(0, len(states) - 1, min(len(states), _ASKED_AGAIN)).astype(int)
        rows, stored = states.observations[chosen], states.actions[chosen]
        # A law at its bounds shows at the states themselves nothing of what it is around them.
        moved, said = kept.dataset.around(chosen)
        rows, stored = np.concatenate([rows, moved]), np.concatenate([stored, said])
        answers = self.expert.ask(rows, "check")
        # A planner that found nothing this time is no other expert.
        sizes = np.abs(states.actions).max(axis=0)  # of each: one in millimetres is no measure
        bound = _SAME * np.maximum(sizes, _SAME * sizes.max()) + np.finfo(np.float32).tiny
        apart = np.nan_to_num((np.abs(answers - stored) / bound).max(axis=1), nan=0.0)
        if (apart <= 1).all():
            return
        if farthest_apart(self.expert.ask(rows, "check") / bound, answers / bound) > 1:
            return  # one that does not repeat itself either was let through the gate
        worst = int(apart.argmax())
        raise SettingError(
            f"the run was begun with another expert: at state {chosen[worst % len(chosen)]}"
            f"{', moved by a probe,' * (worst >= len(chosen))} it answered "
            f"{np.round(stored[worst], 4).tolist()}, now {np.round(answers[worst], 4).tolist()}",
            f"the expert that labelled the {len(states):,} states that are kept",
            "resume with that expert, or start anew in another folder",
        )

    def _behaviour(
        self, round_: int, student: Policy | None, places: Sequence[int] | None = None
    ) -> Behaviour:
        """Return who acts in a round, which may take a few more episodes to find out."""

        def record_extra(behaviour: Behaviour, extra: int) -> Episodes:
            return self._episodes(behaviour, f"extra {round_}", 0, extra)

        boxes = self.pool.boxes
        half = np.where(boxes.bounded, (boxes.high - boxes.low) / 2, np.float32(1))
        chooses = bool(self.pool.spaces.actions.choices)
        situation = Situation(round_, self.expert, half, student, record_extra, chooses, places)
        return self.trainer.behaviour(situation)

    def _episodes(self, behaviour: Behaviour, stream: str, first: int, count: int) -> Episodes:
        numbers = range(first, first + count)
        noise = [generator(self.seed, f"{stream} noise", episode) for episode in numbers]
        seeds = episode_seeds(self.seed, stream, first, count)
        with self.progress.bar("demonstrations", "step", count * self.horizon) as bar:
            return rollout(behaviour, self.pool, seeds, self.horizon, noise, bar.move)
