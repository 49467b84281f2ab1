"""A function of the library as a command: its signature and docstring, as a shell can say them."""

import importlib
import inspect
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import tyro

__all__ = [
    "AgentPath",
    "EnvironmentId",
    "ExpertPath",
    "OptionalEnvironment",
    "OptionalExpert",
    "OptionalText",
    "PolicyPath",
    "as_command",
    "import_module_of",
]

OptionalExpert = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
OptionalEnvironment = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
PolicyPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
AgentPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="AGENT.zip")]
ExpertPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
EnvironmentId = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]

# Bars are silent by themselves where there is no terminal; a function has no name in a shell.
_ONLY_PYTHON = ("progress", "callback")
_METAVARS: dict[Any, str] = {tuple: "INT [INT ...]", int: "INT", float: "FLOAT"}


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


def import_module_of(environment: str | None) -> None:
    """Import the module of "module:Id" where it lies in the current folder.

    Nothing else is looked for there: a folder that somebody else filled runs no code by itself.
    """
    module, named, _ = (environment or "").partition(":")
    here = os.getcwd()
    if not named or here in sys.path:
        return
    sys.path.append(here)
    try:
        with suppress(ImportError):  # gymnasium says what is missing
            importlib.import_module(module)
    finally:
        sys.path.remove(here)
