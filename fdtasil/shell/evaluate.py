"""`fdtasil evaluate`: a policy beside an expert, from the same starts."""

from pathlib import Path
from typing import Any

from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.evaluating import evaluate
from fdtasil.shell.call import ENVIRONMENT_FLAGS, EXPERT_FLAGS, judged, opened, seen, wanted
from fdtasil.shell.command import EnvironmentId, Flags, PolicyPath, as_command
from fdtasil.shell.saying import JSON_FLAG, json_file, say

__all__ = ["command"]


def _evaluate(
    policy: str,
    expert: str,
    env: str,
    output: str | None,
    inputs: str | None,
    trust: Any,
    json: Path | None,
    **arguments: Any,
) -> None:
    file = json_file(json)
    import_module_of(env)
    place = wanted(env, *(arguments.pop(name) for name in ENVIRONMENT_FLAGS))
    judge = opened(expert, place, output=output, inputs=inputs, trust=trust)
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
