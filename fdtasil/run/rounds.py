"""The rounds of a run: collect, label, probe, train; each stage is kept before the next begins."""

from dataclasses import dataclass, replace

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.states import label
from fdtasil.demonstrations.trainers import Situation
from fdtasil.probes.answers import Answers
from fdtasil.rollouts.behaviours import Behaviour
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes, check_episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.events import Event
from fdtasil.run.state import RunState
from fdtasil.run.training import Training
from fdtasil.seeding import episode_seeds, generator

__all__ = ["Rounds"]


@dataclass(frozen=True)
class Rounds:
    """In which order the state of a run grows.

    Attributes:
        pool: The environment; None where nothing has to be recorded.
        training: Makes each round's student, and holds what grows.
    """

    pool: EnvironmentPool | None
    training: Training

    @property
    def state(self) -> RunState:
        """What grows."""
        return self.training.state

    def all(self) -> None:
        """Do every round, beginning where the folder's checkpoints end."""
        state, run = self.state, self.state.run
        counts = run.trainer.rounds(run.episodes) if run.trainer else [0]
        for round_, count in enumerate(counts):
            if not state.restore_collected(round_):
                if run.trainer:
                    self._collect(round_, count)
                elif run.probes and not run.probes_given:
                    self._probe(state.data.demonstrations.observations, 0, None)
                state.keep_collected(round_)
            if not state.restore_trained(round_):
                with self.training.interrupts.held_back():
                    self.training.round(round_)
                    state.keep_trained(round_)
            event = Event("round", round_, state.steps, state.history[-1], state.student)
            self.training.callback(event)

    def _collect(self, round_: int, count: int) -> None:
        """Record `count` episodes, label their states and ask the probes around them."""
        state, before = self.state, self.state.dataset
        recorded = state.restore_recorded(round_)
        if recorded is None:
            recorded = self._labelled(round_, count)
            if state.run.probes is not None:  # else the round is kept as a whole in a moment
                state.keep_recorded(round_, recorded)
        new, state.dataset, old = recorded.demonstrations, recorded, None
        if before is not None:
            state.dataset = replace(before, demonstrations=before.demonstrations + new)
            old = before.answers
        if state.run.probes is not None:
            self._probe(new.observations, round_, old)

    def _labelled(self, round_: int, count: int) -> Dataset:
        """Record `count` episodes and label their states."""
        state, pool = self.state, self.pool
        assert state.expert is not None
        assert pool is not None
        recorded = self._record(
            pool, self._behaviour(pool, round_), "rollout", state.episodes, count
        )
        if round_ == 0:  # every trainer's expert acts alone there
            check_episodes(recorded, pool.name)
        new = label(recorded, state.expert, state.episodes, round_)
        state.count(recorded)
        return Dataset(new, None, None, pool.boxes.low, pool.boxes.high, pool.name)

    def _probe(self, observations: np.ndarray, round_: int, old: Answers | None) -> None:
        """Ask the probes around states, and join the answers to those of earlier rounds."""
        state = self.state
        with self.training.stages.stage("probes", len(observations), "state") as move:
            answers = state.ask_collected(observations, round_, move)
        answers = old + answers if old is not None else answers
        state.dataset = replace(state.data, probes=state.source, answers=answers)

    def _behaviour(self, pool: EnvironmentPool, round_: int) -> Behaviour:
        """Return who acts in a round, which may take a few more episodes to find out."""
        state, trainer = self.state, self.state.run.trainer
        assert state.expert is not None
        assert trainer is not None

        def record_extra(behaviour: Behaviour, extra: int) -> Episodes:
            return self._record(pool, behaviour, f"extra {round_}", 0, extra)

        policy = state.view.policy(state.student.act) if state.student else None
        return trainer.behaviour(Situation(round_, state.expert, policy, record_extra))

    def _record(
        self, pool: EnvironmentPool, behaviour: Behaviour, stream: str, first: int, count: int
    ) -> Episodes:
        run, numbers = self.state.run, range(first, first + count)
        noise = [generator(run.seed, f"{stream} noise", episode) for episode in numbers]
        seeds = episode_seeds(run.seed, stream, first, count)
        total = count * run.horizon
        with self.training.stages.stage("demonstrations", total, "step") as move:
            return rollout(behaviour, pool, seeds, run.horizon, noise, move)
