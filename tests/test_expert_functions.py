"""Experts whose answers or questions are odd: what is taken, what is refused, and how it reads."""

import re
import threading
import time

import numpy as np
import onnx
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from gymnasium.spaces import Box
from onnx import TensorProto, helper, numpy_helper
from sb3_agents import make_agent, save_agent
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import EnvironmentFault, ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.gate import admit_expert
from fdtasil.rollouts.environments import Boxes

pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((37, 5)).astype(np.float32)


@pytest.fixture
def expert(tmp_path):
    return fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx"), 5, 2)


def error_of(work, kind=ExpertError):
    """Return the text of an error, after checking its form."""
    with pytest.raises(kind) as caught:
        work()
    text = str(caught.value)
    assert "\n  expected: " in text
    assert "\n  next step: " in text
    assert len(text.splitlines()) <= 6
    return text


def edited(path, change):
    model = onnx.load(path)
    change(model)
    onnx.save(model, path)
    return path


# --- what an expert is asked


SAME = {
    "list": lambda rows: rows.tolist(),
    "float64": lambda rows: rows.astype(np.float64),
    "big-endian": lambda rows: rows.astype(">f4"),
    "objects": lambda rows: rows.astype(object),
    "columns first": np.asfortranarray,
    "every second": lambda rows: np.repeat(rows, 2, axis=0)[::2],
    "masked, nowhere": lambda rows: np.ma.masked_array(rows, np.zeros(rows.shape, bool)),
    "tensor": torch.from_numpy,
    "tensor with a gradient": lambda rows: torch.from_numpy(rows).requires_grad_(),
    "read-only": lambda rows: np.frombuffer(rows.tobytes(), np.float32).reshape(rows.shape),
}


@pytest.mark.fault(31)
@pytest.mark.parametrize("kind", SAME)
def test_the_same_observations_in_other_types(kind, expert, rows):
    given = SAME[kind](rows)
    assert np.array_equal(expert.ask(given, "act"), expert.ask(rows, "act"))


@pytest.mark.fault(31)
def test_integers_are_numbers(expert):
    rows = np.arange(10).reshape(2, 5)
    assert np.array_equal(expert.ask(rows, "act"), expert.ask(rows.astype(np.float32), "act"))


WRONG = {
    "masked": (lambda rows: np.ma.masked_array(rows, rows > 1), "some of them are masked"),
    "text": (lambda rows: "observations", "numpy takes them for <U12"),
    "objects": (lambda rows: np.full((2, 5), None), "NoneType|nan"),
    "ragged": (lambda rows: [[1.0], [1.0, 2.0]], "inhomogeneous"),
    "complex": (lambda rows: rows + 1j, "complex"),
    "one": (lambda rows: rows[0], r"their shape is \(5,\)"),
    "three axes": (lambda rows: rows[None], r"their shape is \(1, 37, 5\)"),
    "wide": (lambda rows: np.ones((2, 6)), r"their shape is \(2, 6\)"),
    "nothing": (lambda rows: None, "numpy|nan|NoneType|shape"),
}


@pytest.mark.fault(31, 33)
@pytest.mark.parametrize("kind", WRONG)
def test_what_can_not_be_asked(kind, expert, rows):
    make, found = WRONG[kind]
    text = error_of(lambda: expert.ask(make(rows), "act"), SettingError)
    assert re.search(found, text)
    assert expert.queries == {}  # nothing was asked, so nothing is counted


@pytest.mark.fault(37)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_an_observation_that_is_not_finite_is_named(value, expert, rows):
    given = rows.astype(np.float64)
    given[11, 3] = value
    text = error_of(lambda: expert.ask(given, "act"), SettingError)
    assert "row 11 has" in text
    assert "in column 3" in text


@pytest.mark.fault(37)
def test_an_environment_that_gives_nan_is_named(linear, toy_environment):
    step, calls = toy_environment.step, []

    def broken(action):
        observation, *rest = step(action)
        calls.append(action)
        return (observation * np.nan if len(calls) > 5 else observation), *rest

    toy_environment.step = broken
    text = error_of(lambda: fdtasil.distill(linear, toy_environment, 2, **QUICK), EnvironmentFault)
    assert "not finite" in text


@pytest.mark.fault(35)
@pytest.mark.parametrize("batch", ["batch", 1, 8])
def test_an_empty_batch(batch, tmp_path):
    expert = fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx", batch=batch), 5, 2)
    assert expert.ask(np.zeros((0, 5), np.float32), "act").shape == (0, 2)


# --- what a file answers


@pytest.mark.fault(36)
def test_weights_that_are_nan(tmp_path):
    def spoil(model):
        weights = numpy_helper.to_array(model.graph.initializer[0]).copy()
        weights[3] = np.nan
        model.graph.initializer[0].CopyFrom(numpy_helper.from_array(weights, "w0"))

    path = edited(mlp_onnx(tmp_path / "e.onnx"), spoil)
    text = error_of(lambda: fdtasil.distill(path, TOY, 2, **QUICK))
    assert "is not finite on 16 of 16 observations" in text


def rank_one(path):
    """A model of (5,) -> (2,), as who exports a bare function has it."""
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [size])]
        for name, size in (("obs", 5), ("actions", 2))
    ]
    weights = numpy_helper.from_array(np.ascontiguousarray(GAIN.T), "w")
    node = helper.make_node("MatMul", ["obs", "w"], ["actions"])
    graph = helper.make_graph([node], "one", *ends, [weights])
    opsets = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=9), path)
    return path


@pytest.mark.fault(34)
def test_a_model_without_a_batch_axis_is_asked_in_turn(tmp_path, rows):
    with pytest.warns(FdtasilWarning, match=r"1 row\(s\) at a time .* microseconds a row"):
        expert = fdtasil.load_expert(rank_one(tmp_path / "e.onnx"), 5, 2)
    assert np.allclose(expert.ask(rows, "act"), rows @ GAIN.T, atol=1e-6)
    assert expert.ask(rows[:0], "act").shape == (0, 2)


@pytest.mark.fault(27)
def test_three_outputs_of_one_number_have_to_be_named(tmp_path, rows):
    """As a PPO agent of stable-baselines3 is exported: actions, values, log_prob."""
    outputs = {"names": ("obs", "53"), "extra_outputs": {"24": 1, "51": 1}}
    path = mlp_onnx(tmp_path / "e.onnx", sizes=(5, 8, 1), **outputs)
    text = error_of(lambda: fdtasil.load_expert(path, 5, 1))
    assert "53 float (batch, 1), 24 float (batch, 1), 51 float (batch, 1)" in text
    assert fdtasil.load_expert(path, 5, 1, output="24").ask(rows, "act").shape == (37, 1)


@pytest.mark.fault(30)
def test_dynamic_quantisation_is_refused_until_it_is_asked_row_by_row(tmp_path):
    quantization = pytest.importorskip("onnxruntime.quantization")
    path = mlp_onnx(tmp_path / "e.onnx", sizes=(5, 64, 64, 2), scale=2.0)
    quantization.quantize_dynamic(path, tmp_path / "int8.onnx")
    text = error_of(lambda: fdtasil.distill(tmp_path / "int8.onnx", TOY, 2, **QUICK))
    assert "asked alone and in a batch differs by up to" in text
    assert "batch=1" in text
    alone = fdtasil.load_expert(tmp_path / "int8.onnx", batch=1)
    assert fdtasil.distill(alone, TOY, 2, **{**QUICK, "episodes": 1}, force=True).evaluation


def before_the_end(*nodes, constants=()):
    """Return a change that puts nodes from `x` to `y` before the last operator."""

    def change(model):
        last = model.graph.node.pop()
        for node in nodes:
            node.input[:] = [last.input[0] if name == "x" else name for name in node.input]
            model.graph.node.append(node)
        model.graph.initializer.extend(constants)
        last.input[0] = "y"
        model.graph.node.append(last)

    return change


@pytest.mark.fault(40)
def test_a_stochastic_export(tmp_path):
    noise = helper.make_node("RandomNormalLike", ["x"], ["noise"], scale=0.3)
    change = before_the_end(noise, helper.make_node("Add", ["x", "noise"], ["y"]))
    path = edited(mlp_onnx(tmp_path / "e.onnx"), change)
    text = error_of(lambda: fdtasil.distill(path, TOY, 2, **QUICK))
    assert "asked twice differs by up to" in text
    assert "deterministic policy" in text


@pytest.mark.fault(41)
def test_normalisation_over_the_batch(tmp_path):
    mean = helper.make_node("ReduceMean", ["x"], ["mean"], axes=[0], keepdims=1)
    change = before_the_end(mean, helper.make_node("Sub", ["x", "mean"], ["y"]))
    path = edited(mlp_onnx(tmp_path / "e.onnx"), change)
    text = error_of(lambda: fdtasil.distill(path, TOY, 2, **QUICK))
    assert "asked alone and in a batch differs by up to" in text


@pytest.mark.slow
@pytest.mark.fault(42)
def test_a_recurrent_network_has_a_memory(tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = torch.nn.LSTM(5, 2).eval()
    inputs = torch.zeros(1, 1, 5), (torch.zeros(1, 1, 2), torch.zeros(1, 1, 2))
    names = {"input_names": ["obs", "h", "c"], "output_names": ["actions", "h1", "c1"]}
    path = tmp_path / "lstm.onnx"
    torch.onnx.export(module, inputs, path, dynamo=True, verbose=False, **names)
    expert = fdtasil.load_expert(path, 5, 2)
    assert (expert.observation_size, expert.memory.size) == (5 + 4, 4)
    rows = np.random.default_rng(0).standard_normal((3, 9)).astype(np.float32)
    state = torch.from_numpy(rows[:, 5:7])[None], torch.from_numpy(rows[:, 7:])[None]
    with torch.no_grad():
        expected, _ = module(torch.from_numpy(rows[:, :5])[None], state)
    assert expert.ask(rows, "act") == pytest.approx(expected[0].numpy(), abs=1e-5)


@pytest.mark.fault(43)
def test_a_policy_of_discrete_actions_is_refused(tmp_path):
    def choose(model):
        chosen = helper.make_node("ArgMax", ["actions"], ["choice"], axis=1, keepdims=0)
        model.graph.node.append(chosen)
        output = helper.make_tensor_value_info("choice", TensorProto.INT64, ["batch"])
        model.graph.output[0].CopyFrom(output)

    path = edited(mlp_onnx(tmp_path / "e.onnx"), choose)
    text = error_of(lambda: fdtasil.load_expert(path, 5, 2))
    assert "0 outputs that could be the actions: choice int64 (batch)" in text
    assert "one floating-point output (batch, 2)" in text


@pytest.mark.fault(51)
def test_an_agent_of_another_environment(tmp_path):
    path = save_agent(tmp_path, make_agent("SAC"))
    text = error_of(lambda: fdtasil.distill(path, TOY, 2, **QUICK))
    assert "has 3 observations, the environment has 5" in text


@pytest.mark.fault(46)
def test_the_algorithm_is_read_from_the_zip(tmp_path):
    states = np.random.default_rng(0).standard_normal((9, 3)).astype(np.float32)
    for name in ("PPO", "SAC", "TD3"):
        agent = make_agent(name)
        read = fdtasil.load_expert(save_agent(tmp_path, agent, "agent.zip"), 3, 1)
        expected = agent.predict(states, deterministic=True)[0]
        np.testing.assert_allclose(read.ask(states, "act"), expected, atol=1e-5)


# --- what a function answers


@pytest.mark.slow
@pytest.mark.fault(45)
def test_an_expert_that_takes_hours_is_announced_before_it_acts():
    asked = []

    def slow(observations):
        asked.append(len(observations))
        time.sleep(0.004 * len(observations))
        return observations @ GAIN.T

    longer = {**QUICK, "episodes": 100, "horizon": 40}
    # Warnings are errors here, so that it ends there.
    with pytest.raises(FdtasilWarning, match=r"ms a row, so the [\d,]+ rows .* up to \d\.\d h"):
        fdtasil.distill(slow, TOY, 50, **longer)
    assert sum(asked) == 48  # the first part of the gate
    assert fdtasil.distill(slow, TOY, 2, **{**QUICK, "episodes": 1}).evaluation  # in silence


@pytest.mark.fault(52)
def test_a_function_of_one_observation_is_found_out_where_all_sizes_are_equal():
    """Given as many rows as an observation has numbers, it answers in the right shape."""
    gain = np.random.default_rng(0).standard_normal((16, 16)).astype(np.float32) / 16
    states = np.random.default_rng(1).standard_normal((16, 16)).astype(np.float32)
    expert = fdtasil.load_expert(lambda observation: gain @ observation, 16, 16)
    assert expert.ask(states, "act").shape == (16, 16)
    boxes = Boxes(16, -np.ones(16, np.float32), np.ones(16, np.float32))
    assert "raised ValueError on 1 observations" in error_of(
        lambda: admit_expert(expert, states, boxes)
    )


PLAIN = {
    "with None beside": (53, lambda rows: (rows @ GAIN.T, None)),
    "a list with None beside": (53, lambda rows: ((rows @ GAIN.T).tolist(), None)),
    "tensor": (54, lambda rows: torch.from_numpy(rows) @ torch.from_numpy(GAIN.T)),
    "tensor with a gradient": (
        54,
        lambda rows: torch.from_numpy(rows).requires_grad_() @ torch.from_numpy(GAIN.T),
    ),
    "half a tensor": (54, lambda rows: torch.from_numpy(rows @ GAIN.T).bfloat16()),
    "float64": (59, lambda rows: rows.astype(float) @ GAIN.T),
    "columns first": (59, lambda rows: np.asfortranarray(rows @ GAIN.T)),
    "big-endian": (59, lambda rows: (rows @ GAIN.T).astype(">f8")),
    "list of arrays": (59, lambda rows: list(rows @ GAIN.T)),
}


@pytest.mark.slow
@pytest.mark.fault(53, 54, 59)
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("kind", PLAIN)
def test_what_a_function_may_return(kind, workers, rows):
    options = {"workers": workers, "batch": 64}
    answers = fdtasil.load_expert(PLAIN[kind][1], 5, 2, **options).ask(rows, "act")
    assert answers.dtype == np.float32
    assert answers.flags.c_contiguous
    np.testing.assert_allclose(answers, rows @ GAIN.T, atol=0.02 if "half" in kind else 1e-5)


ODD = {
    "with a state": (lambda rows: (rows @ GAIN.T, np.zeros(3)), "second value beside the actions"),
    "one axis": (lambda rows: (rows @ GAIN.T)[:, 0], r"with shape \(37,\)"),
    "three axes": (lambda rows: (rows @ GAIN.T)[:, :, None], r"with shape \(37, 2, 1\)"),
    "turned": (lambda rows: (rows @ GAIN.T).T, r"with shape \(2, 37\)"),
    "nothing": (lambda rows: None, "None|nan|shape"),
    "complex": (lambda rows: rows @ GAIN.T + 1j, "complex numbers"),
    "dictionary": (lambda rows: {"actions": rows}, "dict"),
    "ragged": (lambda rows: [[1.0]] + [[1.0, 2.0]] * 36, "inhomogeneous"),
    "generator": (lambda rows: (row for row in rows), "generator"),
}


@pytest.mark.fault(53, 59)
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("kind", ODD)
def test_what_it_may_not(kind, workers, rows):
    answer, found = ODD[kind]
    expert = fdtasil.load_expert(answer, 5, 2, workers=workers, batch=64)
    text = error_of(lambda: expert.ask(rows, "act"))
    assert re.search(found, text)


@pytest.mark.fault(55)
def test_answers_in_the_experts_own_buffer_are_copied(rows):
    buffer = np.zeros((37, 2), np.float32)

    def answer(observations):
        np.matmul(observations, GAIN.T, out=buffer)
        return buffer

    expert = fdtasil.load_expert(answer, 5, 2)
    first = expert.ask(rows, "act")
    kept = first.copy()
    expert.ask(2 * rows, "act")
    assert np.array_equal(first, kept)
    assert not np.shares_memory(first, buffer)


@pytest.mark.fault(56)
def test_an_expert_that_changes_its_input_changes_nothing(rows):
    def answer(observations):
        observations *= 2
        return observations[:, :2]

    before = rows.copy()
    for asked in (rows, torch.from_numpy(rows)):
        assert np.array_equal(fdtasil.load_expert(answer).ask(asked, "act"), 2 * before[:, :2])
        assert np.array_equal(rows, before)


@pytest.mark.fault(57)
def test_a_function_that_raises_at_some_call_leaves_a_run_to_go_on_with(tmp_path):
    left = [90]  # calls: the first round of three takes 79

    def controller(observations):
        left[0] -= 1
        if left[0] == 0:
            raise RuntimeError("the solver\n" + "did not converge\n" * 50)
        return observations @ GAIN.T

    run, folder = {**QUICK, "trainer": "dagger", "episodes": 6}, tmp_path / "run"
    with pytest.raises(ExpertError, match="raised RuntimeError") as caught:
        fdtasil.distill(controller, TOY, 2, out=folder, **run)
    assert len(str(caught.value).splitlines()) <= 6
    assert isinstance(caught.value.__cause__, RuntimeError)
    resumed = fdtasil.distill(controller, TOY, 2, resume=folder, **run)
    whole = fdtasil.distill(controller, TOY, 2, **run)
    assert resumed.student.to_bytes({}) == whole.student.to_bytes({})
    assert resumed.report["rows_asked_again_after_resuming"] > 0


@pytest.mark.fault(58)
def test_a_function_that_can_not_be_sent_says_how(rows):
    lock = threading.Lock()
    text = error_of(lambda: fdtasil.load_expert(lambda rows: lock and rows, workers=2))
    assert "can't be sent to another process" in text
    assert "threads=True" in text


class Several(torch.nn.Module):
    def forward(self, rows):
        return {"actions": rows[:, :2], "value": rows[:, 4:]}


@pytest.mark.parametrize(
    ("source", "output", "named"),
    [
        (lambda rows: {"u": rows[:, :2], "v": rows[:, 4:]}, "u", "u, v"),
        (lambda rows: (rows[:, 4:], rows[:, :2], rows[:, :1]), "1", "0, 1, 2"),
        (lambda rows: (rows[:, 4:], rows[:, :2], rows[:, :1]), 1, "0, 1, 2"),
        (Several(), "actions", "actions, value"),
    ],
)
def test_one_of_several_things_is_chosen(source, output, named):
    rows = np.random.default_rng(0).standard_normal((7, 5)).astype(np.float32)
    chosen = fdtasil.load_expert(source, 5, 2, output=output)
    assert np.array_equal(chosen.ask(rows, "check"), rows[:, :2])
    with pytest.raises(ExpertError, match=rf"\({named}\): say which by output="):
        fdtasil.load_expert(source, 5, 2).ask(rows, "check")
    with pytest.raises(ExpertError, match="of which none is 'x'"):
        fdtasil.load_expert(source, 5, 2, output="x").ask(rows, "check")


def test_an_output_of_what_has_none():
    class Predicts:
        def predict(self, rows):
            return rows[:, :2]

    with pytest.raises(SettingError, match="output= of a Predicts"):
        fdtasil.load_expert(Predicts(), 5, 2, output="u")
    with pytest.raises(ExpertError, match="no part 'u'"):
        fdtasil.load_expert(lambda rows: rows[:, :2], 5, 2, output="u").ask(
            np.zeros((2, 5)), "check"
        )


@pytest.mark.fault(246)
def test_an_expert_that_is_gone_is_not_asked_a_thousand_times_more():
    calls, gone = 0, False

    def far_away(rows):
        nonlocal calls
        calls += 1
        if gone:
            raise RuntimeError("no route to the host")
        return rows[:, :2]

    expert = fdtasil.load_expert(far_away, 5, 2)
    expert.ask(np.ones((4, 5), np.float32), "act")
    gone, calls = True, 0
    with pytest.raises(ExpertError, match="no route to the host"):
        expert.ask(np.ones((1000, 5), np.float32), "probe")
    assert calls == 1 + 8 + 1


def test_many_rows_without_an_answer_are_none_where_others_have_one():
    def limited(rows):
        if (rows[:, 0] > 0).any():
            raise ValueError("infeasible")
        return rows[:, :2]

    expert = fdtasil.load_expert(limited, 5, 2)
    rows = np.ones((100, 5), np.float32)
    rows[80:] = -1
    expert.ask(rows[90:], "act")
    answers = expert.ask(rows, "probe")
    assert np.isnan(answers[:80]).all()
    assert (answers[80:] == -1).all()


def test_an_output_that_is_a_list_of_dictionaries_says_how_to_convert_it(tmp_path):
    """A classifier of skl2onnx, as it is written if nothing is said."""
    rows = helper.make_tensor_value_info("rows", TensorProto.FLOAT, ["batch", 3])
    label = helper.make_tensor_value_info("label", TensorProto.INT64, ["batch", 1])
    each = helper.make_map_type_proto(
        TensorProto.INT64, helper.make_tensor_type_proto(TensorProto.FLOAT, [])
    )
    shares = helper.make_value_info("shares", helper.make_sequence_type_proto(each))
    best = helper.make_node("ArgMax", ["rows"], ["label"], axis=1)
    zipped = helper.make_node(
        "ZipMap", ["rows"], ["shares"], domain="ai.onnx.ml", classlabels_int64s=[0, 1, 2]
    )
    graph = helper.make_graph([best, zipped], "classifier", [rows], [label, shares])
    versions = [helper.make_opsetid("", 17), helper.make_opsetid("ai.onnx.ml", 1)]
    model = helper.make_model(graph, opset_imports=versions, ir_version=8)
    onnx.save(model, tmp_path / "classifier.onnx")
    for output in (None, "shares"):
        with pytest.raises(ExpertError) as caught:
            fdtasil.load_expert(tmp_path / "classifier.onnx", 3, output=output)
        assert '{"zipmap": False}' in caught.value.next_step


@pytest.mark.parametrize(
    ("option", "said"),
    [({"inputs": {"obs": "0:5"}}, "inputs="), ({"memory": {"h": "g"}}, "memory=")],
)
@pytest.mark.parametrize("source", ["http://127.0.0.1:9/act", "agent.zip", lambda rows: rows])
def test_an_option_that_nothing_is_made_of_is_refused(source, option, said):
    with pytest.raises(SettingError, match=said):
        fdtasil.load_expert(source, 5, 2, **option)


def test_a_trust_that_nothing_was_opened_with_is_not_recorded(tmp_path):
    assert (
        fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx"), trust="pickle").origin.options is None
    )
    assert fdtasil.load_expert(mlp_onnx(tmp_path / "e.onnx"), output="actions").origin.options


def test_a_predict_that_is_no_function():
    class Odd:
        predict = 3

    with pytest.raises(ExpertError, match=r"Odd\.predict is a int"):
        fdtasil.load_expert(Odd(), 5, 2)


def test_answers_of_several_widths_are_told():
    expert = fdtasil.load_expert(lambda rows: np.ones((len(rows), 1 + len(rows))), batch=4)
    with pytest.raises(ExpertError, match="some batches with 3 actions, others with 5"):
        expert.ask(np.zeros((6, 3)), "check")


@pytest.mark.fault(325)
def test_masks_that_nobody_hands_over_are_warned_of():
    class Masked:
        def predict(self, observation, state=None, deterministic=False, action_masks=None):
            return np.zeros((len(observation), 2)), None

    with pytest.warns(fdtasil.FdtasilWarning, match="takes action_masks"):
        expert = fdtasil.load_expert(Masked(), 5, 2)
    assert not expert.ask(np.ones((2, 5)), "check").any()


class Regressor:
    """Answers as scikit-learn, XGBoost and LightGBM do where there is one target."""

    def predict(self, rows):
        return np.clip(rows @ GAIN.T[:, 0], -1, 1)


class OneForce(Integrator):
    """Which takes one force along both axes."""

    def __init__(self):
        super().__init__()
        self.action_space = Box(-1, 1, (1,), np.float32)

    def step(self, action):
        return super().step(np.repeat(action, 2))


@pytest.mark.parametrize("kind", [Regressor, lambda: Regressor().predict])
def test_an_answer_of_one_action_needs_no_axis(kind):
    result = fdtasil.distill(kind(), OneForce, 2, **QUICK)
    states = result.demonstrations.observations
    assert result.demonstrations.actions[:, 0] == pytest.approx(
        Regressor().predict(states), abs=1e-5
    )
    assert fdtasil.gains(kind(), states[:4]).jacobian.shape == (4, 1, 5)


def test_a_function_of_the_whole_batch_is_no_answer_of_one_action():
    with pytest.raises(ExpertError, match="observations with shape"):
        fdtasil.distill(lambda rows: rows.sum(axis=0), OneForce, 2, **QUICK)
