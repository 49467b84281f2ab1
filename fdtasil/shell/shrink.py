"""`fdtasil shrink`: students of several sizes from one run's answers."""

from dataclasses import replace
from inspect import Parameter
from pathlib import Path
from typing import Any

from fdtasil.results.distilled import Distilled
from fdtasil.run.shrinking import LADDER, fit_of, shrink
from fdtasil.shell.call import EXPERT_FLAGS, MADE_FLAGS, beside_run, opened_in
from fdtasil.shell.command import (
    EnvironmentId,
    ExpertPath,
    Flags,
    OptionalInt,
    OptionalPath,
    RunFolder,
    as_command,
)

__all__ = ["command"]


def _shrink(
    run: Path,
    out: Path | None,
    widths: tuple[int, ...],
    layers: int,
    steps: int | None,
    **arguments: Any,
) -> None:
    place_of_runs = beside_run(run, "-shrunk") if out is None else out
    asked, place = opened_in(arguments)
    result = Distilled.load(run)
    found = shrink(
        result,
        asked,
        place,
        sizes=[(width,) * layers for width in widths],
        fit=None if steps is None else replace(fit_of(result), steps=steps, epochs=None),
        out=place_of_runs.absolute(),
        **arguments,
    )
    print(found)
    print(f"saved in {place_of_runs}: sizes.json, sizes.png, and a run for each student")


_WIDTHS = tuple(hidden[0] for hidden in LADDER)
_OUT = (
    "Folder of the runs, one for each student; what is done in it is taken up. Left out, "
    "RUN-shrunk beside the run."
)

command = as_command(
    _shrink,
    [
        Flags(
            shrink,
            only=("keep", "activations", "cloned", "evaluation_episodes", "force", "workers"),
            types={"activations": tuple[str, ...]},
        ),
        EXPERT_FLAGS,
    ],
    {
        "run": (RunFolder, Parameter.empty, "Folder of a finished run."),
        "expert": (ExpertPath, Parameter.empty, "The expert of that run."),
        "env": (EnvironmentId, Parameter.empty, "Its environment."),
        "out": (OptionalPath, None, _OUT),
        "widths": (tuple[int, ...], _WIDTHS, "Of the hidden layers, one student each."),
        "layers": (int, len(LADDER[0]), "Hidden layers of each."),
        "horizon": (
            OptionalInt,
            None,
            "Steps of an episode at most; left out, the run's.",
        ),
        "steps": (OptionalInt, None, "Training steps of each; left out, as many as the run's."),
        **MADE_FLAGS,
    },
)
