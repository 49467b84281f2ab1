"""What a policy meets on a machine and did not meet in its data: noise, pushes, other physics."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import mujoco
import numpy as np

from fdtasil.seeding import generator

__all__ = ["DISTURBANCES", "STEPS_BETWEEN_PUSHES", "Disturbance"]

Disturbance = Callable[[gymnasium.Env, np.ndarray], gymnasium.Env]
"""A fresh MuJoCo environment and (n,) standard deviations of its observations -> the environment,
disturbed. Equal seeds are disturbed equally."""

STEPS_BETWEEN_PUSHES = 50


class Noise(gymnasium.ObservationWrapper):
    """Adds normal noise to every observation; what never moves stays still.

    Args:
        env: The environment.
        deviations: (n,) standard deviations of its observations.
        size: Of the noise, in these deviations.
    """

    def __init__(self, env: gymnasium.Env, deviations: np.ndarray, size: float) -> None:
        super().__init__(env)
        self._deviations, self._random = size * deviations, generator(0, "noise")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the noise of the seed."""
        if seed is not None:
            self._random = generator(seed, "noise")
        return super().reset(seed=seed, options=options)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """(n,) -> (n,) with noise."""
        noise = self._deviations * self._random.standard_normal(len(observation))
        return (observation + noise).astype(observation.dtype)


class Pushes(gymnasium.Wrapper):
    """Pushes the first body for one step every 50 steps, in a random horizontal direction.

    A planar robot is pushed forwards or backwards: it can't be moved aside.

    Args:
        env: The environment.
        deviations: Not used.
        speed: That a push gives to the whole body's mass, in m/s.
    """

    def __init__(self, env: gymnasium.Env, deviations: np.ndarray, speed: float) -> None:
        super().__init__(env)
        self._speed, self._random, self._steps = speed, generator(0, "pushes"), 0
        self._inner: Any = env.unwrapped
        self._planar = self._inner.model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the pushes of the seed."""
        self._steps = 0
        if seed is not None:
            self._random = generator(seed, "pushes")
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> Any:
        """Step, under a push where one is due."""
        model, data = self._inner.model, self._inner.data
        self._steps += 1
        if self._steps % STEPS_BETWEEN_PUSHES == 0:
            force = model.body_mass.sum() * self._speed / self._inner.dt
            data.xfrc_applied[1, :2] = force * self._direction()
        try:
            return self.env.step(action)
        finally:
            data.xfrc_applied[1] = 0

    def _direction(self) -> np.ndarray:
        if self._planar:
            return np.array([self._random.choice([-1.0, 1.0]), 0.0])
        angle = self._random.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle)])


def _undisturbed(env: gymnasium.Env, deviations: np.ndarray) -> gymnasium.Env:
    return env


def _heavier(env: gymnasium.Env, deviations: np.ndarray, factor: float) -> gymnasium.Env:
    inner: Any = env.unwrapped
    inner.model.body_mass[:] *= factor
    inner.model.body_inertia[:] *= factor
    mujoco.mj_setConst(inner.model, inner.data)  # what the simulator derives from the masses
    return env


def _rougher(env: gymnasium.Env, deviations: np.ndarray, factor: float) -> gymnasium.Env:
    inner: Any = env.unwrapped
    inner.model.geom_friction[:, 0] *= factor
    return env


DISTURBANCES: dict[str, Disturbance] = {
    "none": _undisturbed,
    **{f"noise {size:g}": partial(Noise, size=size) for size in (0.05, 0.1, 0.2)},
    **{f"pushes {speed:g} m/s": partial(Pushes, speed=speed) for speed in (0.25, 0.5, 1.0)},
    **{f"mass x {factor:g}": partial(_heavier, factor=factor) for factor in (0.8, 1.2)},
    **{f"friction x {factor:g}": partial(_rougher, factor=factor) for factor in (0.5, 2.0)},
}
"""By the name that results and figures use. Noise is in standard deviations of the demonstrations'
observations, a push comes every 50 steps, mass takes inertia along."""
