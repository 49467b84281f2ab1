"""A student as a TensorFlow Lite model: the interpreter's answers are the student's."""

import sys

import numpy as np
import pytest
from test_student import make

from fdtasil.errors import ExportError
from fdtasil.student.architectures import ACTIVATIONS
from fdtasil.student.exports import export

NEAR = 5 + 2 * np.random.default_rng(0).standard_normal((200, 3)).astype(np.float32)


def asked(data, rows):
    interpreter = pytest.importorskip("ai_edge_litert.interpreter").Interpreter(model_content=data)
    interpreter.allocate_tensors()
    (given,), (made,) = interpreter.get_input_details(), interpreter.get_output_details()
    answers = []
    for row in rows:  # one at a time, as a robot does
        interpreter.set_tensor(given["index"], row[None])
        interpreter.invoke()
        answers.append(interpreter.get_tensor(made["index"])[0].copy())
    return np.array(answers), interpreter


@pytest.mark.parametrize("bounds", [(2.0, 3.0), (np.inf, 3.0), (np.inf, np.inf)], ids=str)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(), (32, 16)], ids=str)
def test_it_answers_as_the_student(hidden, activation, bounds):
    pytest.importorskip("ai_edge_litert", reason="needs fdtasil[litert]")
    student = make(hidden, activation, low=tuple(-b for b in bounds), high=bounds)
    answers, interpreter = asked(export(student, NEAR, {"a": "b"}, "s.tflite"), NEAR[:50])
    assert answers == pytest.approx(student.act(NEAR[:50]), rel=1e-5, abs=3e-5)
    assert interpreter.get_input_details()[0]["name"] == "obs"
    assert interpreter.get_output_details()[0]["name"] == "actions"


def test_without_the_package_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(ExportError, match=r"fdtasil\[litert\]"):
        export(make((8,)), NEAR, {}, "s.tflite")
