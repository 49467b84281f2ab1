"""A control law written by hand becomes a network: the shortest example."""

import numpy as np

import fdtasil


def swing(observations):
    """(B, 3) cosine, sine and speed of a pendulum -> (B, 1) torques."""
    cosine, sine, speed = observations.T
    return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]


if __name__ == "__main__":
    result = fdtasil.distill(swing, "Pendulum-v1", probes=10, episodes=3)
    print(result.evaluation)
    result.export("pendulum.onnx")
