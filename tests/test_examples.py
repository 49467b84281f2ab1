"""The examples do what they say."""

import json
import runpy
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from sb3_agents import seeded

import fdtasil
from fdtasil.student.schedule import Schedule

EXAMPLES = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py") if path.stem[:11] != "constrained")


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore::fdtasil.FdtasilWarning")
@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_runs(script, tmp_path, monkeypatch, capsys):
    """As it is written, but for the length of the trainings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Schedule, "total_steps", lambda schedule, states: 30)
    monkeypatch.setattr(sys, "argv", [f"{script}.py"])
    with seeded():
        source = (EXAMPLES / f"{script}.py").read_text().replace("5_000", "200")
        (tmp_path / "examples").mkdir()
        (tmp_path / "experts").symlink_to(EXAMPLES.parent / "experts")
        (tmp_path / "examples" / f"{script}.py").write_text(source)
        runpy.run_path(str(tmp_path / "examples" / f"{script}.py"), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_the_notebook_holds_no_outputs():
    """They would be of another version; `make docs` runs it anew."""
    cells = json.loads((EXAMPLES / "notebook.ipynb").read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)


@pytest.fixture
def cart_pole(monkeypatch):
    pytest.importorskip("casadi")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield import_module("constrained_cart_pole")
    sys.modules.pop("constrained_cart_pole")


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore::fdtasil.FdtasilWarning")
@pytest.mark.torture
def test_a_planner_with_hard_limits(cart_pole):
    rest, lost = np.zeros(4), np.array([0.99, 0.0, 2.0, 0.0])  # too fast for what is left of it
    answers = cart_pole.controller(np.stack([rest, lost]))
    assert abs(answers[0, 0]) < 1e-3
    assert np.isnan(answers[1, 0])
    result = fdtasil.distill(
        cart_pole.controller,
        cart_pole.CartPole,
        2,
        episodes=1,
        horizon=20,
        evaluation_episodes=2,
        student=fdtasil.Mlp(16),
        fit=fdtasil.Fit(steps=40),
        constraints=cart_pole.LIMITS,
        progress=False,
    )
    ((name, *shares),) = result.evaluation.violations
    assert name == "rail"
    assert all(0 <= share < 0.5 for share in shares)
