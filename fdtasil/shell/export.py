"""`fdtasil export`: the student of a run as a file for where it will run."""

from pathlib import Path
from typing import Annotated

import tyro

from fdtasil.results.distilled import Distilled
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
    print(f"written: {Distilled.load(run).export(file)}")
    if file.suffix == ".py":
        print(f"it opens the weights: fdtasil export {run} {file.with_suffix('.safetensors')}")
