"""The student: bounds and normaliser inside, its files, its ONNX."""

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from fdtasil.errors import ExportError, FdtasilError, SettingError, StorageError
from fdtasil.files.onnx.export import export_module
from fdtasil.probes.scales import measure_scales
from fdtasil.seeding import torch_generator
from fdtasil.student.architectures import ACTIVATIONS, ARCHITECTURES, Mlp
from fdtasil.student.exports import export
from fdtasil.student.plain import PlainPolicy
from fdtasil.student.policy import Student


def make(hidden=(16, 8), activation="gelu", low=(-2.0, -1.0), high=(2.0, 3.0), seed=0):
    mean, scale = np.array([5.0, 0, 0]), np.array([2.0, 1, 1])
    bounds = np.array(low), np.array(high)
    return Student(Mlp(hidden, activation), mean, scale, *bounds, torch_generator(seed))


@pytest.fixture
def rows():
    return 30 * np.random.default_rng(0).standard_normal((50, 3)).astype(np.float32)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(), (4,), (16, 8)])
def test_every_shape_stays_inside_its_bounds_and_exports(hidden, activation, rows):
    student = make(hidden, activation)
    actions = student.act(rows)
    assert actions.shape == (50, 2)
    assert (actions >= [-2, -1]).all()
    assert (actions <= [2, 3]).all()
    assert np.ptp(actions, axis=0).min() > 1
    model = onnx.load_model_from_string(export_module(student, rows, {"a": "b"}))
    assert {p.key: p.value for p in model.metadata_props} == {"a": "b"}
    session = onnxruntime.InferenceSession(model.SerializeToString())
    for count in (1, 2, 50):
        (answers,) = session.run(["actions"], {"obs": rows[:count]})
        assert np.abs(answers - actions[:count]).max() <= 1e-5


def test_unbounded_actions_are_linear(rows):
    student = make(low=(-np.inf, -1.0), high=(np.inf, 1.0))
    actions = student.act(rows)
    assert np.abs(actions[:, 0]).max() > 3
    assert np.abs(actions[:, 1]).max() <= 1


def test_the_normaliser_is_inside(rows):
    inside = make()
    outside = make()
    outside.mean.zero_()
    outside.scale.fill_(1)
    normalised = (rows - np.array([5, 0, 0])) / np.array([2, 1, 1])
    assert np.allclose(inside.act(rows), outside.act(normalised), atol=1e-5)


def test_predict_takes_one_observation_or_many(rows):
    student = make()
    many, state = student.predict(rows)
    one, _ = student.predict(rows[3])
    assert state is None
    assert one.shape == (2,)
    assert np.allclose(one, many[3], atol=1e-6)
    with pytest.raises(SettingError, match=r"shape \(4,\)"):
        student.predict(np.zeros(4))


def test_stable_baselines3_evaluates_it():
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    network, bound = Mlp(8, "tanh"), np.array([2.0])
    student = Student(network, np.zeros(3), np.ones(3), -bound, bound, torch_generator(0))
    environment = make_vec_env("Pendulum-v1", 2, seed=0)
    mean, deviation = evaluate_policy(student, environment, n_eval_episodes=2, warn=False)
    assert np.isfinite(mean)
    assert np.isfinite(deviation)


@pytest.fixture(autouse=True)
def untouched_global_randomness():
    """stable-baselines3 seeds the global generators."""


def test_equal_seeds_give_equal_bytes_and_they_read_back(rows):
    first, second, other = make(seed=1), make(seed=1), make(seed=2)
    assert first.to_bytes() == second.to_bytes()
    assert first.to_bytes() != other.to_bytes()
    again = Student.from_bytes(first.to_bytes({"note": "kept"}))
    assert again.architecture == first.architecture == Mlp((16, 8), "gelu")
    assert (again.observation_size, again.action_size) == (3, 2)
    assert np.array_equal(again.act(rows), first.act(rows))


@pytest.mark.parametrize("data", [b"", b"nonsense", make().to_bytes()[:-9]])
def test_other_bytes_are_no_student(data):
    with pytest.raises(StorageError, match="not a student's weights"):
        Student.from_bytes(data)


@pytest.mark.fault(101)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("layer", [0, -1])
def test_weights_that_are_not_finite_are_not_exported(value, layer, rows):
    """Infinite ones may answer with finite actions, for a tanh comes after them."""
    student = make()
    with torch.no_grad():
        list(student.parameters())[layer].view(-1)[0] = value
    with pytest.raises(ExportError, match="Student has weights that are not finite"):
        export_module(student, rows, {})


@pytest.mark.fault(101)
def test_an_answer_that_is_not_finite_is_not_exported(rows):
    class Logarithm(torch.nn.Module):
        def forward(self, x):
            """Of negative numbers too."""
            return torch.log(x)

    with pytest.raises(ExportError, match="differ by nan"):
        export_module(Logarithm(), rows, {})


@pytest.mark.slow
@pytest.mark.fault(102)
def test_an_export_is_of_the_module_in_evaluation_mode_which_is_put_back(rows):
    with torch.random.fork_rng():
        layers = torch.nn.Linear(3, 8), torch.nn.BatchNorm1d(8), torch.nn.Dropout(0.5)
        module = torch.nn.Sequential(*layers, torch.nn.Linear(8, 2))
    module.train()
    data = export_module(module, rows, {})
    assert module.training
    assert all(layer.training for layer in module)
    assert "Dropout" not in {node.op_type for node in onnx.load_model_from_string(data).graph.node}
    (answers,) = onnxruntime.InferenceSession(data).run(None, {"obs": rows})
    with torch.no_grad():
        assert np.abs(answers - module.eval()(torch.from_numpy(rows)).numpy()).max() <= 1e-5
    module.eval()
    assert export_module(module, rows, {}) == data
    assert not module.training


def test_a_module_that_onnx_can_not_hold_is_named(rows):
    class Branches(torch.nn.Module):
        def forward(self, x):
            """Depends on a value, which a graph can't."""
            return x if float(x.sum()) > 0 else -x

    with pytest.raises(ExportError, match="can't export Branches"):
        export_module(Branches(), rows, {})


@pytest.mark.parametrize("wrong", [{"activation": "step"}, {"hidden": (0,)}, {"hidden": (2.5,)}])
def test_a_wrong_shape_is_refused(wrong):
    with pytest.raises(SettingError):
        make(**wrong)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("bounds", ["both", "none", "one"])
def test_a_robot_needs_numpy_alone(activation, bounds, tmp_path):
    """The file that is exported answers in a process where nothing else can be imported."""
    student = make((16, 8), activation)
    if bounds != "both":
        low, high = np.float32([-1, -1]), np.float32([1, 1])
        low[: 1 if bounds == "one" else 2], high[: 1 if bounds == "one" else 2] = -np.inf, np.inf
        scales = measure_scales(np.random.default_rng(0).normal(3, 2, (50, 2)))
        network, random = Mlp((16, 8), activation), torch_generator(0)
        student = Student(network, np.zeros(3), np.ones(3), low, high, random, scales)
    rows = np.random.default_rng(0).standard_normal((50, 3)).astype(np.float32)
    for name in ("student.py", "student.safetensors"):
        (tmp_path / name).write_bytes(export(student, rows, {}, name))
    np.save(tmp_path / "rows.npy", rows)
    script = (
        "import sys, time, numpy as np\n"
        "sys.modules.update(dict.fromkeys(('torch', 'onnxruntime', 'fdtasil', 'safetensors')))\n"
        "start = time.perf_counter()\n"
        "from student import PlainPolicy\n"
        "assert time.perf_counter() - start < 0.2\n"
        "np.save('answers.npy', PlainPolicy.load()(np.load('rows.npy')))\n"
    )
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    expected = student.act(rows)
    assert np.load(tmp_path / "answers.npy") == pytest.approx(expected, abs=1e-5)


def test_weights_that_are_none(tmp_path):
    good = make((8,)).to_bytes()
    for data in (b"", b"x" * 100, good[:50], good.replace(b"fdtasil", b"fdtaslo")):
        (tmp_path / "s.safetensors").write_bytes(data)
        with pytest.raises(ValueError, match="not the weights"):
            PlainPolicy.load(tmp_path / "s.safetensors")


@pytest.mark.fault(304)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_in_eight_bits_it_is_a_quarter_and_nearly_the_same(activation):
    student = make((64, 64), activation)
    rows = np.array([5.0, 0, 0]) + np.random.default_rng(0).standard_normal((400, 3))
    rows = rows.astype(np.float32)
    data = export(student, rows, {"a": "b"}, "student.int8.onnx")
    whole = export(student, rows, {"a": "b"}, "student.onnx")
    assert len(data) < 0.6 * len(whole)  # of 64 x 64, whose scales and nodes take their part
    session = onnxruntime.InferenceSession(data)
    (answers,) = session.run(["actions"], {"obs": rows})
    assert 0 < np.abs(answers - student.act(rows)).mean() < 0.1
    assert data == export(student, rows, {"a": "b"}, "student.int8.onnx")
    # Signed ones overflow where a processor adds products in 16 bits: seen on AVX2 without VNNI.
    weights = [one for one in onnx.load_from_string(data).graph.initializer if len(one.dims) == 2]
    assert {one.data_type for one in weights} == {onnx.TensorProto.UINT8}


@pytest.mark.fault(222)
def test_what_eight_bits_can_not_hold_is_refused():
    student = make((8, 8), "relu", low=(-np.inf, -np.inf), high=(np.inf, np.inf))
    with torch.no_grad():
        student.network[4].weight.mul_(1000)  # of actions in units of 1
    rows = 50 * np.random.default_rng(0).standard_normal((200, 3)).astype(np.float32)
    with pytest.raises(ExportError, match="in int8"):
        export(student, rows, {}, "student.int8.onnx")


@pytest.mark.fault(265)
def test_the_copy_in_numpy_follows_every_weight():
    student, rows = make(), np.zeros((2, 3), np.float32)
    student.predict(rows[0])
    with torch.no_grad():
        student.network[-1].bias = torch.nn.Parameter(student.network[-1].bias + 1)
    assert student.predict(rows[0])[0] == pytest.approx(student.predict(rows)[0][0], abs=1e-5)


@pytest.mark.fault(299)
def test_no_answer_is_rounded_beyond_its_bounds():
    low = np.repeat(np.round(np.arange(-2, 0, 0.1), 1), 20).astype(np.float32)
    high = np.tile(np.round(np.arange(0.1, 2.1, 0.1), 1), 20).astype(np.float32)
    low, high = np.append(low, [299.99997, 1e8]), np.append(high, [300.1, 1e8 + 8])
    low, high = low.astype(np.float32), high.astype(np.float32)
    student = Student(
        Mlp(()), np.zeros(1), np.ones(1), low, high, torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        student.network[0].weight.fill_(100.0)
    rows = np.float32([[-1], [1]])
    for answers in (student.act(rows), student(torch.from_numpy(rows)).detach().numpy()):
        assert (answers >= low).all()
        assert (answers <= high).all()
        assert answers[0] == pytest.approx(low, rel=1e-6)
        assert answers[1] == pytest.approx(high, rel=1e-6)


@pytest.mark.fault(300)
@pytest.mark.parametrize("suffix", [".c", ".onnx", ".py"])
def test_what_float32_rounds_of_an_action_is_no_difference(suffix):
    low, high = np.float32([299]), np.float32([301])
    random, states = torch.Generator().manual_seed(0), np.random.default_rng(0)
    student = Student(Mlp((16, 16)), np.zeros(4), np.ones(4), low, high, random).eval()
    assert export(student, states.standard_normal((500, 4)).astype(np.float32), {}, f"s{suffix}")


def test_an_architecture_that_is_not_known_is_named(monkeypatch):
    @dataclass(frozen=True)
    class Flat:
        width: int = 3

        def build(self, observation_size, action_size, random):
            return Mlp(self.width).build(observation_size, action_size, random)

    monkeypatch.setitem(ARCHITECTURES, "flat", Flat)
    random = torch.Generator().manual_seed(0)
    data = Student(Flat(), np.zeros(2), np.ones(2), -np.ones(1), np.ones(1), random).to_bytes()
    assert Student.from_bytes(data).architecture == Flat()
    monkeypatch.delitem(ARCHITECTURES, "flat")
    with pytest.raises(FdtasilError, match="architecture 'flat', which is not known here"):
        Student.from_bytes(data)
