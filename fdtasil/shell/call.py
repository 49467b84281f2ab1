"""A call of `distill` from the flat arguments of a shell."""

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from fdtasil.errors import SettingError, shown
from fdtasil.experts.load import ExpertLike, expert_in, load_expert
from fdtasil.files.reading import from_json
from fdtasil.results.distilled import Distilled
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.wanted import Environment, import_module_of
from fdtasil.run.events import Log
from fdtasil.run.pipeline import distill
from fdtasil.run.presets import preset_of
from fdtasil.shell.command import Flags, OptionalText
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import Fit

__all__ = [
    "ENVIRONMENT_FLAGS",
    "EXPERT_FLAGS",
    "MADE_FLAGS",
    "beside_run",
    "distil",
    "judged",
    "opened",
    "opened_in",
    "seen",
    "wanted",
]

Arguments = Mapping[str, Any]

_KWARGS_TEXT = """What the environment is made with, as JSON: '{"healthy_z_range": [0.8, 2.0]}'."""
_OPTIONS_TEXT = "What each reset is given as its options, as JSON."
MADE_FLAGS: dict[str, tuple[Any, Any, str]] = {
    "env_kwargs": (OptionalText, None, _KWARGS_TEXT),
    "reset_options": (OptionalText, None, _OPTIONS_TEXT),
}
"""Arguments of a command: how an environment is made and reset."""
ENVIRONMENT_FLAGS = MADE_FLAGS | {
    "num_envs": (
        int,
        0,
        "Environments that step together, each in a process of its own; 0 for copies in this one.",
    ),
}
"""Arguments of a command: how an environment is made and reset."""


EXPERT_FLAGS = Flags(load_expert, only=("output", "inputs", "trust"), types={"inputs": str | None})
"""Arguments of a command: how an expert is opened."""


def wanted(
    env: str, env_kwargs: str | None, reset_options: str | None, num_envs: int = 0
) -> Environment | str:
    """Return an environment that is made and reset as flags say; its id, where they say nothing.

    Raises:
        SettingError: If a text is no JSON object.
    """
    if not (env_kwargs or reset_options or num_envs):
        return env
    kwargs, options = _object("env_kwargs", env_kwargs), _object("reset_options", reset_options)
    return Environment(env, kwargs, options, num_envs)


def _object(name: str, text: str | None) -> dict[str, Any] | None:
    if text is None:
        return None
    try:
        found = from_json(text.encode())
    except ValueError:
        found = None
    if not isinstance(found, dict):
        flag = f"--{name.replace('_', '-')}"
        example = f"""write {flag} '{{"name": 1.0}}'"""
        raise SettingError(f"{name}={shown(text)!r}", "a JSON object", example)
    return found


def opened_in(
    arguments: dict[str, Any], made: Mapping[str, object] = MADE_FLAGS
) -> tuple[ExpertLike, Environment | str]:
    """Take expert and environment out of a command's arguments, opened and made as flags say.

    Args:
        arguments: By name; those that are of the two are removed.
        made: The flags that say how the environment is made.

    Raises:
        ExpertError: If the expert can't be opened.
        SettingError: If a text is no JSON object.
    """
    env = arguments.pop("env")
    import_module_of(env)
    place = wanted(env, *(arguments.pop(name) for name in made))
    how = {name: arguments.pop(name) for name in ("output", "inputs", "trust")}
    return opened(arguments.pop("expert"), place, **how), place


def beside_run(run: Path, ending: str) -> Path:
    """Return what is named after a run's folder, and lies beside it; "." and ".." have names."""
    named = run if run.name not in ("", "..") else Path(os.path.abspath(run))
    return named.with_name(f"{named.name}{ending}")


def distil(arguments: Arguments, *, progress: bool = True) -> Distilled:
    """Distil: fields of `Fit` and `Mlp`, and options of `load_expert`, stand beside the others.

    Args:
        arguments: By name; None where one was left out.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        FdtasilError: As `distill`.
    """
    rest = dict(arguments)
    fit = {field.name: rest.pop(field.name) for field in fields(Fit)}
    said = {field.name: rest.pop(field.name) for field in fields(Mlp)}
    network = {name: value for name, value in said.items() if value is not None}
    student = rest.pop("student", None)
    if student is not None and network:
        flags = " ".join(f"--{name}" for name in network)
        raise SettingError(
            f"--student {student} beside {flags}", "one of them", f"leave out {flags}"
        )
    output, inputs, trust = (rest.pop(name) for name in ("output", "inputs", "trust"))
    formats = rest.pop("log_formats")
    rest["student_obs"] = seen(rest.get("student_obs"))
    made = [rest.pop(name, usual) for name, (_, usual, _) in ENVIRONMENT_FLAGS.items()]
    if rest["env"] is not None:
        rest["env"] = wanted(rest["env"], *made)
    if rest["expert"] is not None:
        how = {"output": output, "inputs": inputs, "trust": trust}
        rest["expert"] = opened(rest["expert"], rest["env"], **how)
    folder = Path(rest["out"] or rest["resume"] or ".")
    return distill(
        **rest,
        student=Mlp(**network) if network else student,
        fit=preset_of(rest["preset"]).fit_with(**fit),
        callback=Log(folder / "log", *formats) if formats else None,
        progress=progress,
    )


def seen(tokens: tuple[str, ...] | None) -> tuple[int, ...] | tuple[str, ...] | None:
    """Return what a student sees: indices, or names of parts."""
    if tokens is None:
        return None
    numbers = [token for token in tokens if token.isascii() and token.isdigit()]
    return tuple(map(int, numbers)) if len(numbers) == len(tokens) else tokens


def judged(policy: str, trust: Any) -> ExpertLike:
    """Return a policy that is judged, opened with the trust that its kind asks for."""
    asks = trust is not None and Path(policy).suffix in (".c", ".zip")
    return load_expert(policy, trust=trust) if asks else policy


def opened(
    expert: str,
    env: Environment | str | None,
    *,
    output: str | None,
    inputs: str | None,
    trust: Any,
) -> ExpertLike:
    """Return an expert opened with options; as it is, where there are none.

    Raises:
        ExpertError: If it can't be opened.
    """
    if output is None and inputs is None and trust is None:
        return expert
    if env is None:
        return load_expert(expert, output=output, inputs=inputs, trust=trust)
    with EnvironmentPool(env) as pool:  # whose spaces tell which output holds the actions
        return expert_in(expert, pool, output=output, inputs=inputs, trust=trust)
