"""Who acts in round i: that is all a trainer is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.experts import Expert
from fdtasil.rollouts import Behaviour, Decision
from fdtasil.student import Student

__all__ = ["TRAINERS", "BehaviourCloning", "Trainer", "trainer_of"]


class Trainer(Protocol):
    """Decides how the episodes are split into rounds, and who acts in each.

    Attributes:
        name: What reports call it.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    def rounds(self, episodes: int) -> list[int]:
        """Return the number of episodes of each round; their sum is `episodes`."""
        ...

    def behaviour(self, round_: int, expert: Expert, student: Student | None) -> Behaviour:
        """Return who acts; `student` is the last round's, None in round 0."""
        ...


@dataclass(frozen=True)
class BehaviourCloning:
    """The expert acts, once."""

    name: str = "bc"

    def rounds(self, episodes: int) -> list[int]:
        """One round of all episodes."""
        return [episodes]

    def behaviour(self, round_: int, expert: Expert, student: Student | None) -> Behaviour:
        """The expert's own actions, which are the labels at the same time."""

        def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
            answers = expert.ask(observations, "act")
            return Decision(answers, answers)

        return act


TRAINERS: dict[str, Trainer] = {trainer.name: trainer for trainer in (BehaviourCloning(),)}


def trainer_of(trainer: str | Trainer) -> Trainer:
    """Return the trainer of that name, or the trainer itself.

    Raises:
        SettingError: If there is none of that name.
    """
    if not isinstance(trainer, str):
        return trainer
    if trainer not in TRAINERS:
        raise SettingError(
            f"trainer={trainer!r}", f"one of {', '.join(TRAINERS)}", "choose one of these"
        )
    return TRAINERS[trainer]
