"""What an expert remembers, and what a student is shown of the past, in an environment."""

from dataclasses import replace

import numpy as np

from fdtasil.errors import ExpertError, first_line
from fdtasil.experts.expert import Expert
from fdtasil.experts.memory import OnColumns
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.history import WithHistory, past_size
from fdtasil.rollouts.remembering import Remembering

__all__ = ["beside_past", "carry"]


def beside_past(expert: Expert, own: int, past: int, remembered: int = 0) -> Expert:
    """Return an expert that takes its part of observations with a past in them.

    Args:
        expert: The expert.
        own: Length of the environment's own observation.
        past: Length of the past behind it.
        remembered: Length of the expert's memory, which stands last.
    """
    size = own + past + remembered
    columns = (*range(own), *range(own + past, size))
    module = expert.module and OnColumns(expert.module, columns)
    return replace(expert, takes=columns, module=module, observation_size=size, jacobian=None)


def carry(expert: Expert, pool: EnvironmentPool, history: int = 1) -> tuple[Expert, int, int]:
    """Let an environment show what an expert would remember, and what a student is to see.

    Args:
        expert: The expert.
        pool: The environment, whose observations become longer: its own, those of the past with
            the actions then, and the expert's memory.
        history: How many observations the student sees.

    Returns:
        The expert, which takes its part of them, and the lengths of past and memory.
    """
    memory = expert.memory
    if memory is None and history == 1:
        return expert, 0, 0
    n, m = pool.boxes.observation_size, pool.boxes.action_size
    past, remembered = past_size(history, n, m), memory.size if memory else 0
    if past:
        layout = pool.spaces.actions
        pool.wrap(lambda environment: WithHistory(environment, history, layout))
        asked = beside_past(expert, n, past, remembered)
    else:
        asked = expert
    if memory is not None:

        def after(observation: np.ndarray, before: np.ndarray) -> np.ndarray:
            expert.count(1, "remember")
            try:
                after = memory.after(observation[:n], before)
            except Exception as error:  # the environment, which carries it, is not to blame
                raise ExpertError(
                    f"{expert.name} raised {type(error).__name__}, asked for its memory after one "
                    f"observation: {first_line(error)}",
                    "actions and a state for (1, n) observations too",
                    "mend it, or let it answer NaN and keep its state where it can't",
                ) from error
            if after.shape != before.shape:
                raise ExpertError(
                    f"{expert.name} returned a state of {after.size} numbers for one observation",
                    f"{before.size}, as for several",
                    "return a state with a row for each observation",
                )
            return after

        pool.wrap(lambda environment: Remembering(environment, after, remembered))
    return asked, past, remembered
