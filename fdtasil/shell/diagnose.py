"""`fdtasil diagnose`: how well a student's derivatives are its expert's."""

from pathlib import Path
from typing import Any

from fdtasil.run.diagnosing import diagnose
from fdtasil.shell.call import EXPERT_FLAGS, MADE_FLAGS, judged, opened_in
from fdtasil.shell.command import EnvironmentId, Flags, PolicyPath, as_command
from fdtasil.shell.saying import JSON_FLAG, json_file, say

__all__ = ["command"]


def _diagnose(
    student: str,
    json: Path | None,
    **arguments: Any,
) -> None:
    file, trust = json_file(json), arguments["trust"]
    asked, place = opened_in(arguments)
    say(diagnose(judged(student, trust), asked, place, **arguments), file)


command = as_command(
    _diagnose,
    [
        Flags(
            diagnose,
            without=("progress",),
            types={"student": PolicyPath, "env": EnvironmentId, "expert": str},
        ),
        EXPERT_FLAGS,
    ],
    MADE_FLAGS | JSON_FLAG,
)
