"""Run what a wheel has installed, in a folder that holds nothing: `make wheel`."""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import fdtasil


def swing(observations):
    """Hold a pendulum up, by angle and speed: (B, 3) -> (B, 1)."""
    cosine, sine, speed = observations.T
    return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]


def main() -> None:
    installed = Path(fdtasil.__file__)
    if "site-packages" not in installed.parts:
        raise SystemExit(f"{installed} is no installed wheel")
    if not installed.with_name("py.typed").exists():
        raise SystemExit("py.typed is missing from the wheel")
    shown = subprocess.run(
        [Path(sys.executable).with_name("fdtasil"), "--version"], capture_output=True, text=True
    )
    if shown.stdout.split() != ["fdtasil", fdtasil.__version__]:
        raise SystemExit(f"fdtasil --version prints {shown.stdout + shown.stderr!r}")
    with TemporaryDirectory() as folder:
        result = fdtasil.distill(
            swing,
            "Pendulum-v1",
            probes=4,
            episodes=2,
            horizon=50,
            evaluation_episodes=2,
            student=fdtasil.Mlp(16),
            fit=fdtasil.Fit(steps=100),
            out=Path(folder) / "run",
        )
        judged = fdtasil.evaluate(
            Path(folder) / "run" / "student.onnx", swing, "Pendulum-v1", episodes=2, horizon=50
        )
        if judged.student_returns != result.evaluation.student_returns:
            apart = zip(judged.student_returns, result.evaluation.student_returns, strict=True)
            if max(abs(a - b) for a, b in apart) > 1e-3:
                raise SystemExit("the student's ONNX file acts otherwise than the student")
    print(f"fdtasil {fdtasil.__version__} from {installed.parent}: distilled, saved, evaluated")


if __name__ == "__main__":
    main()
