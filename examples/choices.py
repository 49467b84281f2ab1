"""Discrete actions: an agent's scores are learnt, or its choices where it says no more."""

from pathlib import Path

import numpy as np
import onnxruntime

import fdtasil

EXPERT = Path(__file__).parent.parent / "experts" / "CartPole-v1-DQN.onnx"

if __name__ == "__main__":
    session = onnxruntime.InferenceSession(EXPERT)

    def choose(observations):
        """(B, 4) -> (B,) what it chooses."""
        return np.argmax(session.run(None, {"obs": observations})[0], axis=1)

    for name, expert in (("scores", EXPERT), ("choices", choose)):
        result = fdtasil.distill(expert, "CartPole-v1", episodes=1)
        told = result.evaluation
        print(f"{name}: {told.student_return:.0f}, agreement {told.agreement:.2f}")
