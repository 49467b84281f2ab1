"""Episodes side by side, step by step: one batch of decisions for all that still go on."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from fdtasil.errors import SettingError
from fdtasil.rollouts.behaviours import Behaviour, Decision
from fdtasil.rollouts.playing import Playing
from fdtasil.rollouts.recording import Recording

__all__ = ["step_by_step", "step_together"]


def step_together(
    record: Recording,
    playing: Playing,
    behaviour: Behaviour,
    noise: Sequence[np.random.Generator],
    horizon: int,
    on_step: Callable[[int], None] = lambda count: None,
) -> None:
    """Play episodes until each is over.

    Args:
        record: Where they are recorded.
        playing: Where they are played.
        behaviour: Who acts.
        noise: Generators handed to it, by the number of the episode.
        horizon: T, steps after which an episode is cut.
        on_step: Told the number of environment steps just done.
    """
    for going in step_by_step(record, playing, playing.begin(), behaviour, noise, horizon):
        on_step(len(going))


def step_by_step(
    record: Recording,
    playing: Playing,
    batch: np.ndarray,
    behaviour: Behaviour,
    noise: Sequence[np.random.Generator],
    horizon: int,
) -> Iterator[np.ndarray]:
    """Play episodes as `step_together` does, a step whenever one is asked for.

    Args:
        record: Where they are recorded.
        playing: Where they are played.
        batch: (E, n) their first observations.
        behaviour: Who acts.
        noise: Generators handed to it, by the number of the episode.
        horizon: T, steps after which an episode is cut.

    Yields:
        After each step (B,) bool, which of the episodes that took it go on. One that ends
        for want of an answer takes no step.
    """
    alive = playing.episodes
    for step in range(horizon):
        decision = behaviour(batch, [noise[e] for e in alive])
        if not isinstance(decision, Decision):
            raise SettingError(
                f"a trainer's behaviour that returns a {type(decision).__name__}",
                "a Decision: the actions, and the expert's answers or None",
                "from fdtasil.rollouts.behaviours import Decision; return Decision(actions, None)",
            )
        if decision.silent is not None:
            decision, heard = record.hold(alive, step, decision)
            if not heard.all():
                alive = [episode for row, episode in enumerate(alive) if heard[row]]
                batch, decision = batch[heard], _rows_of(decision, heard)
            if not alive:
                break
        allowed = record.decide(alive, step, batch, decision)
        after, going = playing.step(alive, allowed, step)
        yield going
        if going.all():
            batch = after
            continue
        batch = after[going]
        alive = [episode for row, episode in enumerate(alive) if going[row]]
        if not alive:
            break


def _rows_of(decision: Decision, kept: np.ndarray) -> Decision:
    """Return some rows of a decision that is one everywhere."""
    answers = decision.expert_action
    return Decision(decision.action[kept], None if answers is None else answers[kept])
