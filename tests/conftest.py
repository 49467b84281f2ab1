"""Toy experts with known derivatives, and ONNX files as users have them."""

import functools
import importlib.metadata
import subprocess
import sys
import warnings
from collections import Counter
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from faults import FAULTS, LEFT_OUT
from onnx import TensorProto, helper, numpy_helper
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import FdtasilWarning
from fdtasil.run.folder import RunFolder
from fdtasil.shell.main import main

GAIN = np.array([[-0.5, 0.1, -0.7, 0.0, 0.0], [0.0, -0.4, 0.1, -0.6, 0.0]], np.float32)
TOY = "toy_environments:toy/Integrator-v0"
QUICK = {
    "episodes": 2,
    "horizon": 20,
    "student": fdtasil.Mlp(16),
    "fit": fdtasil.Fit(steps=40),
    "evaluation_episodes": 2,
}

SHARED = Path(__file__).parent.parent.parent / "shared"


def pytest_addoption(parser):
    parser.addoption("--figures", action="store_true", help="print what was survived, at the end")


def pytest_collection_modifyitems(items):
    for item in items:
        numbers = [n for mark in item.iter_markers("fault") for n in mark.args]
        item.user_properties += [("fault", number) for number in numbers]


def pytest_terminal_summary(terminalreporter, config):
    """Print the table of figures: by part, the faults that ended as required, and the counts."""
    if not config.getoption("--figures"):
        return
    kinds = ("passed", "failed", "error")
    reports = [report for kind in kinds for report in terminalreporter.getreports(kind)]
    properties = [
        (report.passed, *pair)
        for report in reports
        for pair in getattr(report, "user_properties", ())  # a file that failed to load has none
    ]
    bad = {value for passed, name, value in properties if name == "fault" and not passed}
    good = {value for passed, name, value in properties if name == "fault" and passed} - bad
    lines = ["| faults in | listed | tested | ended as required |", "|---|---|---|---|"]
    for part, faults in {**FAULTS, "all": {n: "" for f in FAULTS.values() for n in f}}.items():
        tested = len(faults.keys() & (good | bad))
        lines.append(f"| {part} | {len(faults)} | {tested} | {len(faults.keys() & good)} |")
    lines += ["", "| put to the test | result |", "|---|---|"]
    figures = {tuple(value) for passed, name, value in properties if name == "figure" and passed}
    lines += [f"| {what} | {result} |" for what, result in sorted(figures)]
    lines += ["", *(f"left out: {number}, {reason}" for number, reason in LEFT_OUT.items())]
    terminalreporter.write_line("\n" + "\n".join(lines))


@pytest.fixture
def figure(record_property):
    """Put a line into the table of figures: what was done, and what came of it."""
    return lambda what, result: record_property("figure", (what, result))


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    torch.set_num_threads(1)  # several test processes run at once


@pytest.fixture(autouse=True, scope="session")
def little_is_said_of_a_run():
    """Versions and the time of an answer: to find them takes as long as a run of forty steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fdtasil.results.size._CALLS", 2)
        patch.setattr("fdtasil.run.report.version", functools.cache(importlib.metadata.version))
        yield


@pytest.fixture(autouse=True)
def untouched_global_randomness():
    """Every test also shows that the library leaves global random state alone."""
    before = np.random.get_state()[1].copy(), torch.get_rng_state()
    yield
    after = np.random.get_state()[1], torch.get_rng_state()
    assert np.array_equal(before[0], after[0])
    assert torch.equal(before[1], after[1])


@pytest.fixture(scope="session")
def linear():
    """The expert x -> GAIN x, whose Jacobian is GAIN everywhere."""
    return lambda observations: observations @ GAIN.T


@pytest.fixture
def shared():
    """The folder of the paper's experts, which only developers have."""
    if not SHARED.is_dir():
        pytest.skip("needs ../shared, which only developers of fdtasil have")
    return SHARED


@pytest.fixture
def toy_environment():
    return Integrator()


def mlp_onnx(
    path: Path,
    sizes: tuple[int, ...] = (5, 8, 2),
    kind: int = TensorProto.FLOAT,
    batch: int | str = "batch",
    names: tuple[str, str] = ("obs", "actions"),
    reshape_to: list[int] | None = None,
    extra_outputs: dict[str, int] | None = None,
    scale: float = 1.0,
    external: str | None = None,
) -> Path:
    """Write a tanh MLP with seeded weights, in whatever way users' files are odd."""
    random, dtype = np.random.default_rng(0), helper.tensor_dtype_to_np_dtype(kind)
    nodes, weights, current = [], [], names[0]
    outputs = {names[1]: sizes[-1], **(extra_outputs or {})}
    if reshape_to is not None:
        weights.append(numpy_helper.from_array(np.array(reshape_to, np.int64), "shape"))
        nodes.append(helper.make_node("Reshape", [current, "shape"], ["reshaped"]))
        current = "reshaped"
    for i, (inputs, width) in enumerate(pairwise(sizes[:-1])):
        matrix = random.standard_normal((width, inputs)) / inputs**0.5
        weights += [_tensor(matrix, f"w{i}", dtype), _tensor(np.zeros(width), f"b{i}", dtype)]
        nodes.append(helper.make_node("Gemm", [current, f"w{i}", f"b{i}"], [f"z{i}"], transB=1))
        nodes.append(helper.make_node("Tanh", [f"z{i}"], [f"h{i}"]))
        current = f"h{i}"
    for name, width in outputs.items():
        matrix = scale * random.standard_normal((width, sizes[-2])) / sizes[-2]
        weights += [_tensor(matrix, f"w_{name}", dtype)]
        nodes.append(helper.make_node("Gemm", [current, f"w_{name}"], [f"z_{name}"], transB=1))
        nodes.append(helper.make_node("Tanh" if scale == 1 else "Identity", [f"z_{name}"], [name]))
    graph = helper.make_graph(
        nodes,
        "mlp",
        [helper.make_tensor_value_info(names[0], kind, [batch, sizes[0]])],
        [helper.make_tensor_value_info(n, kind, [batch, width]) for n, width in outputs.items()],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    save = {"save_as_external_data": True, "location": external, "size_threshold": 0}
    onnx.save(model, path, **(save if external else {}))
    return path


def _tensor(array: np.ndarray, name: str, dtype: np.dtype) -> onnx.TensorProto:
    return numpy_helper.from_array(array.astype(dtype), name)


@pytest.fixture(scope="session")
def quick(linear):
    """A small distillation of the linear expert; it is not to be changed."""
    return fdtasil.distill(linear, TOY, 3, **QUICK)


@pytest.fixture(scope="session")
def quick_folder(quick, tmp_path_factory):
    """Where it is saved; not to be changed either."""
    return quick.save(tmp_path_factory.mktemp("quick") / "run")


@pytest.fixture(scope="module")
def no_pictures():
    """Pictures are not drawn: for tests that save many runs and look at other files of them."""
    # A command that is imported meanwhile would keep what stands in their place.
    import_module("fdtasil.shell.inspect")
    with pytest.MonkeyPatch.context() as patch:
        for name in ("training", "returns", "calibration"):
            patch.setattr(f"fdtasil.results.figures.draw_{name}", lambda *drawn: b"no picture")
        yield


@pytest.fixture
def many_checkpoints(monkeypatch):
    """Every 25th moment at which a checkpoint may be taken is used, whatever the time.

    An odd number: a training goes on after odd and after even steps then.
    """
    asked = Counter()

    def due(folder):
        asked[id(folder)] += 1
        return folder._path is not None and asked[id(folder)] % 25 == 0

    monkeypatch.setattr(RunFolder, "due", property(due))


@pytest.fixture
def inside(monkeypatch, capsys):
    """Run the command line in this process: `shells.shell` starts one, which takes seconds."""

    def run(*arguments, cwd="."):
        line = ["fdtasil", *map(str, arguments)]
        capsys.readouterr()
        with monkeypatch.context() as patch, warnings.catch_warnings():
            warnings.simplefilter("default", FdtasilWarning)  # an error in other tests
            patch.setattr(sys, "argv", line)
            patch.chdir(cwd)
            code = 0
            try:
                main()
            except SystemExit as error:
                code = error.code or 0
        shown = capsys.readouterr()
        return subprocess.CompletedProcess(line, code, shown.out, shown.err)

    return run


@pytest.fixture
def nothing_is_trained(monkeypatch):
    """Training fails the test: what is refused here is refused before."""

    def never(*arguments, **named):
        raise AssertionError("training began")

    monkeypatch.setattr("fdtasil.run.training.fit", never)
