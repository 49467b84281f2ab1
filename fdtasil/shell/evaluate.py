"""`fdtasil evaluate`: a policy beside an expert, from the same starts."""

from pathlib import Path
from typing import Any

from fdtasil.run.evaluating import evaluate
from fdtasil.shell.call import ENVIRONMENT_FLAGS, EXPERT_FLAGS, judged, opened_in, seen
from fdtasil.shell.command import EnvironmentId, Flags, PolicyPath, as_command
from fdtasil.shell.saying import JSON_FLAG, json_file, say

__all__ = ["command"]


def _evaluate(
    policy: str,
    json: Path | None,
    **arguments: Any,
) -> None:
    file, trust = json_file(json), arguments["trust"]
    judge, place = opened_in(arguments, ENVIRONMENT_FLAGS)
    arguments["student_obs"] = seen(arguments["student_obs"])
    say(evaluate(judged(policy, trust), expert=judge, env=place, **arguments), file)


command = as_command(
    _evaluate,
    [
        Flags(
            evaluate,
            without=("constraints", "progress"),
            types={
                "policy": PolicyPath,
                "env": EnvironmentId,
                "expert": str,
                "student_obs": tuple[str, ...] | None,
            },
        ),
        EXPERT_FLAGS,
    ],
    ENVIRONMENT_FLAGS | JSON_FLAG,
)
