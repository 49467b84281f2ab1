"""The student sees less than its expert: no speed, as on a robot without that sensor."""

import numpy as np

import fdtasil


def swing(observations):
    """The expert, which sees the speed: (B, 3) -> (B, 1)."""
    cosine, sine, speed = observations.T
    return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]


if __name__ == "__main__":
    for probes in (0, 10):
        result = fdtasil.distill(swing, "Pendulum-v1", probes, episodes=3, student_obs=[0, 1])
        print(f"{probes} probes: {result.evaluation.normalized_return:.2f} without the speed")
    seen = np.array([1.0, 0.0], np.float32)  # cosine and sine
    print(result.student.predict(seen)[0])
