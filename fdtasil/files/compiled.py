"""C files compiled and run on this machine: own ones, and those that the caller trusts."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fdtasil.errors import ExportError, shown

__all__ = ["answers_of", "compiler", "shared_function"]

_SECONDS = 120.0


def compiler() -> str | None:
    """Return the system's C compiler, or None."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def answers_of(source: str, main: str, rows: np.ndarray) -> np.ndarray:
    """Compile a program that answers lines with lines, and ask it.

    Args:
        source: C99, that this library has written.
        main: The macro that makes it a program.
        rows: (B, n) numbers, one line each.

    Returns:
        (B, m) float64 numbers.

    Raises:
        ExportError: If there is no compiler, or the program can't be compiled or run.
    """
    found = compiler()
    if found is None:
        raise ExportError("no C compiler", "cc, gcc or clang", "install one, such as gcc")
    with tempfile.TemporaryDirectory() as folder:
        file, program = Path(folder) / "program.c", Path(folder) / "program"
        file.write_text(source, encoding="utf-8")
        command = [found, "-std=c99", "-O2", f"-D{main}", "-o", str(program), str(file), "-lm"]
        _run(command, "", f"{found} can't compile the C file")
        lines = "\n".join(" ".join(f"{number:.9g}" for number in row) for row in rows)
        said = _run([str(program)], lines, "the compiled C file can't be run")
    return np.array(said.split(), np.float64).reshape(len(rows), -1)


def shared_function(source: str, name: str) -> Callable[[int, int], None]:
    """Compile a file and return one of its functions, which takes two addresses.

    Raises:
        ExportError: If there is no compiler, or the file can't be compiled.
    """
    found = compiler()
    if found is None:
        raise ExportError("no C compiler", "cc, gcc or clang", "install one, such as gcc")
    # What is loaded stays when the file goes; Windows keeps the file, too.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        file, library = Path(folder) / "policy.c", Path(folder) / "policy.so"
        file.write_text(source, encoding="utf-8")
        command = [found, "-std=c99", "-O2", "-shared", "-fPIC", "-o", str(library), str(file)]
        _run([*command, "-lm"], "", f"{found} can't compile the C file")
        # With the interpreter's lock held: the buffers of such a function are static.
        function = getattr(ctypes.PyDLL(str(library)), name)
    function.argtypes, function.restype = [ctypes.c_void_p, ctypes.c_void_p], None
    return function


def _run(command: list[str], lines: str, problem: str) -> str:
    try:
        done = subprocess.run(
            command, input=lines, capture_output=True, text=True, timeout=_SECONDS, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", None) or error
        raise ExportError(
            f"{problem}: {shown(said)[:200]}",
            "a C99 compiler whose programs run here",
            "look at the system's cc, or compile the file elsewhere",
        ) from error
    return done.stdout
