"""How long a student is trained, how fast, and on how many states at a time."""

from dataclasses import dataclass

__all__ = ["ANEW", "LOG_EVERY", "USUAL", "Schedule"]

LOG_EVERY = 100
"""Steps between two entries of the history: reading a loss waits for the device."""


@dataclass(frozen=True)
class Schedule:
    """Length, learning rate and minibatches of a training.

    Attributes:
        steps: Gradient steps.
        epochs: Visits of each state, instead of steps; or None.
        enough: States beyond which the steps grow by the square root of their number; or None.
        batch_size: States in a minibatch at most.
        learning_rate: The peak.

    Example:
        >>> USUAL.total_steps(states=1500), USUAL.total_steps(states=6000)
        (4000, 8000)
    """

    steps: int
    epochs: int | None
    enough: int | None
    batch_size: int
    learning_rate: float

    def steps_an_epoch(self, states: int) -> int:
        """Return the minibatches that visit each of `states` states once."""
        return max(1, -(-states // self.batch_size))

    def total_steps(self, states: int) -> int:
        """Return the gradient steps of a training on `states` states."""
        if self.epochs is not None:
            return self.epochs * self.steps_an_epoch(states)
        if self.enough is None or states <= self.enough:
            return self.steps
        grown = self.steps * (states / self.enough) ** 0.5
        return LOG_EVERY * round(grown / LOG_EVERY)  # a last entry of a few steps tells little

    def visits(self, states: int) -> int:
        """Return how often each state is visited, the last incomplete epoch counted whole."""
        return -(-self.total_steps(states) // self.steps_an_epoch(states))


USUAL = Schedule(4_000, None, 1_500, batch_size=100, learning_rate=1e-3)
"""Where nobody says another."""

ANEW = Schedule(12_000, None, 5_000, batch_size=100, learning_rate=4e-3)
"""Where the expert is asked anew: what is never seen twice is not learnt by heart, so that longer
and faster training goes on teaching."""
