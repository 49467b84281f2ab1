"""`fdtasil diagnose`: how well a student's derivatives are its expert's."""

from pathlib import Path
from typing import Any

from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.diagnosing import diagnose
from fdtasil.shell.call import EXPERT_FLAGS, MADE_FLAGS, judged, opened, wanted
from fdtasil.shell.command import EnvironmentId, Flags, PolicyPath, as_command
from fdtasil.shell.saying import JSON_FLAG, json_file, say

__all__ = ["command"]


def _diagnose(
    student: str,
    expert: str,
    env: str,
    output: str | None,
    inputs: str | None,
    trust: Any,
    json: Path | None,
    env_kwargs: str | None,
    reset_options: str | None,
    **arguments: Any,
) -> None:
    file = json_file(json)
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    asked = opened(expert, place, output=output, inputs=inputs, trust=trust)
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
