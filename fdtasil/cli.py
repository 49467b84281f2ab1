"""The same functions from a shell; every default and help text is read from them."""

import inspect
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
import tyro

from fdtasil.calibration import calibrate
from fdtasil.configuration import check_count
from fdtasil.distilled import Distilled
from fdtasil.environments import EnvironmentPool, resolve_horizon
from fdtasil.errors import FdtasilError, SettingError
from fdtasil.evaluation import interval_text, random_behaviour, score_text
from fdtasil.experts import load_expert
from fdtasil.experts.gate import examine_expert
from fdtasil.figures import draw_calibration
from fdtasil.pipeline import distill, evaluate
from fdtasil.presets import PRESETS
from fdtasil.rollouts import follow, rollout
from fdtasil.sb3 import export_sb3
from fdtasil.scales import statistics
from fdtasil.seeding import episode_seeds, generator
from fdtasil.storage import to_json, write_bytes

__all__ = ["COMMANDS", "main"]

CHANCE = "  (no worse than the expert: does it belong to this environment and version?)"
COMMAND = "command.json"
"""File of a run's folder with the arguments that `fdtasil distill` was called with."""

OptionalExpert = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
OptionalEnvironment = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
ExpertPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
PolicyPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
AgentPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="AGENT.zip")]
EnvironmentId = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]


def inspect_expert(
    expert: ExpertPath,
    env: EnvironmentId,
    /,
    *,
    output: str | None = None,
    episodes: int = 5,
    horizon: int | None = None,
    seed: int = 0,
    picture: Path | None = None,
) -> None:
    """Show what an expert is: its contract with the environment, and the return it reaches.

    Args:
        expert: ONNX file.
        env: Gymnasium id (module:Id imports the module first).
        output: Name of the ONNX output with the actions.
        episodes: Episodes that the return is measured over.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the episodes.
        picture: PNG file to draw the ladder of radii into.
    """
    check_count("episodes", episodes)
    with EnvironmentPool(env) as pool:
        boxes, length = pool.boxes, resolve_horizon(horizon, pool)
        opened = load_expert(expert, boxes.observation_size, boxes.action_size, output=output)
        starts = episode_seeds(seed, "evaluation", 0, episodes)
        recorded = rollout(follow(opened.policy("act")), pool, starts, length)
        noise = [generator(seed, "random actions", episode) for episode in range(episodes)]
        chance = rollout(random_behaviour(pool), pool, starts, length, noise).returns.mean()
        visited = recorded.observations[recorded.valid]
        spread = np.linspace(0, len(visited) - 1, 32).astype(int)
        findings = examine_expert(opened, visited[spread], boxes)
        usual = PRESETS["standard"].radius
        random = generator(seed, "calibration")
        found = calibrate(opened, visited, statistics(visited), random, usual)
    returns, falls = recorded.returns, int(recorded.terminated.sum())
    rows = [
        ("expert", expert),
        ("sha256", opened.sha256),
        ("environment", pool.name),
        ("observations", boxes.observation_size),
        ("actions", f"{boxes.action_size}, from {boxes.low.min():g} to {boxes.high.max():g}"),
        ("analytic", "a torch twin agrees with it" if opened.module else "not available"),
        *((f.name, f"{'FAILED: ' if f.problem else ''}{f.measured}") for f in findings),
        ("regime", found.regime),
        ("noise floor", f"{found.noise_floor:.1e} of the action, root mean square"),
        ("suggested radius", f"{found.radius:.2g} standard deviations, {found.stencil} stencil"),
        ("return", f"{returns.mean():.1f} +- {returns.std():.1f} over {episodes} episodes"),
        ("random actions", f"{chance:.1f}{CHANCE if returns.mean() <= chance else ''}"),
        ("ended early", f"{falls} of {episodes}, of at most {length} steps"),
    ]
    print("\n".join(f"{name:20}{value}" for name, value in rows))
    if picture is not None:
        write_bytes(picture, draw_calibration(found))
        print(f"{'picture':20}{picture}")
    problem = next((finding.problem for finding in findings if finding.problem), None)
    if problem:
        raise problem


def _distill(compare: bool, **arguments: Any) -> None:
    resume = arguments["resume"]
    if resume is not None and arguments["expert"] is None and arguments["env"] is None:
        arguments = {**_remembered(resume), "resume": resume}
    elif resume is None and not (arguments["out"] / "checkpoints").exists():
        plain = {k: str(v) if isinstance(v, Path) else v for k, v in arguments.items()}
        write_bytes(arguments["out"] / COMMAND, to_json(plain))
    result, out = distill(**arguments), resume or arguments["out"]
    plainly = {**arguments, "probes": 0, "out": None, "resume": None, "log_formats": ()}
    print(_side_by_side(result, distill(**plainly) if compare else None))
    asked = ", ".join(f"{name} {rows:,}" for name, rows in result.queries.items() if rows)
    print(f"rows asked of the expert: {asked}")
    print(f"saved in {out}: student.onnx, student.safetensors, report.json, figures/, ...")


def _remembered(folder: Path) -> dict[str, Any]:
    """Return the arguments that a run was begun with.

    Raises:
        SettingError: If there are none, or the environment would import a module that only a
            file names.
    """
    try:
        arguments = json.loads((folder / COMMAND).read_bytes())
    except (OSError, ValueError) as error:
        raise SettingError(
            f"{folder} has no {COMMAND} ({type(error).__name__})",
            "a folder that `fdtasil distill --out` has begun",
            f"repeat the arguments: fdtasil distill EXPERT ENV ... --resume {folder}",
        ) from error
    if ":" in (arguments["env"] or ""):
        raise SettingError(
            f"{folder / COMMAND} names the environment {arguments['env']!r}",
            "an id without a module: importing one runs code, and a file may not ask for that",
            f"repeat the arguments: fdtasil distill EXPERT ENV ... --resume {folder}",
        )
    if arguments["trust"] is not None:
        raise SettingError(
            f"{folder / COMMAND} says trust={arguments['trust']!r}",
            "trust from the caller, never from a file",
            f"repeat the arguments: fdtasil distill EXPERT ENV ... --resume {folder}",
        )
    tuples = {name: tuple(v) for name, v in arguments.items() if isinstance(v, list)}
    return {**arguments, **tuples}


def _export_sb3(**arguments: Any) -> None:
    print(f"written: {export_sb3(**arguments)}")


def _evaluate(**arguments: Any) -> None:
    print(evaluate(**arguments))


def _side_by_side(result: Distilled, cloning: Distilled | None) -> str:
    """Return a table of expert, plain cloning and student."""
    ours = result.evaluation
    if ours is None:
        return f"{result.report['env']}: trained without an evaluation"
    lines = [
        f"{result.report['env']}, {ours.episodes} paired episodes of {ours.horizon} steps",
        f"{'':15}{'return':>10}{'normalised':>12}{'95 % interval':>18}{'survival':>10}",
        f"{'expert':15}{ours.expert_return:10.1f}{1:12.3f}{'':18}{ours.expert_survival:10.2f}",
    ]
    students = {"plain cloning": cloning, "student": result}
    for name, one in students.items():
        if one is not None and one.evaluation is not None:
            e = one.evaluation
            lines.append(
                f"{name:15}{e.student_return:10.1f}{score_text(e.normalized_return):>12}"
                f"{interval_text(e.ci95):>18}{e.survival:10.2f}"
            )
    return "\n".join(lines)


def as_command(
    function: Callable[..., Any],
    run: Callable[..., None],
    shell_types: dict[str, Any],
    added: dict[str, tuple[Any, Any, str]],
) -> Callable[..., None]:
    """Return `run` as a command with the arguments, defaults and help texts of `function`.

    Args:
        function: Whose signature and docstring are read.
        run: Called with the parsed arguments.
        shell_types: Types of those arguments that a shell can't express as `function` takes
            them, by name.
        added: Type, default and help text of arguments that only the command has.
    """

    def command(**arguments: Any) -> None:
        run(**arguments)

    parameters = [
        _shell_parameter(parameter, shell_types)
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in _ONLY_PYTHON
    ]
    parameters = [parameter for parameter in parameters if parameter.name not in added]
    for name, (kind, default, _) in added.items():
        parameters.append(
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind
            )
        )
    command.__dict__["__signature__"] = inspect.Signature(parameters)
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    head, _, rest = (inspect.getdoc(function) or "").partition("Args:\n")
    texts = [rest.partition("\n\n")[0]]
    texts += [f"    {name}: {text}" for name, (_, _, text) in added.items()]
    command.__doc__ = f"{head}Args:\n" + "\n".join(texts)
    return command


# Bars are silent by themselves where there is no terminal; a function has no name in a shell.
_ONLY_PYTHON = ("progress", "callback")
_METAVARS: dict[Any, str] = {tuple: "INT [INT ...]", int: "INT", float: "FLOAT"}


def _shell_parameter(
    parameter: inspect.Parameter, shell_types: dict[str, Any]
) -> inspect.Parameter:
    kind = shell_types.get(parameter.name, parameter.annotation)
    default = str(parameter.default) if parameter.name == "probes" else parameter.default
    if get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind):
        # tyro would show "{None}|INT"; leaving the argument out is how a shell says None.
        inner = next(one for one in get_args(kind) if one is not NoneType)
        metavar = _METAVARS.get(get_origin(inner) or inner, "TEXT")
        kind = Annotated[kind, tyro.conf.arg(metavar=metavar)]
    return parameter.replace(annotation=kind, default=default, kind=inspect.Parameter.KEYWORD_ONLY)


COMMANDS: dict[str, Callable[..., None]] = {
    "inspect": inspect_expert,
    "distill": as_command(
        distill,
        _distill,
        {
            "expert": OptionalExpert,
            "env": OptionalEnvironment,
            "probes": str,
            "trainer": str,
            "demonstrations": str | None,
            "student_obs": tuple[int, ...] | None,
            "resume": Path | None,
        },
        {
            "out": (Path, Path("runs/latest"), "Folder of the run."),
            "compare": (bool, False, "Also clone plainly, without probes, and show both."),
        },
    ),
    "export-sb3": as_command(
        export_sb3,
        _export_sb3,
        {
            "agent_zip": AgentPath,
            "out": Path,
            "env": str | None,
            "vecnormalize": str | None,
            "action_low": float | None,
            "action_high": float | None,
        },
        {},
    ),
    "evaluate": as_command(
        evaluate, _evaluate, {"policy": PolicyPath, "env": EnvironmentId, "expert": str}, {}
    ),
}


def main() -> None:
    """Run the command line; exit code 0 done, 1 failed, 2 wrong use, 128 + N signal N."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="fdtasil", description="Distil a black-box controller.", config=()
        )
    except FdtasilError as error:
        print("\n  ".join([f"fdtasil: {error}", *_notes(error)]), file=sys.stderr)
        sys.exit(2 if isinstance(error, SettingError) else 1)
    except KeyboardInterrupt as error:
        print("; ".join(["fdtasil: interrupted", *_notes(error)]), file=sys.stderr)
        sys.exit(130)
    except SystemExit as error:
        if _notes(error):  # of a run that was told to end
            print("; ".join(["fdtasil: terminated", *_notes(error)]), file=sys.stderr)
        raise


def _notes(error: BaseException) -> list[str]:
    return getattr(error, "__notes__", [])
