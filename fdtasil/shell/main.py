"""The command line: nothing heavy is loaded before it is known what is wanted."""

import contextlib
import difflib
import functools
import io
import os
import re
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

from fdtasil.errors import FdtasilError, FdtasilWarning, SettingError
from fdtasil.version import __version__

__all__ = ["COMMANDS", "main"]

COMMANDS = {
    "experts": "those that come with the library, and their files",
    "inspect": "what an expert is: its contract with the environment, and its return",
    "distill": "an expert into a small torch policy that reacts as it does",
    "evaluate": "a policy beside an expert, from the same starts",
    "diagnose": "a student's derivatives beside its expert's, and what the expert forgives",
    "gains": "the Jacobian of an expert that does not give it, with its error",
    "shrink": "the smallest student that keeps the expert's level",
    "report": "everything that a run knows, on one page",
    "render": "a film of policies side by side",
    "export": "the student of a run as ONNX, C or numpy",
    "push": "a run to the Hugging Face hub",
    "export-sb3": "an agent of stable-baselines3 as one ONNX file",
}
"""What each command is about; its module is named so, and has a function `command`."""


def main() -> None:
    """Run the command line; exit code 0 done, 1 failed, 2 wrong use, 128 + N signal N."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a path may have letters that it lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            _main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # who reads what is printed has seen enough: `fdtasil ... | head`
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):  # Python flushes both at its end
            os.dup2(nowhere, stream.fileno())
        sys.exit(128 + 13)  # SIGPIPE, where there are signals


def _main() -> None:
    name, *rest = sys.argv[1:] or [""]
    if name == "--version":
        print(f"fdtasil {__version__}")
    elif name in ("-h", "--help"):
        print(_usage())
    elif name in COMMANDS:
        with warnings.catch_warnings():
            warnings.showwarning = _plainly(warnings.showwarning)
            _run(name, rest)
    else:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        problem = f"no command {name!r}" if name else "no command"
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"fdtasil: {problem}{hint}\n\n{_usage()}", file=sys.stderr)
        sys.exit(2)


def _usage() -> str:
    lines = [f"  {name:12}{text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: fdtasil [-h] [--version] COMMAND ...",
            "",
            "Distil a black-box controller.",
            "",
            *lines,
            "",
            "fdtasil COMMAND --help says what a command takes.",
        ]
    )


def _plainly(shown: Callable[..., None]) -> Callable[..., None]:
    """Show the library's own warnings as a shell's user reads them, without a line of source."""

    def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
        if issubclass(category, FdtasilWarning):
            print(f"fdtasil: warning: {message}", file=sys.stderr)
        else:
            shown(message, category, *where)

    return show


def _run(name: str, rest: list[str]) -> None:
    try:
        module = import_module(f"fdtasil.shell.{name.replace('-', '_')}")
        _read(module.command, name, rest)()
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


def _read(command: Callable[..., None], name: str, rest: list[str]) -> Callable[[], None]:
    """Return a command with its arguments, or say in a few lines which of them is none."""
    import tyro

    @functools.wraps(command)
    def whole(*given: Any, **options: Any) -> Callable[[], None]:
        return functools.partial(command, *given, **options)

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(whole, prog=f"fdtasil {name}", args=rest, config=())
    except SystemExit:
        plain = re.sub(r"\x1b\[[0-9;]*m|[\u2500-\u257f]", " ", said.getvalue())
        text = " ".join(plain.split())
        found = re.search(
            r"Error parsing (\S+): no type matching (.+) could be .* from \[(.+?)\]", text
        )
        if found is None:
            sys.stderr.write(said.getvalue())
            raise
        option, kinds, given = found.groups()
        raise SettingError(
            f"{option} {given}",
            " or ".join(kind.strip("{}") for kind in kinds.split("|") if kind != "{None}"),
            f"fdtasil {name} --help says what it is",
        ) from None


def _notes(error: BaseException) -> list[str]:
    return getattr(error, "__notes__", [])
