"""The same functions from a shell; every default and help text is read from them."""

import json
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from typing import Any

import tyro

from fdtasil.errors import FdtasilError, FdtasilWarning, SettingError
from fdtasil.experts.expert import rows_text
from fdtasil.experts.sb3.export import export_sb3
from fdtasil.files.lock import locked
from fdtasil.files.storage import is_written, to_json, write_bytes
from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation, interval_text, score_text
from fdtasil.run.pipeline import distill, evaluate
from fdtasil.shell.beside import evaluated_beside
from fdtasil.shell.command import (
    AgentPath,
    EnvironmentId,
    OptionalEnvironment,
    OptionalExpert,
    OptionalText,
    PolicyPath,
    as_command,
    import_module_of,
)
from fdtasil.shell.inspect import inspect_expert

__all__ = ["COMMANDS", "main"]

COMMAND = "command.json"
"""File of a run's folder with the arguments that `fdtasil distill` was called with."""
_BESIDE = ("resume", "max_queries", "device")  # what may be said of a run that goes on


def _distill(compare: bool, **arguments: Any) -> None:
    resume = arguments["resume"]
    if arguments["device"] is None:
        del arguments["device"]  # the library's own, or the one that the run was begun on
    import_module_of(arguments["env"])
    if resume is not None and arguments["expert"] is None and arguments["env"] is None:
        _check_alone(arguments)
        mine = {name: arguments.get(name) for name in _BESIDE}
        mine = {name: value for name, value in mine.items() if value is not None}
        arguments = {**_remembered(resume), **mine}
    out = arguments["out"] if resume is None else resume
    plainly = {**arguments, "probes": 0, "out": None, "resume": None, "log_formats": ()}
    with evaluated_beside(plainly if compare else None) as cloning:
        if resume is None:
            with _remembering(arguments):
                result = distill(**arguments)
        else:
            result = distill(**{**arguments, "out": None})  # it stays in its own folder
        print(_side_by_side(result, cloning()))
    print(f"rows asked of the expert: {rows_text(result.queries)}")
    print(f"saved in {out}: student.onnx, student.safetensors, report.json, figures/, ...")


@contextmanager
def _remembering(arguments: dict[str, Any]) -> Iterator[None]:
    """Keep the arguments of a run beside it, for `--resume`; not those of one that never began."""
    folder: Path = arguments["out"]
    if (folder / "checkpoints").exists():  # of another run, which is refused in a moment
        yield
        return
    if is_written(folder):
        print(f"{folder} holds a finished run, which this one replaces", file=sys.stderr)
    plain = {k: str(v) if isinstance(v, Path) else v for k, v in arguments.items()}
    path = folder / COMMAND
    with locked(folder):  # another run's arguments stay its own
        before = path.read_bytes() if path.exists() else None
        write_bytes(path, to_json(plain))
    try:
        yield
    except BaseException:
        if not (folder / "checkpoints").exists():
            if before is None:
                path.unlink(missing_ok=True)
                with suppress(OSError):  # only an empty folder goes
                    folder.rmdir()
            else:
                write_bytes(path, before)
        raise


def _check_alone(arguments: dict[str, Any]) -> None:
    """Refuse arguments beside a `--resume` that remembers them all.

    Raises:
        SettingError: If there are some.
    """
    usual = {name: p.default for name, p in signature(COMMANDS["distill"]).parameters.items()}
    given = [
        f"--{name.replace('_', '-')}"
        for name, value in arguments.items()
        if name not in _BESIDE and value != usual[name]
    ]
    if given:
        raise SettingError(
            f"{', '.join(given)} beside --resume {arguments['resume']}",
            "--resume alone: a run goes on as it was begun",
            "leave them out, or begin another run with --out",
        )


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
            f"{folder / COMMAND} can't be read ({type(error).__name__})",
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
    import_module_of(arguments["env"])
    print(evaluate(**arguments))


def _side_by_side(result: Distilled, cloning: Evaluation | None) -> str:
    """Return a table of expert, plain cloning and student."""
    ours = result.evaluation
    if ours is None:
        return f"{result.report['env']}: trained without an evaluation"
    lines = [
        f"{result.report['env']}, {ours.episodes} paired episodes of {ours.horizon} steps",
        f"{'':15}{'return':>10}{'normalised':>12}{'95 % interval':>18}{'survival':>10}",
        f"{'expert':15}{ours.expert_return:10.1f}{1:12.3f}{'':18}{ours.expert_survival:10.2f}",
    ]
    for name, e in {"plain cloning": cloning, "student": ours}.items():
        if e is not None:
            lines.append(
                f"{name:15}{e.student_return:10.1f}{score_text(e.normalized_return):>12}"
                f"{interval_text(e.ci95):>18}{e.survival:10.2f}"
            )
    return "\n".join(lines)


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
            "device": (
                OptionalText,
                None,
                'Where the student is trained: "cpu" (as without it), "cuda", "cuda:N"; beside '
                "--resume, where it goes on.",
            ),
            "compare": (
                bool,
                False,
                "Also clone plainly, without probes, in a process beside it, and show both.",
            ),
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
    if sys.argv[1:] == ["--version"]:
        print(f"fdtasil {version('fdtasil')}")
        return
    with warnings.catch_warnings():
        warnings.showwarning = _plainly(warnings.showwarning)
        _run()


def _plainly(shown: Callable[..., None]) -> Callable[..., None]:
    """Show the library's own warnings as a shell's user reads them, without a line of source."""

    def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
        if issubclass(category, FdtasilWarning):
            print(f"fdtasil: warning: {message}", file=sys.stderr)
        else:
            shown(message, category, *where)

    return show


def _run() -> None:
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
