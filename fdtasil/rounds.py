"""The rounds of a run: collect, label, probe, fit; each stage is kept before the next begins."""

import json
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from fdtasil.answers import Answers, ask_probes
from fdtasil.calibration import Calibration, calibrate
from fdtasil.configuration import Configuration
from fdtasil.datasets import Dataset
from fdtasil.demonstrations import label
from fdtasil.environments import EnvironmentPool
from fdtasil.errors import FdtasilWarning, SettingError
from fdtasil.evaluation import check_episodes
from fdtasil.events import Callback, Event
from fdtasil.experts import Expert
from fdtasil.fit import Hooks, fit
from fdtasil.fitstate import FitState
from fdtasil.interrupts import Interrupts
from fdtasil.probes import Probes
from fdtasil.progress import Stages
from fdtasil.rollouts import Behaviour, Episodes, rollout
from fdtasil.runfolder import RunFolder
from fdtasil.scales import Statistics, statistics
from fdtasil.seeding import episode_seeds, generator, torch_generator
from fdtasil.storage import to_json
from fdtasil.student import Student, StudentShape
from fdtasil.trainers import Situation
from fdtasil.views import StudentObservation, View

__all__ = ["CHECKPOINT_SECONDS", "Rounds"]

CHECKPOINT_SECONDS = 20.0
"""Time between two checkpoints inside a training; when they are taken changes no byte."""


@dataclass
class Rounds:
    """What grows from round to round, and how it grows.

    Attributes:
        run: The configuration.
        expert: Who labels and answers probes; None where nothing has to be asked.
        pool: The environment; None where nothing has to be recorded.
        student_obs: What the student sees; None for everything.
        device: Where the student is trained.
        stages: Progress bars.
        folder: Where every stage is kept.
        interrupts: Which wait for a checkpoint while a student is trained.
        callback: Told of events.
        dataset: All labelled states so far and the answers around them.
        student: The last round's.
        history: Entries of all rounds.
        steps: Gradient steps of all rounds.
        episodes: Number of episodes recorded so far.
        counts: Clipped actions, physics resets and falls of the recorded episodes.
        calibration: What was found about the expert in the first round, or None.
        source: The derivative source, with what the calibration found filled in.
        again: Rows asked before a checkpoint was taken up, which the interrupted run has asked
            and counted too; None in a run that was not interrupted.
    """

    run: Configuration
    expert: Expert | None
    pool: EnvironmentPool | None
    student_obs: StudentObservation | None
    device: torch.device
    stages: Stages
    folder: RunFolder
    interrupts: Interrupts
    callback: Callback
    dataset: Dataset | None = None
    student: Student | None = None
    history: list[dict[str, float]] = field(default_factory=list)
    steps: int = 0
    episodes: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    again: int | None = None
    calibration: Calibration | None = None
    source: Probes | None = field(init=False)

    def __post_init__(self) -> None:
        self.source = self.run.probes

    def all(self) -> None:
        """Do every round, beginning where the folder's checkpoints end."""
        counts = self.run.trainer.rounds(self.run.episodes) if self.run.trainer else [0]
        for round_, count in enumerate(counts):
            if not self._restore_collected(round_):
                if self.run.trainer:
                    self._collect(round_, count)
                elif self.run.probes and not self.run.probes_given:
                    self._probe_given()
                self._keep_collected(round_)
            if not self._restore_trained(round_):
                with self.interrupts.held_back():
                    self._train(round_)
                    self._keep_trained(round_)
            self.callback(Event("round", round_, self.steps, self.history[-1], self.student))

    @property
    def data(self) -> Dataset:
        """The dataset; the first round has made it, or it was given."""
        assert self.dataset is not None
        return self.dataset

    @property
    def trained(self) -> Student:
        """The last round's student."""
        assert self.student is not None, "every run has a round"
        return self.student

    @property
    def view(self) -> View:
        """What the student sees."""
        states = self.data.demonstrations
        return View.of(self.student_obs, states.observations[states.round == 0][:256])

    @property
    def scales(self) -> Statistics:
        """Scales of all states so far: the first episode may be a fall of three steps."""
        return statistics(self.data.demonstrations.observations, self.view.seen)

    def _collect(self, round_: int, count: int) -> None:
        """Record `count` episodes, label their states and ask the probes around them."""
        expert, pool, trainer = self.expert, self.pool, self.run.trainer
        assert expert is not None
        assert pool is not None
        assert trainer is not None

        def record_extra(behaviour: Behaviour, extra: int) -> Episodes:
            return self._record(pool, behaviour, f"extra {round_}", 0, extra)

        policy = self.view.policy(self.student.act) if self.student else None
        behaviour = trainer.behaviour(Situation(round_, expert, policy, record_extra))
        first = self.episodes
        recorded = self._record(pool, behaviour, "rollout", first, count)
        if round_ == 0:  # every trainer's expert acts alone there
            check_episodes(recorded, pool.name)
        new = label(recorded, expert, first, round_)
        self.episodes += count
        self.counts["clipped_actions"] += recorded.clipped_actions
        self.counts["physics_resets"] += int(recorded.physics_resets.sum())
        self.counts["terminated_episodes"] += int(recorded.terminated.sum())
        bounds = pool.boxes.low, pool.boxes.high
        before, old = self.dataset, None
        self.dataset = Dataset(new, None, None, *bounds, pool.name)
        if before is not None:
            self.dataset = replace(before, demonstrations=before.demonstrations + new)
            old = before.answers
        if self.run.probes is not None:
            self._calibrate()
            answers = self.ask(new.observations, round_, 0)
            answers = old + answers if old is not None else answers
            self.dataset = replace(self.dataset, probes=self.source, answers=answers)

    def _probe_given(self) -> None:
        """Ask the probes around given states."""
        self._calibrate()
        answers = self.ask(self.data.demonstrations.observations, 0, 0)
        self.dataset = replace(self.data, probes=self.source, answers=answers)

    def _calibrate(self) -> None:
        """Find what the source leaves open, once, on the states of the first round."""
        run, expert = self.run, self.expert
        if not run.calibrated or self.calibration is not None or expert is None:
            return
        assert run.probes is not None
        found = calibrate(
            expert,
            self.data.demonstrations.observations,
            self.scales,
            generator(run.seed, "calibration"),
            run.usual_radius,
            run.ladder,
        )
        self.calibration, self.source = found, found.complete(run.probes)

    def _record(
        self, pool: EnvironmentPool, behaviour: Behaviour, stream: str, first: int, count: int
    ) -> Episodes:
        numbers, horizon = range(first, first + count), self.run.horizon
        noise = [generator(self.run.seed, f"{stream} noise", episode) for episode in numbers]
        seeds = episode_seeds(self.run.seed, stream, first, count)
        with self.stages.stage("demonstrations", count * horizon, "step") as move:
            return rollout(behaviour, pool, seeds, horizon, noise, move)

    def ask(self, observations: np.ndarray, *path: int) -> Answers:
        """Ask the probes around states, along the directions of a named stream."""
        probes, expert = self.source, self.expert
        assert probes is not None
        if expert is None:
            raise SettingError(
                f"probes={probes.describe()!r} without an expert to ask",
                "an expert, or demonstrations with stored answers",
                "pass the expert, or probes=0 for plain behaviour cloning",
            )
        scales = self.scales
        self._check_budget(
            probes.queries(len(observations), int(scales.probed(probes.space).sum()), 1)
        )
        random = generator(self.run.seed, "probes", *path)
        return ask_probes(expert, observations, probes, scales, random, self.run.order)

    def _check_budget(self, rows: int) -> None:
        """Refuse to ask beyond the budget: early ends make a resampling source ask more often."""
        asked, most = sum(self._ledger().values()), self.run.max_queries
        if most is not None and asked + rows > most:
            raise SettingError(
                f"{asked:,} rows are asked, and {rows:,} more are due",
                f"at most max_queries={most:,}",
                "raise max_queries, or leave out resample",
            )

    def _train(self, round_: int) -> None:
        """Train a fresh student on all demonstrations, as it sees them."""
        run, view, data = self.run, self.view, self.data
        seen = view.demonstrations(data.demonstrations)
        complete = run.trainer is None or self.episodes == run.episodes
        if complete and run.fit.validation > 0 and len(np.unique(seen.episode)) == 1:
            warnings.warn(
                f"validation={run.fit.validation:g} of a single episode: none is held out, and "
                "the last weights are kept",
                FdtasilWarning,
                stacklevel=2,
            )
        scales = statistics(seen.observations)
        shape = StudentShape(view.size, seen.actions.shape[1], run.hidden, run.activation)
        start = torch_generator(run.seed, "student", round_)
        student = Student(shape, scales.mean, scales.scale, data.low, data.high, start)
        saved = self.folder.load(round_, "training")
        resume, asked_pool = None, -1
        if saved is not None:
            state = json.loads(saved["state.json"])
            resume, asked_pool = saved["fit.safetensors"], state["pool"]
            self._restore_ledger(state["queries"])
        pools = _Pools(self, view, round_, asked_pool)
        total = run.fit.total_steps(len(seen))
        with self.stages.stage(f"training, round {round_}", total, "step") as move:
            hooks = Hooks(self._tell(round_, move), self._checkpoint(round_, pools))
            entries = fit(
                student.to(self.device),
                seen,
                self.source,
                pools if self.source else None,
                run.fit,
                lambda name: torch_generator(run.seed, "batches", round_, name),
                order=run.order,
                hooks=hooks,
                resume=resume,
            )
        self.student = student.cpu()
        self.steps += int(entries[-1]["step"])
        self.history += [{"round": round_, **entry} for entry in entries]

    def _tell(
        self, round_: int, move: Callable[[int], None]
    ) -> Callable[[dict[str, float]], None]:
        last = 0

        def tell(entry: dict[str, float]) -> None:
            nonlocal last
            move(int(entry["step"]) - last)
            last = int(entry["step"])
            self.callback(Event("entry", round_, self.steps + last, {"round": round_, **entry}))

        return tell

    def _checkpoint(self, round_: int, pools: "_Pools") -> Callable[[FitState], None]:
        due = time.monotonic() + CHECKPOINT_SECONDS

        def checkpoint(state: FitState) -> None:
            nonlocal due
            if time.monotonic() < due and not self.interrupts.due:
                return
            about = {"pool": pools.number, "queries": self._ledger()}
            self.folder.save(
                round_,
                "training",
                state.step,
                lambda: {"fit.safetensors": state.to_bytes(), "state.json": to_json(about)},
            )
            self.interrupts.stop_if_due()
            due = time.monotonic() + CHECKPOINT_SECONDS

        return checkpoint

    # --- what is kept

    def _ledger(self) -> dict[str, int]:
        return dict(self.expert.queries) if self.expert else {}

    def _restore_ledger(self, queries: dict[str, int]) -> None:
        """Take the ledger of the interrupted run; what this one asked before counts as again."""
        if self.expert is None:
            return
        if self.again is None:
            self.again = sum(self.expert.queries.values())
        self.expert.queries.clear()
        self.expert.queries.update(queries)
        self.expert.queries["again"] += self.again

    def _keep_collected(self, round_: int) -> None:
        about = {
            "episodes": self.episodes,
            "counts": self.counts,
            "queries": self._ledger(),
            "calibration": self.calibration.to_json() if self.calibration else None,
        }
        self.folder.save(
            round_,
            "collected",
            0,
            lambda: {"demonstrations.npz": self.data.to_bytes(), "state.json": to_json(about)},
        )

    def _restore_collected(self, round_: int) -> bool:
        files = self.folder.load(round_, "collected")
        if files is None:
            return False
        state: dict[str, Any] = json.loads(files["state.json"])
        self.dataset = Dataset.from_bytes(files["demonstrations.npz"])
        self.episodes, self.counts = state["episodes"], Counter(state["counts"])
        self._restore_ledger(state["queries"])
        if state["calibration"] and self.calibration is None and self.run.probes is not None:
            self.calibration = Calibration.from_json(state["calibration"])
            self.source = self.calibration.complete(self.run.probes)
        return True

    def _keep_trained(self, round_: int) -> None:
        about = {"history": self.history, "steps": self.steps, "queries": self._ledger()}
        self.folder.save(
            round_,
            "trained",
            0,
            lambda: {"student.safetensors": self.trained.to_bytes(), "state.json": to_json(about)},
        )

    def _restore_trained(self, round_: int) -> bool:
        files = self.folder.load(round_, "trained")
        if files is None:
            return False
        state: dict[str, Any] = json.loads(files["state.json"])
        self.student = Student.from_bytes(files["student.safetensors"])
        self.history, self.steps = state["history"], state["steps"]
        self._restore_ledger(state["queries"])
        return True


class _Pools:
    """The expert's answers by number of the pool: those stored, then those of new directions."""

    def __init__(self, rounds: Rounds, view: View, round_: int, asked: int) -> None:
        self._rounds, self._view = rounds, view
        self._round, self._asked_before = round_, asked
        self.number = 0

    def __call__(self, number: int) -> Answers:
        rounds, data = self._rounds, self._rounds.data
        observations = data.demonstrations.observations
        probes = rounds.source
        assert probes is not None
        assert probes.stencil is not None
        if number == 0:
            assert data.answers is not None
            answers = data.answers
        else:
            answers = self._ask(observations, number)
        self.number = number
        return self._view.answers(answers, observations, probes.stencil.offsets)

    def _ask(self, observations: np.ndarray, number: int) -> Answers:
        queries = self._rounds.expert.queries if self._rounds.expert else Counter[str]()
        before = queries["probe"]
        answers = self._rounds.ask(observations, self._round, number)
        if number == self._asked_before:  # the interrupted run has asked and counted these
            queries["again"] += queries["probe"] - before
            queries["probe"] = before
        return answers
