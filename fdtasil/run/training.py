"""One round's training: a fresh student, on all that the run has, with checkpoints."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import FdtasilWarning
from fdtasil.probes.answers import Answers
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Stages
from fdtasil.run.events import Callback, Event
from fdtasil.run.interrupts import Interrupts
from fdtasil.run.state import RunState
from fdtasil.seeding import torch_generator
from fdtasil.student.fit import Hooks, fit, hold_out
from fdtasil.student.fit_state import FitState
from fdtasil.student.network import Student, StudentShape
from fdtasil.student.view import View

__all__ = ["Training"]

_FIT = "fit.safetensors"


@dataclass(frozen=True)
class Training:
    """How the student of a round comes to be.

    Attributes:
        state: What the run has so far; takes the student.
        device: Where it is trained.
        stages: Progress bars.
        interrupts: Which wait for a checkpoint.
        callback: Told of entries of the history.
    """

    state: RunState
    device: torch.device
    stages: Stages
    interrupts: Interrupts
    callback: Callback

    def round(self, round_: int) -> None:
        """Train a fresh student on all demonstrations, as it sees them."""
        state, run, view = self.state, self.state.run, self.state.view
        seen = view.demonstrations(state.data.demonstrations)
        self._warn_of_one_episode(seen)
        resume, asked_pool = self._resumed(round_)
        pools = _Pools(state, view, round_, asked_pool)

        def random(name: str) -> torch.Generator:
            return torch_generator(run.seed, "batches", round_, name)

        rows, _ = hold_out(seen, run.fit, random("held out"))
        total = run.fit.total_steps(len(rows))
        student = self._fresh(seen, round_)
        with self.stages.stage(f"training, round {round_}", total, "step") as move:
            entries = fit(
                student.to(self.device),
                seen,
                state.source,
                pools if state.source else None,
                run.fit,
                random,
                order=run.order,
                hooks=Hooks(self._tell(round_, move), self._checkpoint(round_, pools)),
                resume=resume,
            )
        state.student = student.cpu()
        state.steps += int(entries[-1]["step"])
        state.history += [{"round": round_, **entry} for entry in entries]

    def _fresh(self, seen: Demonstrations, round_: int) -> Student:
        run, data, scales = self.state.run, self.state.data, measure_scales(seen.observations)
        sizes = seen.observations.shape[1], seen.actions.shape[1]
        shape = StudentShape(*sizes, run.hidden, run.activation)
        start = torch_generator(run.seed, "student", round_)
        return Student(shape, scales.mean, scales.scale, data.low, data.high, start)

    def _warn_of_one_episode(self, seen: Demonstrations) -> None:
        run = self.state.run
        complete = run.trainer is None or self.state.episodes == run.episodes
        if complete and run.fit.validation > 0 and seen.episodes == 1:
            warnings.warn(
                f"validation={run.fit.validation:g} of a single episode: none is held out, and "
                "the last weights are kept",
                FdtasilWarning,
                stacklevel=3,
            )

    def _resumed(self, round_: int) -> tuple[bytes | None, int]:
        """Return the state of the interrupted fit, and the last pool that it asked for."""
        kept = self.state.take_up(round_, "training")
        if kept is None:
            return None, -1
        files, about = kept
        return files[_FIT], about["pool"]

    def _tell(
        self, round_: int, move: Callable[[int], None]
    ) -> Callable[[dict[str, float]], None]:
        last, before = 0, self.state.steps

        def tell(entry: dict[str, float]) -> None:
            nonlocal last
            move(int(entry["step"]) - last)
            last = int(entry["step"])
            self.callback(Event("entry", round_, before + last, {"round": round_, **entry}))

        return tell

    def _checkpoint(self, round_: int, pools: "_Pools") -> Callable[[FitState], None]:
        def checkpoint(fitted: FitState) -> None:
            if not self.state.folder.due and not self.interrupts.due:
                return
            about = {"pool": pools.number}
            self.state.keep(
                round_, "training", about, lambda: {_FIT: fitted.to_bytes()}, fitted.step
            )
            self.interrupts.stop_if_due()

        return checkpoint


class _Pools:
    """The expert's answers by number of the pool: those stored, then those of new directions."""

    def __init__(self, state: RunState, view: View, round_: int, asked: int) -> None:
        self._state, self._view = state, view
        self._round, self._asked_before = round_, asked
        self.number = 0

    def __call__(self, number: int) -> Answers:
        data, probes = self._state.data, self._state.source
        observations = data.demonstrations.observations
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
        queries = self._state.account.queries
        before = queries["probe"]
        if number != self._asked_before:  # those are in the account already
            self._state.check_budget(len(observations))
        answers = self._state.ask(observations, self._round, number)
        if number == self._asked_before:  # the interrupted run has asked and counted these
            queries["again"] += queries["probe"] - before
            queries["probe"] = before
        return answers
