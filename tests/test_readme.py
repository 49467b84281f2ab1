"""What the README says works, as it is written there."""

import re
from importlib import import_module
from pathlib import Path

import pytest

from fdtasil.shell.main import COMMANDS
from fdtasil.student.schedule import Schedule

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.usefixtures("no_pictures")
def test_the_code_runs(tmp_path, monkeypatch):
    """All blocks in turn, as one session, in an empty folder beside the experts."""
    (tmp_path / "experts").symlink_to(ROOT / "experts")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Schedule, "total_steps", lambda schedule, states: 50)
    session = {}
    for block in BLOCKS:
        exec(compile(block, "README.md", "exec"), session)
    assert (tmp_path / "student.onnx").stat().st_size > 1000
    assert (tmp_path / "runs/cheetah/report.json").exists()
    assert session["action"].shape == (1,)


@pytest.mark.parametrize("line", re.findall(r"^fdtasil .*$", README, re.MULTILINE))
def test_the_commands_exist(line):
    _, command, *arguments = line.split()
    assert command in COMMANDS
    module = import_module(f"fdtasil.shell.{command.replace('-', '_')}")
    known = module.command.__annotations__
    flags = [a.removeprefix("--").replace("-", "_") for a in arguments if a.startswith("--")]
    assert set(flags) <= set(known)
