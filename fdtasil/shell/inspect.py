"""`fdtasil inspect`: what an expert is, before anything is learnt from it."""

from pathlib import Path
from typing import Any

from fdtasil.checks import check_suffix
from fdtasil.files.storage import write_bytes
from fdtasil.results.figures import draw_calibration
from fdtasil.run.inspecting import inspect
from fdtasil.shell.call import EXPERT_FLAGS, MADE_FLAGS, opened_in
from fdtasil.shell.command import EnvironmentId, ExpertPath, Flags, OptionalPath, as_command
from fdtasil.shell.saying import JSON_FLAG, PRINTED, json_file, say

__all__ = ["command"]

_PICTURE_FLAG: dict[str, tuple[Any, Any, str]] = {
    "picture": (OptionalPath, None, "PNG file to draw the ladder of radii into."),
}


def _inspect(
    json: Path | None,
    picture: Path | None,
    **arguments: Any,
) -> None:
    # Absolute from the beginning: an environment may change the working folder.
    drawn = None if picture is None else check_suffix(picture, ".png").absolute()
    file = json_file(json)
    source, place = opened_in(arguments)
    found = inspect(source, place, **arguments)
    say(found, file)
    if drawn is not None and found.calibration is not None:
        write_bytes(drawn, draw_calibration(found.calibration))
        if file != PRINTED:
            print(f"written: {picture}")
    if found.problem:
        raise found.problem


command = as_command(
    _inspect,
    [Flags(inspect, types={"expert": ExpertPath, "env": EnvironmentId}), EXPERT_FLAGS],
    MADE_FLAGS | JSON_FLAG | _PICTURE_FLAG,
)
