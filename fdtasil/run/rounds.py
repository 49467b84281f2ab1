"""The rounds of a run: collect, label, probe, train; each stage is kept before the next begins."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.probes.answers import Answers, Beginning
from fdtasil.probes.surroundings import Surroundings
from fdtasil.rollouts.behaviours import Policy
from fdtasil.rollouts.episodes import Episodes
from fdtasil.run.checkpoints import (
    ADDED,
    ASKED,
    RECORDED,
    TRAINED,
    Checkpoints,
    Collected,
    Stage,
    Trained,
)
from fdtasil.run.collecting import Collecting
from fdtasil.run.configuration import Configuration
from fdtasil.run.doubts import (
    warn_of_falls,
    warn_of_narrow_spread,
    warn_of_one_state,
    warn_of_rounded_movement,
    warn_of_small_units,
    warn_of_still_coordinates,
    warn_of_whole_numbers,
)
from fdtasil.run.events import Event
from fdtasil.run.lesson import Lesson
from fdtasil.run.training import Training
from fdtasil.seeding import generator
from fdtasil.student.view import StudentObservation, View

__all__ = ["Rounds"]

_FEW = 32  # states that a view is tried on


@dataclass(frozen=True)
class Rounds:
    """In which order a run does what.

    Attributes:
        run: The configuration.
        student_obs: What the student sees; None for everything.
        collecting: Records; None where the dataset is given.
        training: Makes each round's student; its checkpoints, bars and callback are the run's.
    """

    run: Configuration
    student_obs: StudentObservation | None
    collecting: Collecting | None
    training: Training

    @property
    def checkpoints(self) -> Checkpoints:
        """Where every stage is kept."""
        return self.training.checkpoints

    def complete(self, given: Dataset | None, expert: Episodes | None) -> tuple[Lesson, Trained]:
        """Do every round, beginning where the folder's checkpoints end.

        Args:
            given: The dataset, where nothing is recorded.
            expert: The expert's own episodes, where there are some.

        Returns:
            What the last round learnt from, and what it came to.
        """
        collected = None if given is None else Collected(given, 0, Counter())
        lesson, trained = None, None
        for round_, count in enumerate(self.run.rounds):
            policy = lesson.view.policy(trained.student.act) if lesson and trained else None
            lesson = self._learnt_from(round_, count, collected, lesson, policy)
            collected = lesson.collected
            self._doubt(round_, lesson, expert)
            trained = self._trained(round_, lesson, trained)
            last = trained.history[-1]
            self.training.callback(Event("round", round_, trained.steps, last, trained.student))
        assert lesson is not None
        assert trained is not None, "every run has a round"
        return lesson, trained

    def _doubt(self, round_: int, lesson: Lesson, expert: Episodes | None) -> None:
        """Warn of what the demonstrations lack, as soon as it is known."""
        last = round_ == len(self.run.rounds) - 1
        if last:
            warn_of_one_state(lesson.dataset.demonstrations)
            warn_of_small_units(lesson.scales)
            warn_of_rounded_movement(lesson)
            if not self.run.spread.where_still:
                warn_of_narrow_spread(self.run.spread.deviations, lesson.scales)
        if expert is not None and round_ == 0 and self.collecting is not None:
            warn_of_falls(lesson.dataset.demonstrations, expert, self.run.keep)
        if last and self.run.can_spread:
            warn_of_still_coordinates(lesson, expert)
            if self.run.spaces is None and self.run.probes and not self.run.probes.exact:
                warn_of_whole_numbers(lesson)

    def _trained(self, round_: int, lesson: Lesson, before: Trained | None) -> Trained:
        with self.training.interrupts.held_back():
            return self.checkpoints.once(
                round_, TRAINED, lambda: self.training.train(round_, lesson, before)
            )

    def _learnt_from(
        self,
        round_: int,
        count: int,
        before: Collected | None,
        lesson: Lesson | None,
        student: Policy | None,
    ) -> Lesson:
        """Return all that a round learns from: recorded, labelled, and probed around."""
        earlier = before if self.collecting else None  # a dataset that is given is all there is

        def add() -> Collected:
            if self.collecting is None:
                assert before is not None, "the dataset is given"
                return self._probed(round_, before, None, lesson)
            new = self._recorded(self.collecting, round_, count, before, student)
            return self._probed(round_, new, earlier, lesson)

        added = self._once(round_, ADDED, add)
        return self._lesson(earlier, added, lesson)

    def _lesson(
        self, earlier: Collected | None, added: Collected, before: Lesson | None
    ) -> Lesson:
        collected = earlier + added if earlier else added
        return Lesson.of(collected, self.student_obs, before, self.run.spread, self.run.held)

    def _recorded(
        self,
        collecting: Collecting,
        round_: int,
        count: int,
        before: Collected | None,
        student: Policy | None,
    ) -> Collected:
        def record() -> Collected:
            return collecting.record(round_, count, before, student)

        if self.run.probes is None:
            return record()  # the round is kept as a whole in a moment
        return self._once(round_, RECORDED, record)

    def _once(
        self, round_: int, stage: Stage[Collected], do: Callable[[], Collected]
    ) -> Collected:
        """Collect, or take up what was kept, if the expert is still the one that labelled it."""
        kept = self.checkpoints.take_up(round_, stage)
        if kept is None:
            done = do()
            self.checkpoints.keep(round_, stage, lambda: done)
            return done
        if round_ == 0 and self.collecting is not None:
            with self.checkpoints.account.asked_before():
                self.collecting.check_kept(kept)
        return kept

    def _probed(
        self, round_: int, new: Collected, before: Collected | None, lesson: Lesson | None
    ) -> Collected:
        """Return what is new with the answers to the probes around it."""
        if self.run.probes is None or self.run.probes_given:
            return new
        whole = self._lesson(before, new, lesson)
        answers = self._answers(round_, new.dataset.demonstrations, whole)
        source = self.checkpoints.asking.source
        return replace(new, dataset=replace(new.dataset, probes=source, answers=answers))

    def _try_view(self, around: Surroundings, view: View) -> None:
        """Refuse a curved view before anybody is asked around the states.

        Raises:
            SettingError: As `View.answers`.
        """
        source = self.checkpoints.asking.source
        if view.columns is not None or view.is_whole or source is None:
            return
        few = replace(around, observations=around.observations[:_FEW])
        drawn = few.sample(generator(self.run.seed, "view"))
        offsets = source.stencil.offsets if source.stencil else ()
        view.steps(few.observations, drawn.displacements[drawn.numbers], offsets)

    def _answers(self, round_: int, states: Demonstrations, lesson: Lesson) -> Answers:
        """Ask the probes around a round's states; the answers are kept on the way."""
        known = self.checkpoints.take_up(round_, ASKED)
        asking = self.checkpoints.asking
        asking.calibrate(lesson.dataset, lesson.scales)
        # What there is to warn of was said before the first answer.
        around = asking.around(states, lesson.scales, again=known is not None)
        if known is None:
            self._try_view(around, lesson.view)
        with self.training.progress.bar("probes", "state", len(states)) as bar:

            def told(values: np.ndarray, states: int) -> None:
                bar.move(states)
                if self.checkpoints.due:
                    self.checkpoints.keep(round_, ASKED, lambda: values, len(values))

            beginning = Beginning(known, told)
            return asking.ask(around, round_, 0, beginning=beginning)
