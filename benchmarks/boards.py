"""A student as C on microcontrollers: flash, memory, stack, instructions, and the same answers."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

import fdtasil
from benchmarks.board import BOARDS, on_board, sizes_of
from benchmarks.controllers import CONTROLLERS
from benchmarks.runner import Benchmark, Cell, Row
from benchmarks.tables import table
from fdtasil.files.compiled import answers_of, shared_function
from fdtasil.results.distilled import Distilled
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout

__all__ = ["BENCHMARK"]

EXPERT = "HalfCheetah-v5"
STUDENTS: dict[str, Any] = {
    "64 x 64, relu": "micro",
    "256 x 256, gelu": fdtasil.Mlp((256, 256)),
    "512 x 512, gelu": fdtasil.Mlp((512, 512)),
}
HERE = "x86-64"
OWN = {"fdtasil": "student.c", "fdtasil, int8": "student.int8.c"}
OTHER = "emx-onnx-cgen"
STATES = 10_000  # real ones, and as many from a normal distribution of deviation 10
ON_BOARD = 100
ROUNDS = 20
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic")


def cells(quick: bool) -> list[Cell]:
    """Every student on every board, and the smallest as another generator writes it."""
    students = list(STUDENTS)[:1] if quick else list(STUDENTS)
    machines = [*BOARDS, HERE]
    own = [
        {"student": s, "code": c, "machine": m} for s in students for c in OWN for m in machines
    ]
    return own + [{"student": students[0], "code": OTHER, "machine": m} for m in machines]


def measure(cell: Cell, device: str) -> dict[str, Any]:
    """Measure one cell; where, it says itself."""
    result, states = _student(cell["student"]), _states()
    code = cell["code"]
    source = _others(result) if code == OTHER else result.export_bytes(OWN[code]).decode()
    header = result.export_bytes("student.h").decode()
    if cell["machine"] == HERE:
        answers = answers_of(source + _MAIN, "STUDENT_LINES", states)
        ours = _apart(result.student.act(states), states, result)
        apart = _apart(answers, states, result)
        return {**_built_here(source, header), "apart": apart, "torch apart": ours}
    rows = np.concatenate([states[:ON_BOARD], states[-ON_BOARD:]])
    found = on_board(BOARDS[cell["machine"]], source, header, rows)
    sizes = {name: getattr(found, name) for name in ("flash", "ram", "stack", "instructions")}
    return {**sizes, "apart": _apart(found.answers, rows, result)}


def _apart(answers: np.ndarray, rows: np.ndarray, result: Distilled) -> list[float]:
    """Return the largest distances from the student in float64: on real states, on far ones."""
    exact = deepcopy(result.student).double()
    with torch.no_grad():
        expected = exact(torch.from_numpy(rows).double()).numpy()
    distances = np.abs(answers - expected) / (2 * result.student.action_units.numpy())
    return [float(half.max()) for half in np.split(distances, 2)]


@cache
def _student(name: str) -> Distilled:
    """Return a student from one trajectory of 300 steps."""
    controller = CONTROLLERS[EXPERT]
    shape = {"episodes": 1, "horizon": 300, "evaluation_episodes": 0}
    return fdtasil.distill(
        controller.path, controller.environment, student=STUDENTS[name], **shape
    )


@cache
def _states() -> np.ndarray:
    """Return (2 STATES, n) float32: the expert's own states, then far ones."""
    controller = CONTROLLERS[EXPERT]
    expert = fdtasil.load_expert(controller.path)
    with EnvironmentPool(controller.environment) as pool:
        seeds = list(range(STATES // 1000))
        real = np.concatenate(
            rollout(follow(expert.policy("act")), pool, seeds, 1000).observations
        )
    far = 10 * np.random.default_rng(0).standard_normal((STATES, real.shape[1]))
    return np.concatenate([real[:STATES], far]).astype(np.float32)


def _others(result: Distilled) -> str:
    """Return the C that another generator makes of the ONNX file, all of it on the stack."""
    tool = shutil.which(OTHER) or shutil.which(OTHER, path=str(Path(sys.executable).parent))
    if tool is None:
        raise RuntimeError(f"no {OTHER}: pip install {OTHER}")
    with TemporaryDirectory() as folder:
        model, file = result.export(Path(folder) / "student.onnx"), Path(folder) / "student.c"
        inline = ("--large-temp-threshold", "0", "--large-weight-threshold", "0")
        command = [tool, "compile", *inline, "--model-name", "model", str(model), str(file)]
        subprocess.run(command, check=True, capture_output=True)
        written = file.read_text()
    header = result.export_bytes("student.h").decode()
    return f"{written}\n{header}\n{_WRAPPED}"


_WRAPPED = """void student(const float observation[STUDENT_OBSERVATIONS],
             float action[STUDENT_ACTIONS])
{
    model(1, (const float (*)[STUDENT_OBSERVATIONS])observation,
          (float (*)[STUDENT_ACTIONS])action);
}
"""
# A program of lines for every generator.
_MAIN = """
#ifdef STUDENT_LINES
#include <stdio.h>
int main(void)
{
    float x[STUDENT_OBSERVATIONS], u[STUDENT_ACTIONS];
    int i;
    for (;;) {
        for (i = 0; i < STUDENT_OBSERVATIONS; i++)
            if (scanf("%f", &x[i]) != 1)
                return 0;
        student(x, u);
        for (i = 0; i < STUDENT_ACTIONS; i++)
            printf("%.9g ", (double)u[i]);
    }
}
#endif
"""


def _built_here(source: str, header: str) -> dict[str, Any]:
    """Bytes, microseconds, and what compiler, linker and sanitisers say of the code."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "student.h").write_text(header)
        (folder / "student.c").write_text(source)
        (folder / "main.c").write_text(source + _MAIN)
        built, strict = folder / "student.o", folder / "strict.o"
        _compile(folder / "student.c", built, "-std=c99", "-c")
        warned = _compile(folder / "student.c", strict, *STRICT, "-c", check=False)
        flash, ram = sizes_of(built, "size")
        listed = subprocess.run(["nm", built], capture_output=True, text=True, check=True).stdout
        wanted = sorted(line.split()[-1] for line in listed.splitlines() if " U " in line)
        checked = folder / "checked"
        sanitisers = ("-fsanitize=address,undefined", "-fno-sanitize-recover")
        _compile(folder / "main.c", checked, "-std=c99", "-DSTUDENT_LINES", *sanitisers)
        rows = np.concatenate([_states()[:ON_BOARD], _states()[-ON_BOARD:]])
        lines = "\n".join(" ".join(f"{x:.9g}" for x in row) for row in rows)
        ran = subprocess.run([checked], input=lines, capture_output=True, text=True)
    return {
        "flash": flash,
        "ram": ram,
        "microseconds": _microseconds(source),
        "warnings": warned.count("warning:"),
        "calls": wanted,
        "sanitisers find": ran.stderr.splitlines()[:1],
    }


def _microseconds(source: str) -> float:
    """Return the microseconds of an answer, of the fastest of some rounds, by the C clock."""
    timed = shared_function(source + _TIMED, "timed")
    rows = np.ascontiguousarray(_states()[:1000])
    seconds = np.zeros(1, np.float64)
    found = []
    for _ in range(ROUNDS):
        timed(rows.ctypes.data, seconds.ctypes.data)
        found.append(float(seconds[0]))
    return round(1e6 * min(found) / len(rows), 3)


_TIMED = """
#include <time.h>
void timed(const float *rows, double *seconds)
{
    float action[STUDENT_ACTIONS];
    const clock_t start = clock();
    int i;
    for (i = 0; i < 1000; i++)
        student(rows + i * STUDENT_OBSERVATIONS, action);
    *seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
}
"""


def _compile(file: Path, out: Path, *flags: str, check: bool = True) -> str:
    command = ["cc", "-O2", *flags, "-o", str(out), str(file), "-lm"]
    return subprocess.run(command, check=check, capture_output=True, text=True).stderr


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: a line for each cell."""
    lines = []
    for row in rows:
        cell, result = row["cell"], row["result"]
        time = f"{result['microseconds']:.1f} us" if "microseconds" in result else ""
        taken = f"{result['instructions']:,}" if "instructions" in result else time
        stack = f"{result['stack']:,}" if "stack" in result else ""
        sizes = [f"{result[name]:,}" for name in ("flash", "ram")]
        apart = [f"{distance:.1e}" for distance in result["apart"]]
        lines.append(
            [cell["student"], cell["code"], cell["machine"], *sizes, stack, taken, *apart]
        )
    heads = ["student", "code", "machine", "flash", "memory", "stack", "one answer"]
    shown = table([*heads, "apart, real", "apart, far"], lines)
    here = [row for row in rows if "calls" in row["result"]]
    said = "\n".join(_checks(row["cell"], row["result"]) for row in here)
    return {"boards.md": f"{shown}\n{_NOTES}\n\n{said}\n".encode()}


_NOTES = f"""\
{EXPERT}. Bytes. On a Cortex-M (arm-none-eabi-gcc -O2, newlib-nano, QEMU) with what libm takes, and
an answer's instructions, which are not cycles. On x86-64 without libm.

Apart: the largest distance from the student in float64, as a share of an action's range; on
{STATES:,} real states and as many from N(0, 10), on a board {ON_BOARD} of each."""


def _checks(cell: Cell, result: dict[str, Any]) -> str:
    real, far = result["torch apart"]
    warned = f"{result['warnings'] or 'no'} warnings"
    found = "; ".join(result["sanitisers find"]) or "nothing"
    return (
        f"- {cell['student']}, {cell['code']}: {warned} of {' '.join(STRICT[1:])}; the sanitisers "
        f"of addresses and undefined behaviour find {found}; it calls "
        f"{', '.join(result['calls'])}. torch is {real:.1e} and {far:.1e} apart."
    )


BENCHMARK = Benchmark("boards", __doc__ or "", cells, measure, draw, alone=True)
