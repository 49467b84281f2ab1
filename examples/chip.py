"""From an expert to C: the smallest student that keeps the level, judged as compiled code."""

from pathlib import Path

import fdtasil
from fdtasil.files.compiled import compiler

EXPERT = Path(__file__).parent.parent / "experts" / "HalfCheetah-v5.onnx"
ENVIRONMENT, HORIZON = "HalfCheetah-v5", 300

if __name__ == "__main__":
    run = fdtasil.distill(EXPERT, ENVIRONMENT, episodes=1, horizon=HORIZON)
    found = fdtasil.shrink(run, EXPERT, ENVIRONMENT, sizes=[(16, 16), (64, 64)], cloned=False)
    print(found)
    student = found.result or run
    for name in ("student.c", "student.h", "student.onnx", "student.safetensors", "student.py"):
        student.export(name)
    if compiler() is not None:
        chip = fdtasil.load_expert("student.c", trust="c")
        print(fdtasil.evaluate(chip, EXPERT, ENVIRONMENT, episodes=5, horizon=HORIZON))
