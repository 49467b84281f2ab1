"""`fdtasil report`: a run on one page."""

from pathlib import Path

from fdtasil.checks import check_suffix
from fdtasil.files.storage import write_bytes
from fdtasil.results.distilled import Distilled
from fdtasil.results.page import page_of
from fdtasil.shell.call import beside_run
from fdtasil.shell.command import RunFolder

__all__ = ["command"]


def command(run: RunFolder, /, *, out: Path | None = None) -> None:
    """Write everything that a run knows as one page of HTML, which needs no network.

    Args:
        run: Folder of a finished run.
        out: Where; left out, RUN.html beside the folder.
    """
    file = beside_run(run, ".html") if out is None else check_suffix(out, ".html")
    write_bytes(file, page_of(Distilled.load(run)).encode())
    print(f"written: {file}")
