"""MuJoCo's own resets: an unstable simulation begins anew inside `step()`, and says so nowhere."""

from typing import Any

import gymnasium

__all__ = ["RESET", "TellsResets", "clock", "data_of", "was_reset"]

RESET = "fdtasil.physics_reset"
"""What the `info` of a step says, where the simulation was reset in it."""


def data_of(environment: Any) -> object:
    """Return the data of an environment's simulation, None of another environment.

    Asking for it takes a while: once for each episode is enough.
    """
    return getattr(environment.unwrapped, "data", None)


def clock(data: object) -> float:
    """Return the time of a MuJoCo simulation; 0 where there is none."""
    time = getattr(data, "time", 0.0)
    return time if isinstance(time, float) else 0.0


def was_reset(data: object, before: float, *, first: bool) -> bool:
    """Whether MuJoCo has reset a simulation in a step.

    It says so only by its clock, and where the clock had not come far by its warnings.

    Args:
        data: Of the simulation, or None.
        before: Its clock before the step.
        first: Whether it was the first step of an episode.
    """
    now = clock(data)
    return now < before or ((now == before or first) and _unstable(data))


def _unstable(data: object) -> bool:
    """Return whether MuJoCo has found a simulation unstable since the episode began."""
    numbers = getattr(getattr(data, "warning", None), "number", None)
    if numbers is None:
        return False
    import mujoco  # whoever has such data has loaded it

    kinds = (f"mjWARN_BAD{what}" for what in ("QPOS", "QVEL", "QACC"))
    return any(numbers[int(vars(mujoco)["mjtWarning"].__members__[kind])] for kind in kinds)


class TellsResets(gymnasium.Wrapper):
    """Says in the `info` of a step that the simulation was reset: it lives in another process."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        answer = self.env.reset(seed=seed, options=options)
        self._data, self._first = data_of(self.env), True
        return answer

    def step(self, action: Any) -> Any:
        """Take a step."""
        before = clock(self._data)
        answer = self.env.step(action)
        first, self._first = self._first, False
        if was_reset(self._data, before, first=first):
            return *answer[:4], {**answer[4], RESET: True}
        return answer
