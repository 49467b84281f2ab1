"""Names out of files, before they become paths: below their folder, and not behind a link."""

import os
from pathlib import Path, PurePosixPath

from fdtasil.errors import StorageError, shown

__all__ = ["check_no_links", "inside", "stays_inside"]


def stays_inside(name: str) -> bool:
    r"""Whether a name is readable and stays in the folder that it is relative to, on any system.

    Example:
        >>> [stays_inside(name) for name in ("a/b.weights", "../b", "/b", "a\0b", "c:b")]
        [True, False, False, False, False]
    """
    path = PurePosixPath(name)
    clean = name.isprintable() and not set("\\:") & set(name)
    return bool(path.parts) and clean and not path.is_absolute() and ".." not in path.parts


def inside(folder: Path, name: str) -> Path:
    """Return the path of a name in a folder: every name that a file holds goes through here.

    Args:
        folder: Trusted, and may be a link itself.
        name: Not trusted; relative to the folder.

    Raises:
        StorageError: If it leads out of the folder, or a link is on the way.
    """
    if not stays_inside(name):
        raise StorageError(
            f"{folder}: {shown(name)!r} is outside of the folder",
            "names of files below the folder",
            "do not use the folder: somebody has changed it",
        )
    path = folder
    for part in PurePosixPath(name).parts:
        path = path / part
        if _is_link(path):
            raise _refused(path)
    return path


def check_no_links(folder: Path) -> None:
    """Refuse a folder with a link anywhere below it: what is behind one is somebody else's.

    Raises:
        StorageError: Naming the first link.
    """
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            if _is_link(Path(place, name)):
                raise _refused(Path(place, name))


def _is_link(path: Path) -> bool:
    is_junction = getattr(os.path, "isjunction", None)  # Windows, and Python 3.12
    # os.path's: Path's own raises where a name is too long.
    return os.path.islink(path) or (is_junction is not None and is_junction(path))


def _refused(path: Path) -> StorageError:
    return StorageError(
        f"{shown(path)} is a link",
        "plain files and folders inside the folder of a run",
        "look where it leads, and remove the link itself",
    )
