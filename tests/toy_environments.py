"""A small environment for the tests, registered under toy/..."""

import os
import time

import gymnasium
import numpy as np


class Integrator(gymnasium.Env):
    """Two point masses on a line, pushed towards zero; one observation never moves.

    Observation (5,): positions, velocities, the constant 3. Action (2,): forces in [-1, 1].
    """

    def __init__(self, wall: float = 3.0) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.wall = wall

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 2)
        self.velocity = self.np_random.uniform(-0.2, 0.2, 2)
        return self._observe(), {}

    def step(self, action):
        if not np.all(np.abs(action) <= 1):
            raise ValueError("the action was not clipped")
        self.velocity = self.velocity + 0.1 * np.asarray(action, np.float64)
        self.position = self.position + 0.1 * self.velocity
        reward = 1.0 - 0.3 * float(np.abs(self.position).sum())
        fallen = bool((np.abs(self.position) > self.wall).any())
        return self._observe(), reward, fallen, False, {}

    def _observe(self):
        return np.concatenate([self.position, self.velocity, [3.0]])


gymnasium.register("toy/Integrator-v0", entry_point=Integrator, max_episode_steps=40)
gymnasium.register("toy/Walled-v0", entry_point=lambda: Integrator(0.9), max_episode_steps=40)
gymnasium.register("toy/Endless-v0", entry_point=Integrator)


class Jumps(Integrator):
    """Its simulation, as MuJoCo's, begins anew at every sixth step, and says so by its clock."""

    class Data:
        time = 0.0

    def __init__(self) -> None:
        super().__init__()
        self.data = Jumps.Data()

    def step(self, action):
        self.data.time = 0.0 if self.data.time > 0.45 else self.data.time + 0.1
        return super().step(action)


gymnasium.register("toy/Jumps-v0", entry_point=Jumps, max_episode_steps=40)


class Hangs(Integrator):
    """Ends its process, or never returns, where the first position says so."""

    how = "exit"

    def step(self, action):
        if self.position[0] > 0:
            os._exit(3) if self.how == "exit" else time.sleep(3600)
        return super().step(action)


class Sleeps(Hangs):
    how = "sleep"


gymnasium.register("toy/Exits-v0", entry_point=Hangs, max_episode_steps=40)
gymnasium.register("toy/Sleeps-v0", entry_point=Sleeps, max_episode_steps=40)
