"""What a command found: said to who reads, and written as JSON for a script."""

import json
from pathlib import Path
from typing import Any, Protocol

from fdtasil.checks import check_suffix
from fdtasil.files.plain import without_infinities
from fdtasil.files.storage import write_bytes
from fdtasil.shell.command import OptionalPath

__all__ = ["JSON_FLAG", "PRINTED", "json_file", "say"]

PRINTED = Path("-")
"""In the place of a file: the JSON alone is printed."""
JSON_FLAG: dict[str, tuple[Any, Any, str]] = {
    "json": (
        OptionalPath,
        None,
        "File that all of it is written into too, as JSON; - prints that alone.",
    ),
}
"""Arguments of a command that finds something out."""


class Found(Protocol):
    """What can be printed and written."""

    def to_json(self) -> dict[str, Any]:
        """Return it as plain JSON values."""
        ...


def json_file(path: Path | None) -> Path | None:
    """Return the file to write, before an environment may change the folder.

    Raises:
        SettingError: If its name ends otherwise.
    """
    if path == PRINTED:
        return path
    return None if path is None else check_suffix(path, ".json").absolute()


def say(found: Found, file: Path | None) -> None:
    """Write what was found, where there is a file from `json_file`, and print it."""
    if file is None:
        print(found)
        return
    text = json.dumps(without_infinities(found.to_json())[0], indent=2)
    if file == PRINTED:
        print(text)
        return
    write_bytes(file, text.encode())  # first: who reads the print may stop to
    print(f"{found}\nwritten: {file}")
