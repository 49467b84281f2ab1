"""What a policy meets on a machine and did not meet in its data: noise, pushes, other physics."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np

__all__ = ["DISTURBANCES", "Disturbance"]

Wrap = Callable[[gymnasium.Env, np.ndarray], gymnasium.Env]
"""An environment and (n,) deviations of its observations -> the environment, disturbed."""

_EVERY = 50  # steps between two pushes


@dataclass(frozen=True)
class Disturbance:
    """One way to disturb a MuJoCo environment; equal seeds are disturbed equally.

    Attributes:
        label: What figures call it.
        wrap: Disturbs an environment.
    """

    label: str
    wrap: Wrap


class Noise(gymnasium.ObservationWrapper):
    """Adds normal noise to every observation; what never moves stays still.

    Args:
        env: The environment.
        deviations: (n,) standard deviations of its observations.
        size: Of the noise, in these deviations.
    """

    def __init__(self, env: gymnasium.Env, deviations: np.ndarray, size: float) -> None:
        super().__init__(env)
        self._deviations, self._random = size * deviations, np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the noise anew too."""
        self._random = np.random.default_rng(seed)
        return super().reset(seed=seed, options=options)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """(n,) -> (n,) with noise."""
        noise = self._deviations * self._random.standard_normal(len(observation))
        return (observation + noise).astype(observation.dtype)


class Pushes(gymnasium.Wrapper):
    """Pushes the first body in a random horizontal direction, for one step every 50 steps.

    Args:
        env: The environment.
        speed: That a push gives to the whole body's mass, in m/s.
    """

    def __init__(self, env: gymnasium.Env, speed: float) -> None:
        super().__init__(env)
        self._speed, self._random, self._steps = speed, np.random.default_rng(), 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the pushes anew too."""
        self._random, self._steps = np.random.default_rng(seed), 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> Any:
        """Step, under a push where one is due."""
        inner: Any = self.unwrapped
        self._steps += 1
        if self._steps % _EVERY == 0:
            angle = self._random.uniform(0, 2 * np.pi)
            force = inner.model.body_mass.sum() * self._speed / inner.dt
            inner.data.xfrc_applied[1, :2] = force * np.array([np.cos(angle), np.sin(angle)])
        try:
            return self.env.step(action)
        finally:
            inner.data.xfrc_applied[1] = 0


def _as_it_is(env: gymnasium.Env, deviations: np.ndarray) -> gymnasium.Env:
    return env


def _pushed(env: gymnasium.Env, deviations: np.ndarray, speed: float) -> gymnasium.Env:
    return Pushes(env, speed)


def _heavier(env: gymnasium.Env, deviations: np.ndarray, factor: float) -> gymnasium.Env:
    model: Any = env.unwrapped.model
    model.body_mass[:] *= factor
    model.body_inertia[:] *= factor
    return env


def _rougher(env: gymnasium.Env, deviations: np.ndarray, factor: float) -> gymnasium.Env:
    model: Any = env.unwrapped.model
    model.geom_friction[:, 0] *= factor
    return env


DISTURBANCES = {
    "none": Disturbance("none", _as_it_is),
    **{
        f"noise {size:g}": Disturbance(f"noise {size:g}", partial(Noise, size=size))
        for size in (0.05, 0.1, 0.2)
    },
    **{
        f"push {speed:g}": Disturbance(f"pushes {speed:g} m/s", partial(_pushed, speed=speed))
        for speed in (0.5, 1.0, 2.0)
    },
    **{
        f"mass {factor:g}": Disturbance(f"mass x {factor:g}", partial(_heavier, factor=factor))
        for factor in (0.8, 1.2)
    },
    **{
        f"friction {factor:g}": Disturbance(
            f"friction x {factor:g}", partial(_rougher, factor=factor)
        )
        for factor in (0.5, 2.0)
    },
}
"""By the name that results use; the paper's experts know none of them but "none"."""
