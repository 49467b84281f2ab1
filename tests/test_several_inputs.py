"""ONNX files with several inputs: columns of the observation, or constants, by name."""

import numpy as np
import onnx
import onnxruntime
import pytest
from conftest import QUICK, TOY
from onnx import TensorProto, helper, numpy_helper

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.files.onnx.binding import Choices, bind
from fdtasil.shell.call import opened

pytestmark = pytest.mark.usefixtures("no_pictures")

GAIN = np.random.default_rng(0).standard_normal((5, 2)).astype(np.float32) / 4
ROWS = np.random.default_rng(1).standard_normal((30, 5)).astype(np.float32)


def saved(path, inputs, nodes, constants=(), output=(("batch", 2), TensorProto.FLOAT)):
    """Write a model with inputs name -> (type, shape)."""
    entries = [
        helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()
    ]
    shape, kind = output
    graph = helper.make_graph(
        nodes,
        "several",
        entries,
        [helper.make_tensor_value_info("actions", kind, shape)],
        [numpy_helper.from_array(value, name) for name, value in constants],
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)
    return path


@pytest.fixture
def noisy(tmp_path):
    """The look of D4RL's policies: a sample is the mean plus what the noise input makes of it."""
    inputs = {
        "observations": (TensorProto.FLOAT, ["batch", 5]),
        "noise": (TensorProto.FLOAT, ["batch", 2]),
    }
    nodes = [
        helper.make_node("MatMul", ["observations", "gain"], ["mean"]),
        helper.make_node("Add", ["mean", "noise"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["actions"]),
    ]
    return saved(tmp_path / "noisy.onnx", inputs, nodes, [("gain", GAIN)])


@pytest.fixture
def timed(tmp_path):
    """The look of Isaac Lab's: a time step beside the observation, of another type and shape."""
    inputs = {
        "time_step": (TensorProto.FLOAT, [1, 1]),
        "obs": (TensorProto.DOUBLE, [1, 5]),
    }
    nodes = [
        helper.make_node("Cast", ["obs"], ["narrow"], to=TensorProto.FLOAT),
        helper.make_node("Concat", ["narrow", "time_step"], ["all"], axis=1),
        helper.make_node("MatMul", ["all", "gain"], ["actions"]),
    ]
    gain = np.concatenate([GAIN, np.ones((1, 2), np.float32)])
    return saved(
        tmp_path / "timed.onnx",
        inputs,
        nodes,
        [("gain", gain)],
        output=((1, 2), TensorProto.FLOAT),
    )


@pytest.fixture
def grouped(tmp_path):
    """Three groups of an observation, given in another order than the file has them."""
    inputs = {
        "command": (TensorProto.FLOAT, ["batch", 1]),
        "joints": (TensorProto.FLOAT, ["batch", 3]),
        "height": (TensorProto.FLOAT16, ["batch", 1]),
        "count": (TensorProto.INT64, []),
    }
    nodes = [
        helper.make_node("Cast", ["height"], ["tall"], to=TensorProto.FLOAT),
        helper.make_node("Cast", ["count"], ["number"], to=TensorProto.FLOAT),
        helper.make_node("Concat", ["joints", "tall", "command"], ["all"], axis=1),
        helper.make_node("MatMul", ["all", "gain"], ["product"]),
        helper.make_node("Add", ["product", "number"], ["actions"]),
    ]
    return saved(tmp_path / "grouped.onnx", inputs, nodes, [("gain", GAIN)])


def test_a_constant_is_given_by_name_and_the_rest_is_the_observation(noisy):
    expert = load_expert(noisy, 5, 2, inputs={"noise": 0.0})
    assert expert.ask(ROWS, "act") == pytest.approx(np.tanh(ROWS @ GAIN), abs=1e-6)
    assert expert.module is not None  # and so it can be differentiated
    shifted = load_expert(noisy, 5, 2, inputs={"noise": [0.5, -0.5]})
    expected = np.tanh(ROWS @ GAIN + [0.5, -0.5])
    assert shifted.ask(ROWS, "act") == pytest.approx(expected, abs=1e-6)


def test_a_fixed_batch_and_other_types_are_taken_too(timed):
    expert = load_expert(timed, 5, 2, inputs="time_step=2")
    assert expert.ask(ROWS, "act") == pytest.approx(ROWS @ GAIN + 2, abs=1e-5)


def test_groups_are_taken_from_columns(grouped):
    given = {"joints": "0:3", "height": slice(3, 4), "command": "4:5", "count": 3}
    expert = load_expert(grouped, 5, 2, inputs=given)
    assert expert.ask(ROWS, "act") == pytest.approx(ROWS @ GAIN + 3, abs=2e-3)  # float16
    left_out = {name: part for name, part in given.items() if name != "command"}
    again = load_expert(grouped, inputs=left_out)
    assert np.array_equal(again.ask(ROWS, "act"), expert.ask(ROWS, "act"))


@pytest.mark.slow
def test_it_is_distilled_with_one_flag(noisy, tmp_path):
    expert = opened(str(noisy), TOY, output=None, inputs="noise=0", trust=None)
    result = fdtasil.distill(expert, TOY, 3, **QUICK, progress=False, out=tmp_path / "run")
    assert np.isfinite(result.evaluation.normalized_return)
    workers = load_expert(noisy, 5, 2, inputs={"noise": 0.0}, workers=1)
    assert workers.ask(ROWS, "act") == pytest.approx(np.tanh(ROWS @ GAIN), abs=1e-6)


def test_the_error_lists_every_input_and_what_to_write(grouped, timed):
    with pytest.raises(ExpertError, match="4 inputs: command float") as error:
        load_expert(grouped, 5, 2)
    written = '{"command": "0:1", "joints": "1:4", "height": "4:5", "count": 0.0}'
    assert written in error.value.next_step
    assert "memory" not in str(error.value)


@pytest.mark.fault(209)
def test_what_is_left_out_has_the_other_columns(tmp_path):
    inputs = {
        "obs": (TensorProto.FLOAT, ["batch", "n"]),
        "goal": (TensorProto.FLOAT, ["batch", 2]),
    }
    nodes = [
        helper.make_node("Concat", ["obs", "goal"], ["all"], axis=1),
        helper.make_node("MatMul", ["all", "gain"], ["actions"]),
    ]
    path = saved(tmp_path / "e.onnx", inputs, nodes, [("gain", GAIN)])
    expert = load_expert(path, 5, 2, inputs={"goal": "3:5"})
    assert expert.ask(ROWS, "act") == pytest.approx(ROWS @ GAIN, abs=1e-5)
    first = load_expert(path, 5, 2, inputs={"goal": "0:2"})
    turned = np.concatenate([ROWS[:, 2:], ROWS[:, :2]], axis=1)
    assert first.ask(ROWS, "act") == pytest.approx(turned @ GAIN, abs=1e-5)
    with pytest.raises(SettingError, match="is given 3 numbers"):
        load_expert(path, 5, 2, inputs={"goal": "0:3"})
    with pytest.raises(SettingError, match="columns up to 6"):
        load_expert(path, 5, 2, inputs={"goal": "4:6"})
    with pytest.raises(SettingError, match="inputs= of a function"):
        load_expert(lambda rows: rows, 5, 5, inputs={"goal": 0.0})


def test_one_input_at_most_is_left_out(grouped):
    with pytest.raises(SettingError, match="nothing for 'command' and 'joints' and 'count'"):
        load_expert(grouped, 5, 2, inputs={"height": "3:4"})


@pytest.mark.parametrize(
    ("inputs", "found"),
    [
        ({"nose": 0.0}, r"'nose'\n.* one of observations \(batch, 5\), noise"),
        ({"noise": 0.0, "observations": 1.0}, "all of them are constants"),
        ({"noise": "a:b"}, "'noise' is a:b"),
        ({"noise": "3:1"}, "'noise' is 3:1"),
        ({"noise": np.nan}, "'noise' is nan"),
        ({"noise": None}, "'noise' is None"),
        ("noise", "inputs 'noise'"),
        ("noise=x", "inputs 'noise=x'"),
        (5, "inputs=5"),
    ],
    ids=str,
)
def test_wrong_inputs_are_named(noisy, inputs, found):
    with pytest.raises(SettingError, match=found) as error:
        load_expert(noisy, 5, 2, inputs=inputs)
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.parametrize("width", ["", ", 1"])
def test_an_input_of_a_choice_is_given_its_number_in_its_own_shape(width):
    model = onnx.parser.parse_model(
        f"""<ir_version: 8, opset_import: ["" : 17]>
        law (float[N, 2] speed, int64[N{width}] gear) => (float[N, 1] y) {{
            shape = Constant <value = int64[2] {{-1, 1}}> ()
            column = Reshape (gear, shape)
            number = Cast <to = 1> (column)
            axes = Constant <value = int64[1] {{1}}> ()
            total = ReduceSum <keepdims = 1> (speed, axes)
            y = Add (total, number)
        }}"""
    )
    given = {"speed": slice(0, 2), "gear": Choices(((2, 5),), (7,))}
    session = onnxruntime.InferenceSession(bind(model, given, 5).SerializeToString())
    rows = np.float32([[0.5, 0.25, 0, 1, 0], [1, 1, 0, 0, 1]])
    (answers,) = session.run(None, {session.get_inputs()[0].name: rows})
    assert answers[:, 0].tolist() == [8.75, 11.0]
