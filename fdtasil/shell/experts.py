"""`fdtasil experts`: the experts that the project ships, and their files."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from fdtasil.errors import SettingError
from fdtasil.experts.shipped import fetch_expert, shipped_experts
from fdtasil.shell.command import OptionalExpert, OptionalText

__all__ = ["command"]

Action = Annotated[Literal["list", "fetch"], tyro.conf.Positional]


def command(
    action: Action = "list",
    name: OptionalExpert = None,
    /,
    *,
    out: Path = Path(),
    source: OptionalText = None,
) -> None:
    """List the shipped experts, or write the file of one into a folder.

    Args:
        action: "fetch" writes the file of an expert; its sha256 is compared.
        name: Which expert to fetch.
        out: Folder that it is written into.
        source: Folder, or http(s) address of a folder, that has the file; default: this
            installation, which has all of them in a copy of the repository, and one in a wheel.
    """
    if action == "fetch" and name is not None:
        print(f"{fetch_expert(name, out, source)}: its sha256 is the manifest's")
    elif action == "fetch":
        names = ", ".join(shipped_experts())
        raise SettingError("no expert", f"one of {names}", "write fdtasil experts fetch NAME")
    elif name is not None:
        raise SettingError(
            f"an expert, {name!r}, to list", "none", f"write fdtasil experts fetch {name}"
        )
    else:
        print(_table())


def _table() -> str:
    lines = [f"{'expert':27}{'environment':27}at hand   300 steps  1000 steps"]
    for name, one in shipped_experts().items():
        at_hand = "yes" if one.path else "no"
        returns = f"{one.returns[300]:9.1f}{one.returns[1000]:12.1f}"
        lines.append(f"{name:27}{one.environment:27}{at_hand:10}{returns}")
    return "\n".join(lines)
