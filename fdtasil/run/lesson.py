"""What a round learns from, with what is computed of it once."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.probes.scales import (
    Scales,
    all_but,
    measure_actions,
    measure_following,
    measure_scales,
)
from fdtasil.probes.spread import Spread
from fdtasil.rollouts.spaces import Spaces, flat_layout
from fdtasil.run.checkpoints import Collected
from fdtasil.student.view import StudentObservation, View

__all__ = ["Lesson"]


@dataclass(frozen=True)
class Lesson:
    """All labelled states so far, and how the student sees them.

    Attributes:
        collected: The states, and what happened while they were recorded.
        view: What the student sees; measured on states of the first round.
        scales: Of all states so far: the first episode may be a fall of three steps.
    """

    collected: Collected
    view: View
    scales: Scales

    @classmethod
    def of(
        cls,
        collected: Collected,
        student_obs: StudentObservation | None,
        before: "Lesson | None",
        spread: Spread,
        held: Collection[int],
    ) -> "Lesson":
        """Return the lesson of what is collected.

        Args:
            collected: What is learnt from.
            student_obs: What the student sees.
            before: That of the round before, whose view it has; None in the first round.
            spread: How far coordinates will go that hardly move.
            held: Coordinates that no probe moves.

        Raises:
            SettingError: If the student can't see so.
        """
        states = collected.dataset.demonstrations
        first = states.observations[states.round == states.round.min()][:256]
        view = View.of(student_obs, first) if before is None else before.view
        moved = all_but(held, len(view.seen))
        hidden = ~view.seen & moved
        view = replace(view, seen=view.seen & moved)
        scales = measure_scales(states.observations, view.seen)
        following = measure_following(states.observations, scales, hidden)
        scales = replace(scales, following=following)
        told = spread.among(states.observations, states.episode)
        return cls(collected, view, scales.spread_by(told))

    def normaliser(self, seen: np.ndarray) -> Scales:
        """Return the scales of (N, k) observations as the student sees them."""
        own, columns = measure_scales(seen), self.view.columns
        if self.view.is_whole:
            columns = tuple(range(self.view.size))
        if columns is None:
            return own  # of a function of the observation: its values alone tell
        told = {
            place: float(self.scales.deviation[column])
            for place, column in enumerate(columns)
            if self.scales.told[column]
        }
        return own.spread_by(told)

    def spaces_of_student(self, past: int) -> Spaces | None:
        """Return the spaces of what the student sees and does, where they are no plain boxes."""
        spaces = self.dataset.spaces
        if spaces is None:
            return None
        observations = spaces.observations
        if past or not self.view.is_whole:
            columns = None if past else self.view.columns
            size = self.view.size
            observations = flat_layout(size) if columns is None else observations.seen(columns)
        return Spaces(observations, spaces.actions)

    @property
    def action_scales(self) -> Scales | None:
        """How far actions without bounds go; one scale for all scores of a choice.

        None where all have bounds, which say it.
        """
        dataset = self.dataset
        if (np.isfinite(dataset.low) & np.isfinite(dataset.high)).all():
            return None
        return measure_actions(dataset.demonstrations.actions, dataset.choices)

    @property
    def dataset(self) -> Dataset:
        """The states, and the answers around them."""
        return self.collected.dataset
