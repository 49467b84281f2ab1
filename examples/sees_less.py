"""The student sees less than its expert: no speed, but the last observations instead."""

import numpy as np
from gymnasium import ObservationWrapper, make
from gymnasium.spaces import Box

import fdtasil


def swing(observations):
    """The expert, which sees the speed."""
    cosine, sine, speed = observations.T
    return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]


class Memory:
    """The same law for observations without a speed: it remembers the last angle."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        """Answer as a recurrent agent of stable-baselines3 does."""
        angle = np.arctan2(observation[:, 1], observation[:, 0])[:, None]
        before = np.zeros_like(angle) if state is None else state[0]
        speed = np.angle(np.exp(1j * (angle - before))) / 0.05
        return np.clip(-8 * angle - 2 * speed, -2, 2), (angle,)


class NoSpeed(ObservationWrapper):
    """Pendulum without its speed."""

    def __init__(self):
        super().__init__(make("Pendulum-v1"))
        self.observation_space = Box(-1, 1, (2,))

    def observation(self, observation):
        return observation[:2]


if __name__ == "__main__":
    less = fdtasil.distill(swing, "Pendulum-v1", 10, episodes=3, student_obs=[0, 1])
    print("without speed", less.evaluation.normalized_return)
    both = fdtasil.distill(Memory(), NoSpeed, 10, episodes=3, history=2)
    print("with a history", both.evaluation.normalized_return)
