"""One round's training: a fresh student, on all that the run has, with checkpoints."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import warn
from fdtasil.probes.answers import Answers
from fdtasil.progress import Bar, Progress
from fdtasil.run.checkpoints import TRAINING, Checkpoints, Halfway, Trained
from fdtasil.run.configuration import Configuration
from fdtasil.run.events import Callback, Event
from fdtasil.run.interrupts import Interrupts
from fdtasil.run.lesson import Lesson
from fdtasil.run.samples import Samples
from fdtasil.seeding import torch_generator
from fdtasil.student.fit import Hooks, fit, hold_out
from fdtasil.student.fit_state import FitState
from fdtasil.student.policy import Student

__all__ = ["Training"]


@dataclass(frozen=True)
class Training:
    """How the student of a round comes to be.

    Attributes:
        run: The configuration.
        device: Where it is trained.
        checkpoints: Keep a training on its way, and know what is asked where the source resamples.
        progress: Progress bars.
        interrupts: Which wait for a checkpoint.
        callback: Told of entries of the history.
    """

    run: Configuration
    device: torch.device
    checkpoints: Checkpoints
    progress: Progress
    interrupts: Interrupts
    callback: Callback

    def train(self, round_: int, lesson: Lesson, before: Trained | None) -> Trained:
        """Train a fresh student on a lesson, as it sees it.

        Args:
            round_: The round.
            lesson: All that it learns from.
            before: What earlier rounds came to; their history and steps are counted on.
        """
        run, steps = self.run, before.steps if before else 0
        seen = lesson.view.demonstrations(lesson.dataset.demonstrations)
        self._warn_of_one_episode(seen, lesson.collected.episodes)
        kept = self.checkpoints.take_up(round_, TRAINING)
        samples = self._samples(round_, lesson, kept)
        student = self._fresh(seen, lesson, round_).to(self.device)
        with self.progress.bar(f"training, round {round_}", "step") as bar:
            entries = fit(
                student,
                seen,
                self.checkpoints.asking.source,
                _seen_by(lesson, samples) if samples else None,
                run.fit,
                self._stream(round_),
                hooks=Hooks(
                    bar.lengthen,
                    self._tell(round_, steps, bar),
                    self._checkpoint(round_, samples),
                ),
                resume=kept and kept.fit,
            )
        history = [{"round": round_, **entry} for entry in entries]
        steps += int(entries[-1]["step"])
        return Trained(student.cpu(), [*(before.history if before else []), *history], steps)

    def _stream(self, round_: int) -> Callable[[str], torch.Generator]:
        return lambda name: torch_generator(self.run.seed, "batches", round_, name)

    def _samples(self, round_: int, lesson: Lesson, kept: Halfway | None) -> Samples | None:
        dataset, asking = lesson.dataset, self.checkpoints.asking
        if asking.source is None or dataset.answers is None:
            return None
        stream = self._stream(round_)("held out")
        rows, _ = hold_out(dataset.demonstrations, self.run.fit, stream)
        before = kept.sample if kept else -1
        return Samples(asking, dataset.answers, lesson, rows.numpy(), round_, self.device, before)

    def _fresh(self, seen: Demonstrations, lesson: Lesson, round_: int) -> Student:
        scales, bounds = lesson.normaliser(seen.observations), lesson.dataset
        start = torch_generator(self.run.seed, "student", round_)
        return Student(
            self.run.student,
            scales.mean,
            scales.scale,
            bounds.low,
            bounds.high,
            start,
            lesson.action_scales,
            lesson.spaces_of_student(self.run.past),
        )

    def _warn_of_one_episode(self, seen: Demonstrations, episodes: int) -> None:
        run = self.run
        complete = run.trainer is None or episodes == run.episodes
        if complete and run.fit.validation > 0 and seen.episodes == 1:
            warn(
                f"validation={run.fit.validation:g} of a single episode: none is held out, and "
                "the last weights are kept"
            )

    def _tell(self, round_: int, before: int, bar: Bar) -> Callable[[dict[str, float]], None]:
        def tell(entry: dict[str, float]) -> None:
            step = int(entry["step"])
            bar.reach(step)
            self.callback(Event("entry", round_, before + step, {"round": round_, **entry}))

        return tell

    def _checkpoint(self, round_: int, samples: Samples | None) -> Callable[[FitState], None]:
        def checkpoint(fitted: FitState) -> None:
            if not self.checkpoints.due and not self.interrupts.due:
                return

            def halfway() -> Halfway:
                return Halfway(fitted.to_bytes(), samples.number if samples else 0)

            self.checkpoints.keep(round_, TRAINING, halfway, fitted.step)
            self.interrupts.stop_if_due()

        return checkpoint


def _seen_by(lesson: Lesson, samples: Samples) -> Callable[[int], Answers]:
    """Return the answers of each sample as the student sees them."""

    def answers(number: int) -> Answers:
        return lesson.view.answers(samples(number), samples.observations, samples.offsets)

    return answers
