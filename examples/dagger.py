"""The student acts, the expert labels, and the run may be killed at any time."""

import sys
from pathlib import Path

import fdtasil

EXPERT = Path(__file__).parent.parent / "experts" / "HalfCheetah-v5.onnx"

if __name__ == "__main__":
    resume = "--resume" in sys.argv  # python dagger.py --resume goes on where it was killed
    result = fdtasil.distill(
        EXPERT,
        "HalfCheetah-v5",
        probes=10,
        trainer=fdtasil.DAgger(updates=(1, 2), beta=0.5),
        episodes=3,
        horizon=300,
        **({"resume": "runs/dagger"} if resume else {"out": "runs/dagger"}),
        callback=lambda event: print(event.kind, event.round, event.step, event.entry["loss"]),
    )
    print(result.evaluation)
