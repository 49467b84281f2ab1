"""An action with one bound: its output is linear, and yet no form of the student passes it."""

import importlib.util

import numpy as np
import onnxruntime
import pytest
import test_c_export
import test_tflite
import torch
from test_student import make
from toy_tasks import linear_task, stream

import fdtasil
from fdtasil.files.compiled import compiler
from fdtasil.student.architectures import Mlp
from fdtasil.student.exports import export
from fdtasil.student.fit import Fit, fit
from fdtasil.student.policy import Student

# Bounded from below, from above, from both sides, and not at all.
LOW, HIGH = (0.0, -np.inf, -1.0, -np.inf), (np.inf, -0.5, 1.0, np.inf)
ROWS = 5 + 2 * np.random.default_rng(0).standard_normal((200, 3)).astype(np.float32)


@pytest.fixture
def student():
    """Return one whose network leads beyond both bounds that stand alone."""
    made = make((32, 16), low=LOW, high=HIGH)
    with torch.no_grad():
        made.network[4].weight.mul_(3)
        raw = made.uncut(torch.from_numpy(ROWS)).numpy()
    assert raw[:, 0].min() < -1
    assert raw[:, 1].max() > 0
    return made


def check(answers, expected, apart=1e-5):
    assert np.abs(answers - expected).max() < apart
    assert (answers >= LOW).all()
    assert (answers <= HIGH).all()
    assert (answers == 0).any(axis=0)[0]
    assert (answers == -0.5).any(axis=0)[1]
    assert np.ptp(answers, axis=0).min() > 0.1
    assert answers[:, 3].min() < -2


def in_onnxruntime(file, rows):
    return onnxruntime.InferenceSession(file.read_bytes()).run(["actions"], {"obs": rows})[0]


def compiled(file, rows):
    if compiler() is None:
        pytest.skip("needs a C compiler")
    return test_c_export.asked(test_c_export.built(file.read_bytes(), file.parent), rows)


def on_a_robot(file, rows):
    spec = importlib.util.spec_from_file_location("student_of_a_robot", file)
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    return program.PlainPolicy.load(file.with_suffix(".safetensors"))(rows)


FORMS = {
    ".onnx": in_onnxruntime,
    ".int8.onnx": in_onnxruntime,
    ".c": compiled,
    ".int8.c": compiled,
    ".py": on_a_robot,
    ".safetensors": lambda file, rows: Student.from_bytes(file.read_bytes()).act(rows),
    ".tflite": lambda file, rows: test_tflite.asked(file.read_bytes(), rows)[0],
}


@pytest.mark.fault(282)
@pytest.mark.parametrize("suffix", FORMS)
def test_no_exported_student_passes_a_bound(suffix, student, tmp_path):
    if suffix == ".tflite":
        pytest.importorskip("ai_edge_litert", reason="needs fdtasil[litert]")
    for name in (suffix, ".safetensors"):
        (tmp_path / f"s{name}").write_bytes(export(student, ROWS, {}, f"s{name}"))
    answers = FORMS[suffix](tmp_path / f"s{suffix}", ROWS)
    check(answers, student.act(ROWS), 0.2 if "int8" in suffix else 1e-5)
    if suffix != ".int8.onnx":  # whose inputs are whole numbers
        lost = FORMS[suffix](tmp_path / f"s{suffix}", np.full((1, 3), np.nan, np.float32))
        assert np.isnan(lost).all()


@pytest.mark.fault(282)
def test_no_student_passes_a_bound_here(student):
    expected = np.clip(student.uncut(torch.from_numpy(ROWS)).detach().numpy(), LOW, HIGH)
    check(student.act(ROWS), expected)
    check(np.stack([student.predict(row)[0] for row in ROWS]), expected)
    check(fdtasil.load_expert(student, 3, 4).ask(ROWS, "act"), expected)


@pytest.mark.parametrize("spec", [None, "basis,central"])
def test_it_is_trained_as_one_without_bounds(spec):
    """Where it is cut off, it would learn nothing."""
    demonstrations, probes, ask = linear_task(spec=spec)
    layers = []
    for high in (np.inf, 0.0):
        bounds, start = (np.full(2, -np.inf), np.full(2, high)), torch.Generator().manual_seed(0)
        student = Student(Mlp(8), np.zeros(6), np.ones(6), *bounds, start)
        fit(student, demonstrations, probes, ask, Fit(steps=100), stream)
        layers.append(student.network.state_dict())
    assert all(torch.equal(layers[0][name], layers[1][name]) for name in layers[0])
