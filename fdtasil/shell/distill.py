"""`fdtasil distill`: a run from a shell, with a baseline beside it, and gone on with."""

import inspect
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

from fdtasil.errors import SettingError, StorageError, shown, without_secrets
from fdtasil.experts.expert import rows_text
from fdtasil.experts.http_expert import is_http_url
from fdtasil.experts.hub import is_hub_uri
from fdtasil.files.border import reads
from fdtasil.files.lock import locked
from fdtasil.files.names import inside
from fdtasil.files.plain import as_kind
from fdtasil.files.reading import read_plain
from fdtasil.files.run_format import CHECKPOINTS, COMMAND, check_free, stamped, unstamped
from fdtasil.files.storage import remove_file, remove_if_empty, write_bytes
from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation, interval_text, missing_text, score_text
from fdtasil.results.size import size_text
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.pipeline import distill
from fdtasil.shell.beside import evaluated_beside
from fdtasil.shell.call import ENVIRONMENT_FLAGS, EXPERT_FLAGS, distil
from fdtasil.shell.command import (
    Flags,
    OptionalEnvironment,
    OptionalExpert,
    OptionalText,
    as_command,
)
from fdtasil.shell.saying import JSON_FLAG, json_file, say
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import Fit

__all__ = ["command"]

_LIMIT = 2**20  # bytes of the file with the arguments that `fdtasil distill` was called with
_NOT_STORED = ("out", "resume", "device", "baseline", "json")
# What may be said of a run that goes on.
_BESIDE = ("resume", "max_queries", "device", "baseline", "json")


def _distill(baseline: bool, json: Path | None, **arguments: Any) -> None:
    resume, file = arguments["resume"], json_file(json)
    if arguments["device"] is None:
        del arguments["device"]  # the library's own, or the one that the run was begun on
    _check_places(arguments)
    import_module_of(arguments["env"])
    if resume is not None and arguments["expert"] is None and arguments["env"] is None:
        _check_alone(resume, sys.argv)
        mine = {name: arguments.get(name) for name in _BESIDE}
        mine = {name: value for name, value in mine.items() if value is not None}
        arguments = {**_remembered(resume), **mine}
    out = arguments["out"] if resume is None else resume
    # Absolute from the beginning: an environment may change the working folder.
    folder = out.absolute()
    place = {"out": folder} if resume is None else {"out": None, "resume": folder}
    if baseline:
        _check_baseline(arguments)
    plainly = {**arguments, "probes": 0, "out": None, "resume": None, "log_formats": ()}
    with evaluated_beside(plainly if baseline else None) as cloning:
        if resume is None:
            with _remembering(arguments, folder):
                result = distil({**arguments, **place})
        else:
            result = distil({**arguments, **place})  # it stays in its own folder
        say(_Outcome(result, cloning(), out), file)


@dataclass(frozen=True)
class _Outcome:
    """What a run came to, with the plain cloning beside it, if there was one."""

    result: Distilled
    cloning: Evaluation | None
    out: Path

    def to_json(self) -> dict[str, Any]:
        """Return what `report.json` holds, with the baseline's evaluation and the folder."""
        baseline = None if self.cloning is None else self.cloning.to_json()
        return {**self.result.report, "baseline": baseline, "folder": str(self.out)}

    def __str__(self) -> str:
        report = self.result.report
        chosen = report.get("probes_chosen")
        queries = f"queries: {rows_text(self.result.queries) or 'none'}"
        sizes = (f"{name}: {size_text(size)}" for name, size in report["size"].items())
        return "\n".join(
            [
                _side_by_side(self.result, self.cloning),
                queries + (f" ({shown(chosen)})" if chosen else ""),
                "; ".join(sizes),
                f"saved in {self.out}: student.onnx, student.safetensors, report.json, "
                "figures/, ...",
            ]
        )


def _check_baseline(arguments: dict[str, Any]) -> None:
    """Refuse a baseline that is the run itself, or that nobody would see.

    Raises:
        SettingError: If it is one.
    """
    cloned, unseen = arguments["probes"] == "0", arguments["evaluation_episodes"] == 0
    if cloned or unseen:
        with_it = "--probes 0, which clones plainly" if cloned else "--evaluation-episodes 0"
        raise SettingError(
            f"--baseline beside {with_it}",
            "a run with probes that is judged, for the baseline to be compared with",
            "leave --baseline out",
        )


def _check_places(arguments: dict[str, Any]) -> None:
    """Refuse two folders, and flags that have swallowed what stands behind them.

    Raises:
        SettingError: If there are some.
    """
    out, resume = arguments["out"], arguments["resume"]
    if resume is not None and "--out" in _flags(sys.argv) and out.absolute() != resume.absolute():
        raise SettingError(
            f"--out {out} beside --resume {resume}",
            "one folder: a run ends where it began",
            "leave --out out",
        )
    if arguments["expert"] is not None and arguments["env"] is not None:
        return
    for name in ("student_obs", "log_formats"):
        taken = arguments[name] or ()
        if eaten := [word for word in taken if _is_expert(word) or word in gymnasium.registry]:
            flag = f"--{name.replace('_', '-')}"
            raise SettingError(
                f"{flag} {' '.join(taken)}",
                f"EXPERT and ENV before flags of several values, which take {eaten[0]} along",
                f"write fdtasil distill {' '.join(eaten)} {flag} ...",
            )


def _is_expert(word: str) -> bool:
    return Path(word).suffix in (".onnx", ".zip", ".c") or is_http_url(word) or is_hub_uri(word)


def _flags(line: list[str]) -> set[str]:
    return {word.partition("=")[0] for word in line if word.startswith("--")}


@contextmanager
def _remembering(arguments: dict[str, Any], folder: Path) -> Iterator[None]:
    """Keep the arguments of a run beside it, for `--resume`; not those of one that never began."""
    check_free(folder)
    checkpoints, path = inside(folder, CHECKPOINTS), inside(folder, COMMAND)
    if os.path.exists(checkpoints):  # of another run, which is refused in a moment
        yield
        return
    plain = {k: str(v) if isinstance(v, Path) else v for k, v in arguments.items()}
    alone = not folder.parent.exists()
    with locked(folder):  # another run's arguments stay its own
        before = read_plain(path, _LIMIT, follow=False) if path.exists() else None
        expert = plain["expert"] or ""
        # An address may hold a key, and a run that goes on needs it.
        secret = without_secrets(expert) != expert
        write_bytes(path, stamped(plain), private=secret)
    try:
        yield
    except BaseException:
        if not checkpoints.exists():
            if before is None:
                remove_file(path)
                remove_if_empty(folder)
                if alone:
                    remove_if_empty(folder.parent)
            else:
                write_bytes(path, before)
        raise


def _check_alone(resume: Path, line: list[str]) -> None:
    """Refuse flags beside a `--resume` that remembers them all.

    Raises:
        SettingError: If there are some.
    """
    given = {flag for flag in _flags(line) if flag[2:].replace("-", "_") not in _BESIDE}
    if given:
        raise SettingError(
            f"{', '.join(sorted(given))} beside --resume {resume}",
            "--resume alone: a run goes on as it was begun",
            "leave them out, or begin another run with --out",
        )


def _remembered(folder: Path) -> dict[str, Any]:
    """Return the arguments that a run was begun with.

    Raises:
        SettingError: If there are none, or the environment would import a module that only a
            file names.
    """
    name = shlex.quote(str(folder))
    again = f"repeat the arguments: fdtasil distill EXPERT ENV ... --resume {name}"
    if not folder.is_dir():
        raise SettingError(
            f"--resume {name}, which is no folder",
            "one that `fdtasil distill --out` has begun",
            "look for its name, or begin a run: fdtasil distill EXPERT ENV --out NAME",
        )
    try:
        path = inside(folder, COMMAND)
        arguments = unstamped(read_plain(path, _LIMIT, follow=False), path, older=True)
    except StorageError:
        raise
    except (OSError, ValueError) as error:
        raise SettingError(
            f"{folder / COMMAND} can't be read ({type(error).__name__})",
            "a folder that `fdtasil distill --out` has begun",
            again,
        ) from error
    read = reads(f"arguments in {folder / COMMAND}", "those of `fdtasil distill`", again)
    arguments = read(_as_given)(arguments)
    if ":" in (arguments["env"] or ""):
        raise SettingError(
            f"{folder / COMMAND} names the environment {shown(arguments['env'])!r}",
            "an id without a module: importing one runs code, and a file may not ask for that",
            again,
        )
    if arguments["trust"] is not None:
        raise SettingError(
            f"{folder / COMMAND} says trust={shown(arguments['trust'])!r}",
            "trust from the caller, never from a file",
            again,
        )
    return arguments


def _as_given(stored: dict[str, Any]) -> dict[str, Any]:
    """Return stored arguments as the command takes them."""
    known = inspect.signature(command).parameters
    given = {name: one.default for name, one in known.items() if name not in _NOT_STORED}
    for name, value in stored.items():
        if name not in known:
            raise TypeError(f"no argument {shown(name)}")
        if name not in ("out", "resume"):  # of a folder that may have been moved since
            given[name] = as_kind(known[name].annotation, value, name)
    return given


def _side_by_side(result: Distilled, cloning: Evaluation | None) -> str:
    """Return a table of expert, plain cloning and student."""
    ours = result.evaluation
    if ours is None:
        return f"{shown(result.report['env'])}: {missing_text(result.settings)}"
    lines = [
        f"{shown(result.report['env'])}, {ours.episodes} paired episodes of {ours.horizon} steps",
        f"{'':15}{'return':>10}{'normalised':>12}{'95 % interval':>18}{'survival':>10}",
        f"{'expert':15}{ours.expert_return:10.1f}{1:12.3f}{'':18}{ours.expert_survival:10.2f}",
    ]
    for name, e in {"plain cloning": cloning, "student": ours}.items():
        if e is not None:
            lines.append(
                f"{name:15}{e.student_return:10.1f}{score_text(e.normalized_return):>12}"
                f"{interval_text(e.ci95):>18}{e.survival:10.2f}"
            )
    if ours.ci95 is None:
        lines.append(f"95 % interval {ours.interval_in_words()}")
    return "\n".join(lines)


command = as_command(
    _distill,
    [
        Flags(
            distill,
            without=("fit", "constraints", "callback", "progress", "out", "device"),
            types={
                "expert": OptionalExpert,
                "env": OptionalEnvironment,
                "probes": str | None,
                "trainer": str,
                "dataset": str | None,
                "student": str | None,
                "student_obs": tuple[str, ...] | None,
                "spread": str | None,
                "resume": Path | None,
            },
        ),
        Flags(Mlp, types={"hidden": tuple[int, ...]}, open=True),
        Flags(Fit, open=True),
        EXPERT_FLAGS,
    ],
    {
        **ENVIRONMENT_FLAGS,
        "log_formats": (
            tuple[str, ...],
            (),
            "Some of stdout, log, csv, json, tensorboard: logs in the folder `log` of the run.",
        ),
        "out": (Path, Path("runs/latest"), "Folder of the run."),
        "device": (
            OptionalText,
            None,
            'Where the student is trained: "cpu" (as without it), "cuda", "cuda:N"; beside '
            "--resume, where it goes on.",
        ),
        "baseline": (
            bool,
            False,
            "Also clone plainly, without probes, in a process beside it, and show both. It asks "
            "the expert too, up to --max-queries of its own.",
        ),
        **JSON_FLAG,
    },
)
