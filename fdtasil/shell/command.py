"""Functions of the library as commands: signatures and docstrings, as a shell can say them."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import tyro

__all__ = [
    "AgentPath",
    "EnvironmentId",
    "ExpertPath",
    "Flags",
    "OptionalEnvironment",
    "OptionalExpert",
    "OptionalInt",
    "OptionalPath",
    "OptionalText",
    "PolicyPath",
    "RunFolder",
    "as_command",
]

OptionalExpert = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
OptionalEnvironment = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT")]
PolicyPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
AgentPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="AGENT.zip")]
ExpertPath = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERT")]
RunFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
EnvironmentId = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]

_METAVARS: dict[Any, str] = {tuple: "INT [INT ...]", int: "INT", float: "FLOAT", Path: "PATH"}


@dataclass(frozen=True)
class Flags:
    """Arguments of a command that a function, or a dataclass, of the library has.

    Attributes:
        owner: Whose signature and docstring are read.
        only: Names of the arguments that are taken; None for all of them.
        without: Names of those that are not.
        types: Types of those that a shell can't express as the owner takes them.
        open: Whether each may be left out, whatever its default: then it is None.
    """

    owner: Callable[..., Any]
    only: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    types: Mapping[str, Any] = field(default_factory=dict)
    open: bool = False

    def parameters(self) -> list[inspect.Parameter]:
        """Return the arguments as a shell has them."""
        found = inspect.signature(self.owner).parameters.values()
        return [self._parameter(one) for one in found if self._taken(one.name)]

    def texts(self) -> dict[str, str]:
        """Return the help text of each argument, by name."""
        rest = re.split(r"\n(?:Args|Attributes):\n", inspect.getdoc(self.owner) or "", maxsplit=1)
        lines = inspect.cleandoc(rest[-1].partition("\n\n")[0]).splitlines()
        texts: dict[str, str] = {}
        name = ""
        for line in lines:
            if not line.startswith(" "):
                name, _, line = line.partition(": ")
            texts[name] = f"{texts.get(name, '')} {line.strip()}".strip()
        return {name: text for name, text in texts.items() if self._taken(name)}

    def _taken(self, name: str) -> bool:
        return (self.only is None or name in self.only) and name not in self.without

    def _parameter(self, parameter: inspect.Parameter) -> inspect.Parameter:
        name, kind, default = parameter.name, parameter.annotation, parameter.default
        kind = self.types.get(name, kind)
        if self.open:
            kind, default = kind | None, None
        if get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind):
            # tyro would show "{None}|INT"; leaving the argument out is how a shell says None.
            inner = next(one for one in get_args(kind) if one is not NoneType)
            metavar = _METAVARS.get(get_origin(inner) or inner, "TEXT")
            kind = Annotated[kind, tyro.conf.arg(metavar=metavar)]
        keyword = inspect.Parameter.KEYWORD_ONLY
        return parameter.replace(annotation=kind, default=default, kind=keyword)


def as_command(
    run: Callable[..., None],
    flags: Sequence[Flags],
    added: Mapping[str, tuple[Any, Any, str]],
) -> Callable[..., None]:
    """Return `run` as a command: arguments, defaults and help texts are read from the library.

    Args:
        run: Called with the parsed arguments.
        flags: Where the arguments are read from; what the command does is said by the first.
        added: Type, default and help text of arguments that only the command has.
    """

    def command(**arguments: Any) -> None:
        run(**arguments)

    parameters = [parameter for one in flags for parameter in one.parameters()]
    texts = {name: text for one in flags for name, text in one.texts().items()}
    for name, (kind, default, text) in added.items():
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(name, keyword, default=default, annotation=kind))
        texts[name] = text
    command.__dict__["__signature__"] = inspect.Signature(parameters)
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    head = (inspect.getdoc(flags[0].owner) or "").partition("Args:\n")[0]
    lines = [f"    {name}: {text}" for name, text in texts.items()]
    command.__doc__ = f"{head}Args:\n" + "\n".join(lines)
    return command
