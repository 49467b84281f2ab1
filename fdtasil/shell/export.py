"""`fdtasil export`: the student of a run as a file for where it will run."""

from pathlib import Path
from typing import Annotated

import tyro

from fdtasil.files.compiled import compiler
from fdtasil.files.storage import write_bytes
from fdtasil.results.distilled import Distilled
from fdtasil.results.size import c_microseconds
from fdtasil.shell.command import RunFolder

__all__ = ["command"]

OutFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


def command(run: RunFolder, file: OutFile) -> None:
    """Write the student of a run as the file that a suffix asks for.

    Args:
        run: Folder of a finished run.
        file: Ends with .onnx, .int8.onnx, .safetensors, .tflite, .c (C99 without malloc;
            compiled and compared with the student where there is a compiler), .int8.c (weights
            in eight bits), .h (the header of both) or .py (what answers with numpy alone, from
            the .safetensors).
    """
    result = Distilled.load(run)
    data = result.export_bytes(file)
    write_bytes(file, data)
    print(f"written: {file}")
    if file.suffix == ".c" and compiler() is not None:
        taken = c_microseconds(data.decode(), result.student)
        print(f"one answer takes {taken:,.3g} microseconds here; the file's comment says the rest")
    if file.suffix == ".py":
        print(f"it opens the weights: fdtasil export {run} {file.with_suffix('.safetensors')}")
