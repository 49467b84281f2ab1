"""What README and documentation say works, as it is written there."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

from fdtasil.shell.main import COMMANDS
from fdtasil.student.schedule import Schedule

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = {page.name: re.findall(r"```python\n(.*?)```", page.read_text(), re.S) for page in PAGES}
LINES = sorted({line for p in PAGES for line in re.findall(r"^fdtasil .*$", p.read_text(), re.M)})
LINKS = sorted(
    {(p, link) for p in PAGES for link in re.findall(r"\]\(([^)#]+)", p.read_text())}, key=str
)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore::fdtasil.FdtasilWarning")
@pytest.mark.parametrize("page", [name for name, blocks in BLOCKS.items() if blocks])
def test_the_code_runs(page, tmp_path, monkeypatch):
    """All blocks of a page in turn, as one session, in an empty folder beside the experts."""
    (tmp_path / "experts").symlink_to(ROOT / "experts")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Schedule, "total_steps", lambda schedule, states: 50)
    session = {}
    for block in BLOCKS[page]:
        exec(compile(block, page, "exec"), session)
    assert session


@pytest.mark.parametrize("line", LINES)
def test_the_commands_exist(line):
    _, command, *arguments = shlex.split(line, comments=True)
    assert command in COMMANDS
    module = import_module(f"fdtasil.shell.{command.replace('-', '_')}")
    known = module.command.__annotations__
    flags = [a.removeprefix("--").replace("-", "_") for a in arguments if a.startswith("--")]
    assert set(flags) <= set(known)


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_the_links_lead_somewhere(page, link):
    assert link.startswith("https://") or (page.parent / link).exists()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100
