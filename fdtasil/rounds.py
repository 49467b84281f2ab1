"""One round of a run: collect, label, probe, fit."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import torch

from fdtasil.demonstrations import (
    Answers,
    Demonstrations,
    Statistics,
    ask_probes,
    label,
    statistics,
)
from fdtasil.environments import EnvironmentPool
from fdtasil.experts import Expert
from fdtasil.fit import Fit, fit
from fdtasil.probes import Probes
from fdtasil.progress import Stages
from fdtasil.rollouts import Behaviour, Episodes, rollout
from fdtasil.seeding import episode_seeds, generator, torch_generator
from fdtasil.student import Student, StudentShape
from fdtasil.trainers import Situation, Trainer

__all__ = ["Rounds"]


@dataclass
class Rounds:
    """What grows from round to round: demonstrations, answers, counts.

    Attributes:
        expert: Who labels and answers probes.
        pool: The environment.
        probes: The derivative source, completed by the preset; None for plain cloning.
        seed: The run's.
        stages: Progress bars.
        demonstrations: All labelled states so far; None before the first round.
        scales: Of the observations of round 0, frozen.
        answers: To the probes of all states so far.
        episodes: Number of episodes recorded so far.
        steps: Number of gradient steps so far.
        counts: Clipped actions, physics resets and falls of the recorded episodes.
    """

    expert: Expert
    pool: EnvironmentPool
    probes: Probes | None
    seed: int
    stages: Stages
    demonstrations: Demonstrations | None = None
    scales: Statistics | None = None
    answers: Answers | None = None
    episodes: int = 0
    steps: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    def collect(
        self, round_: int, count: int, trainer: Trainer, student: Student | None, horizon: int
    ) -> None:
        """Record `count` episodes, label their states and ask the probes around them."""

        def record_extra(behaviour: Behaviour, extra: int) -> Episodes:
            return self._record(behaviour, f"extra {round_}", 0, extra, horizon)

        policy = student.act if student else None
        situation = Situation(round_, self.expert, policy, record_extra)
        first = self.episodes
        recorded = self._record(trainer.behaviour(situation), "rollout", first, count, horizon)
        new = label(recorded, self.expert, first, round_)
        self.episodes += count
        self.counts["clipped_actions"] += recorded.clipped_actions
        self.counts["physics_resets"] += recorded.physics_resets
        self.counts["terminated_episodes"] += int(recorded.terminated.sum())
        self.demonstrations = self.demonstrations + new if self.demonstrations else new
        self.scales = self.scales or statistics(new.observations)
        if self.probes is not None:
            answers = self._ask(new.observations, self.episodes, 0)
            self.answers = self.answers + answers if self.answers else answers

    def _record(
        self, behaviour: Behaviour, stream: str, first: int, count: int, horizon: int
    ) -> Episodes:
        numbers = range(first, first + count)
        noise = [generator(self.seed, f"{stream} noise", episode) for episode in numbers]
        seeds = episode_seeds(self.seed, stream, first, count)
        with self.stages.stage("demonstrations", count * horizon, "step") as move:
            return rollout(behaviour, self.pool, seeds, horizon, noise, move)

    def train(
        self, round_: int, shape: StudentShape, settings: Fit, device: torch.device
    ) -> tuple[Student, list[dict[str, float]]]:
        """Train a fresh student on all demonstrations; return it with its history."""
        assert self.scales is not None, "collect comes first"
        bounds = self.pool.boxes.low, self.pool.boxes.high
        random = torch_generator(self.seed, "student", round_)
        student = Student(shape, self.scales.mean, self.scales.scale, *bounds, random).to(device)
        total = settings.total_steps(len(self.labelled))
        self.steps += total
        with self.stages.stage(f"training, round {round_}", total, "step") as move:
            entries = fit(
                student,
                self.labelled,
                self.probes,
                self._pool_of_answers if self.probes else None,
                settings,
                torch_generator(self.seed, "batches", round_),
                move,
            )
        return student.cpu(), [{"round": round_, **entry} for entry in entries]

    @property
    def labelled(self) -> Demonstrations:
        """All labelled states; `collect` comes first."""
        assert self.demonstrations is not None, "collect comes first"
        return self.demonstrations

    @property
    def frozen_coordinates(self) -> int:
        """Number of coordinates that did not move in round 0."""
        assert self.scales is not None, "collect comes first"
        return int((~self.scales.live).sum())

    def _pool_of_answers(self, number: int) -> Answers:
        """Return the stored answers, or for a later number those of new directions."""
        if number == 0:
            assert self.answers is not None, "collect comes first"
            return self.answers
        return self._ask(self.labelled.observations, self.episodes, number)

    def _ask(self, observations: np.ndarray, *path: int) -> Answers:
        assert self.probes is not None
        assert self.scales is not None
        random = generator(self.seed, "probes", *path)
        return ask_probes(self.expert, observations, self.probes, self.scales, random)
