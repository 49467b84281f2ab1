"""Progress bars are shown where somebody looks at them, and nowhere else."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import TOY

import fdtasil
from fdtasil.progress import Progress

CODE = """
import fdtasil
from toy_environments import Integrator
fdtasil.evaluate(lambda rows: -rows[:, :2], lambda rows: -rows[:, :2], Integrator, **options)
"""


@pytest.mark.parametrize(
    ("shell", "progress", "shown"),
    [
        (SimpleNamespace(kernel="a kernel"), True, True),
        (SimpleNamespace(kernel="a kernel"), False, False),
        (SimpleNamespace(), True, False),
        (None, True, False),
    ],
    ids=["notebook", "progress=False", "IPython in a pipe", "IPython only imported"],
)
def test_a_notebook_counts_as_a_terminal(shell, progress, shown, monkeypatch, capsys, linear):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    fdtasil.evaluate(linear, linear, TOY, episodes=2, horizon=5, progress=progress)
    assert ("step/s" in capsys.readouterr().err) is shown


@pytest.mark.slow
@pytest.mark.parametrize("progress", [True, pytest.param(False, marks=pytest.mark.torture)])
def test_in_a_real_kernel(progress, monkeypatch):
    nbformat = pytest.importorskip("nbformat", reason="needs the extra docs")
    nbclient = pytest.importorskip("nbclient", reason="needs the extra docs")
    tests = Path(__file__).parent
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tests.parent), str(tests)]))
    options = f"options = {{'episodes': 2, 'horizon': 5, 'progress': {progress}}}"
    cell = nbformat.v4.new_code_cell(options + CODE)
    notebook = nbformat.v4.new_notebook(cells=[cell])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    told = "".join(output.get("text", "") for output in cell.outputs)
    assert ("step/s" in told) is progress


def test_a_program_without_a_console_has_no_bars(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with Progress(True).bar("fit", "step", 3) as bar:
        bar.move(1)
