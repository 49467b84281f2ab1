"""C files that fdtasil wrote, as policies: compiled, and judged as they will run on a board."""

import re
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

from fdtasil.errors import ExpertError, ExportError
from fdtasil.experts.expert import Expert, Hints, Origin
from fdtasil.experts.onnx_expert import COLUMNS
from fdtasil.files.compiled import shared_function
from fdtasil.files.reading import read_limited
from fdtasil.files.storage import sha256

__all__ = ["open_c"]

_LIMIT = 2**28  # bytes
_COLUMNS = re.compile(rf"^ *{re.escape(COLUMNS)}: ([\d,]+)$", re.MULTILINE)
_SIZES = re.compile(r"^#define STUDENT_(OBSERVATIONS|ACTIONS) (\d{1,9})$", re.MULTILINE)


def open_c(source: str | Path, hints: Hints) -> Expert:
    """Compile a C file and ask its function.

    Raises:
        ExpertError: If the caller does not allow it, it is no file of fdtasil's, or it can't be
            compiled.
    """
    if hints.trust != "c":
        raise ExpertError(
            f"{source} is C code, which is compiled and run here",
            "your permission: it may do anything",
            f'write load_expert({str(source)!r}, trust="c") (--trust c on the command line)',
        )
    text = read_limited(Path(source), _LIMIT, "a C file").decode(errors="replace")
    sizes = {name: int(size) for name, size in _SIZES.findall(text)}
    if sizes.keys() != {"OBSERVATIONS", "ACTIONS"}:
        raise ExpertError(
            f"{source} does not say its sizes",
            "a file that fdtasil wrote",
            "export the student again: fdtasil export RUN student.c",
        )
    n, m = sizes["OBSERVATIONS"], sizes["ACTIONS"]
    policy = _Compiled(text, n, m)
    try:
        policy.compile()
    except ExportError as error:
        raise ExpertError(f"{source}: {error.found}", error.expected, error.next_step) from error
    origin = Origin(str(source), sha256(text.encode()), _columns(text, n, source))
    return Expert(policy, Path(source).name, n, m, origin=origin)


def _columns(text: str, n: int, source: str | Path) -> tuple[int, ...] | None:
    """Return the columns of an observation that a file says it sees, or None.

    Raises:
        ExpertError: If it says so of others than it takes.
    """
    found = _COLUMNS.search(text)
    if found is None:
        return None
    columns = tuple(int(column) for column in found[1].split(",") if column)
    if len(columns) != n:
        raise ExpertError(
            f"{source} takes {n} numbers, and its comment names {len(columns)} columns",
            "a column for each",
            "export the student again: fdtasil export RUN student.c",
        )
    return columns


class _Compiled:
    """Answers row by row, as a board does.

    Args:
        source: C99.
        n: Length of an observation.
        m: Length of an action.
    """

    def __init__(self, source: str, n: int, m: int) -> None:
        self._arguments = source, n, m

    def __reduce__(self) -> tuple[object, ...]:
        return _Compiled, self._arguments

    @cached_property
    def _function(self) -> Callable[[int, int], None]:
        return shared_function(self._arguments[0], "student")

    def compile(self) -> None:
        """Compile it now; a copy in another process does when it is asked."""
        _ = self._function

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        actions = np.empty((len(observations), self._arguments[2]), np.float32)
        for row, action in zip(np.ascontiguousarray(observations), actions, strict=True):
            self._function(row.ctypes.data, action.ctypes.data)
        return actions
