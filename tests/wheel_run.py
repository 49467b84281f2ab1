"""Use what a wheel has installed as who has nothing else does: `make wheel`, `make dist`."""

import json
import platform
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import fdtasil

SHIPPED = "InvertedDoublePendulum-v5"


def fdtasil_says(*arguments: str, folder: str) -> str:
    """Run the command line in a folder that holds nothing but what it wrote itself."""
    line = [str(Path(sys.executable).with_name("fdtasil")), *arguments]
    done = subprocess.run(line, capture_output=True, text=True, cwd=folder)
    if done.returncode != 0:
        raise SystemExit(f"fdtasil {' '.join(arguments)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def main() -> None:
    installed = Path(fdtasil.__file__)
    if "site-packages" not in installed.parts:
        raise SystemExit(f"{installed} is no installed wheel")
    if not installed.with_name("py.typed").exists():
        raise SystemExit("py.typed is missing from the wheel")
    short = ("--episodes", "1", "--horizon", "50", "--evaluation-episodes", "2")
    short += ("--hidden", "16", "--steps", "200", "--out", "run")
    with TemporaryDirectory() as folder:
        version = fdtasil_says("--version", folder=folder)
        if version.split() != ["fdtasil", fdtasil.__version__]:
            raise SystemExit(f"fdtasil --version prints {version!r}")
        if "experts" not in fdtasil_says("--help", folder=folder):
            raise SystemExit("fdtasil --help does not name its commands")
        fdtasil_says("experts", "fetch", SHIPPED, folder=folder)
        fdtasil_says("distill", f"{SHIPPED}.onnx", SHIPPED, *short, folder=folder)
        report = json.loads((Path(folder) / "run" / "report.json").read_bytes())
        if report["queries"]["probe"] == 0:
            raise SystemExit("the run has queried no probes")
        told = report["evaluation"]["student_returns"]
        judged = fdtasil.evaluate(
            Path(folder) / "run" / "student.onnx",
            Path(folder) / f"{SHIPPED}.onnx",
            SHIPPED,
            episodes=2,
            horizon=50,
        )
        if max(abs(a - b) for a, b in zip(judged.student_returns, told, strict=True)) > 1e-3:
            raise SystemExit("the student's ONNX file acts otherwise than the student")
    python = platform.python_version()
    print(f"Python {python}: fdtasil {fdtasil.__version__} fetched, distilled, saved, evaluated")


if __name__ == "__main__":
    main()
