"""What a round learns from, with what is computed of it once."""

from dataclasses import dataclass

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.probes.scales import Scales, measure_scales
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
    ) -> "Lesson":
        """Return the lesson of what is collected; its view is that of the rounds before.

        Raises:
            SettingError: If the student can't see so.
        """
        states = collected.dataset.demonstrations
        first = states.observations[states.round == 0][:256]
        view = View.of(student_obs, first) if before is None else before.view
        return cls(collected, view, measure_scales(states.observations, view.seen))

    @property
    def dataset(self) -> Dataset:
        """The states, and the answers around them."""
        return self.collected.dataset
