"""Every kind of expert keeps one contract; ONNX files are taken as users have them."""

import os
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from conftest import GAIN, mlp_onnx
from onnx import TensorProto

from fdtasil.errors import ExpertError, FdtasilWarning
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((37, 5)).astype(np.float32)


class Predicts:
    """What stable-baselines3's agents look like."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        return observation @ GAIN.T, None


class Module(torch.nn.Module):
    """A torch module in double precision."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.from_numpy(GAIN).double())

    def forward(self, observations):
        """(B, 5) -> (B, 2)."""
        return observations @ self.gain.T


def own_buffer(rows, buffer=np.zeros((5000, 2), np.float64)):  # noqa: B008
    """Answers in its own buffer, and writes into its input."""
    buffer[: len(rows)] = rows @ GAIN.T
    rows[:] = 0
    return buffer[: len(rows)]


KINDS = {
    "function": lambda path: lambda rows: rows @ GAIN.T,
    "list": lambda path: lambda rows: (rows @ GAIN.T).tolist(),
    "own buffer": lambda path: own_buffer,
    "predict": lambda path: Predicts(),
    "module": lambda path: Module(),
    "onnx": lambda path: mlp_onnx(path / "expert.onnx"),
    "onnx, batch 1": lambda path: mlp_onnx(path / "expert.onnx", batch=1),
    "onnx, float16": lambda path: mlp_onnx(path / "expert.onnx", kind=TensorProto.FLOAT16),
    "onnx, float64": lambda path: mlp_onnx(path / "expert.onnx", kind=TensorProto.DOUBLE),
}


@pytest.mark.fault(28, 29, 49, 55, 56)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_keeps_the_contract(kind, tmp_path, rows):
    expert = load_expert(KINDS[kind](tmp_path), 5, 2)
    before = rows.copy()
    answers = expert.ask(rows, "probe")
    again = expert.ask(rows, "label")
    assert answers.dtype == np.float32
    assert answers.shape == (37, 2)
    assert np.array_equal(answers, again)
    assert np.array_equal(rows, before)
    alone = np.concatenate([expert.ask(row[None], "act") for row in rows])
    assert np.allclose(answers, alone, atol=1e-6)
    assert expert.queries == {"probe": 37, "label": 37, "act": 37}
    assert load_expert(expert).queries == {}


@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_chunks_do_not_change_the_answers(chunk, tmp_path, rows):
    whole = load_expert(mlp_onnx(tmp_path / "e.onnx"), 5, 2).ask(rows, "probe")
    parts = load_expert(mlp_onnx(tmp_path / "e.onnx"), 5, 2, batch=chunk).ask(rows, "probe")
    assert np.array_equal(whole, parts)


def test_a_linear_experts_jacobian_is_exact(rows):
    probes = (
        replace(PRESETS["standard"], calibrated=False)
        .complete(Probes.parse("basis"))
        .with_order(1)
    )
    expert, scales = load_expert(lambda x: x @ GAIN.T), measure_scales(rows)
    answers = ask_probes(expert, Surroundings.of(rows, probes, scales), np.random.default_rng(0))
    steps = answers.displacements.sum(axis=1)
    jacobian = (answers.values[:, :, 0] - expert.ask(rows, "label")[:, None]) / steps[:, None]
    assert np.allclose(jacobian, GAIN.T, atol=2e-5)


# --- ONNX files as users have them


@pytest.mark.parametrize("names", [("obs", "actions"), ("input.1", "53"), ("x", "x_out")])
def test_any_names(names, tmp_path, rows):
    expert = load_expert(mlp_onnx(tmp_path / "e.onnx", names=names), 5, 2)
    assert expert.ask(rows, "act").shape == (37, 2)


@pytest.mark.fault(32)
def test_a_fixed_batch_is_freed_without_a_warning(tmp_path, rows):
    free = load_expert(mlp_onnx(tmp_path / "a.onnx"), 5, 2)
    fixed = load_expert(mlp_onnx(tmp_path / "b.onnx", batch=1), 5, 2)
    eight = load_expert(mlp_onnx(tmp_path / "c.onnx", batch=8), 5, 2)
    assert np.array_equal(free.ask(rows, "act"), fixed.ask(rows, "act"))
    assert np.array_equal(free.ask(rows, "act"), eight.ask(rows, "act"))


@pytest.mark.fault(32)
def test_a_batch_that_can_not_be_freed_is_asked_in_turn_with_a_warning(tmp_path, rows):
    free = load_expert(mlp_onnx(tmp_path / "a.onnx"), 5, 2)
    path = mlp_onnx(tmp_path / "b.onnx", batch=1, reshape_to=[1, 5])
    with pytest.warns(FdtasilWarning, match=r"1 row\(s\) at a time .* microseconds a row"):
        stubborn = load_expert(path, 5, 2)
    assert np.allclose(free.ask(rows, "act"), stubborn.ask(rows, "act"), atol=1e-6)


@pytest.mark.fault(26)
def test_the_output_is_chosen_by_shape(tmp_path, rows):
    path = mlp_onnx(tmp_path / "e.onnx", extra_outputs={"value": 1})
    expert = load_expert(path, 5, 2)
    assert np.array_equal(expert.ask(rows, "act"), load_expert(path, 5, output="actions").ask(rows, "act"))  # fmt: skip  # noqa: E501


@pytest.mark.fault(26, 27)
def test_an_unclear_output_is_listed_and_can_be_named(tmp_path, rows):
    path = mlp_onnx(tmp_path / "e.onnx", extra_outputs={"log_std": 2})
    with pytest.raises(ExpertError, match=r"actions float .* log_std float") as error:
        load_expert(path, 5, 2)
    assert "output=" in str(error.value)
    assert load_expert(path, 5, 2, output="log_std").ask(rows, "act").shape == (37, 2)
    with pytest.raises(ExpertError, match="no output 'mean'"):
        load_expert(path, 5, 2, output="mean")


@pytest.mark.fault(14, 15)
def test_weights_in_a_side_file(tmp_path, rows):
    whole = load_expert(mlp_onnx(tmp_path / "whole.onnx"), 5, 2)
    split = load_expert(mlp_onnx(tmp_path / "split.onnx", external="split.weights"), 5, 2)
    assert np.array_equal(whole.ask(rows, "act"), split.ask(rows, "act"))
    (tmp_path / "split.weights").rename(tmp_path / "renamed.weights")
    with pytest.raises(ExpertError, match=r"split\.weights"):
        load_expert(tmp_path / "split.onnx", 5, 2)


def test_a_side_file_outside_the_folder_is_refused(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    path = mlp_onnx(inner / "e.onnx", external="weights")
    model = onnx.load(path, load_external_data=False)
    for tensor in model.graph.initializer:
        next(
            entry for entry in tensor.external_data if entry.key == "location"
        ).value = "../weights"
    (inner / "weights").rename(tmp_path / "weights")
    onnx.save(model, path)
    with pytest.raises(ExpertError, match=r"\.\./weights"):
        load_expert(path, 5, 2)


@pytest.mark.fault(3, 5, 6, 7, 8)
@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "0 bytes"),
        (b"<!DOCTYPE html>", "HTML"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git-LFS pointer"),
        (b"\x80\x04K\x01.", "pickle"),
        (b"PK\x03\x04zip", "zip"),
        (b"no model at all", "no whole ONNX model"),
    ],
)
def test_other_files_are_named_for_what_they_are(content, found, tmp_path):
    path = tmp_path / "expert.onnx"
    path.write_bytes(content)
    with pytest.raises(ExpertError, match=found):
        load_expert(path)


@pytest.mark.fault(1, 2, 4)
def test_missing_file_folder_and_truncated_file(tmp_path):
    with pytest.raises(ExpertError, match=r"can't be read"):
        load_expert(tmp_path / "none.onnx")
    with pytest.raises(ExpertError, match="is a folder"):
        load_expert(tmp_path)
    path = mlp_onnx(tmp_path / "e.onnx")
    path.write_bytes(path.read_bytes()[: os.path.getsize(path) * 9 // 10])
    with pytest.raises(ExpertError, match="no whole ONNX model"):
        load_expert(path)


@pytest.mark.fault(33)
def test_wrong_sizes(tmp_path):
    path = mlp_onnx(tmp_path / "e.onnx")
    with pytest.raises(ExpertError, match="wants 5 observations, the environment gives 17"):
        load_expert(path, 17, 2)
    with pytest.raises(ExpertError, match="0 outputs that could be the actions"):
        load_expert(path, 5, 3)


@pytest.mark.fault(25)
def test_a_policy_with_memory_is_refused(tmp_path):
    path = mlp_onnx(tmp_path / "e.onnx")
    model = onnx.load(path)
    model.graph.input.append(
        onnx.helper.make_tensor_value_info("state0", TensorProto.FLOAT, [1, 4])
    )
    onnx.save(model, path)
    with pytest.raises(ExpertError, match="2 inputs: obs"):
        load_expert(path, 5, 2)


@pytest.mark.fault(11)
def test_a_newer_opset_is_named(tmp_path):
    path = mlp_onnx(tmp_path / "e.onnx")
    model = onnx.load(path)
    model.opset_import[0].version = 99
    onnx.save(model, path)
    with pytest.raises(ExpertError, match="opset 99"):
        load_expert(path, 5, 2)


# --- the analytic twin


def test_the_twin_agrees_and_is_differentiable(tmp_path, rows):
    expert = load_expert(mlp_onnx(tmp_path / "e.onnx", sizes=(5, 16, 16, 2)), 5, 2)
    assert np.allclose(
        expert.module(torch.from_numpy(rows)).numpy(), expert.ask(rows, "check"), atol=1e-6
    )
    probes = PRESETS["standard"].complete(Probes.parse("jacobian")).with_order(1)
    around = Surroundings.of(rows, probes, measure_scales(rows))
    found = ask_probes(expert, around, np.random.default_rng(0))
    assert found.values.shape == (37, 5, 1, 2)
    assert "probe" not in expert.queries


def test_a_graph_without_a_twin_says_so(tmp_path, rows):
    expert = load_expert(mlp_onnx(tmp_path / "e.onnx", reshape_to=[-1, 5]), 5, 2)
    assert expert.module is None
    probes = PRESETS["standard"].complete(Probes.parse("jacobian")).with_order(1)
    with pytest.raises(ExpertError, match="can't be differentiated"):
        ask_probes(
            expert, Surroundings.of(rows, probes, measure_scales(rows)), np.random.default_rng(0)
        )


def test_what_the_actions_do_not_depend_on_is_no_part_of_the_twin(tmp_path, rows):
    path = mlp_onnx(tmp_path / "e.onnx", extra_outputs={"value": 1})
    model = onnx.load(path)
    (value,) = (node for node in model.graph.node if "value" in node.output)
    value.op_type = "Softsign"  # no operator of a twin
    onnx.save(model, path)
    expert = load_expert(path, 5, 2)
    found = expert.module(torch.from_numpy(rows)).numpy()
    assert np.allclose(found, expert.ask(rows, "check"), atol=1e-6)


# --- callables that misbehave


@pytest.mark.fault(57, 59)
@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (lambda rows: rows[:, 0], "shape"),
        (lambda rows: rows[:1, :2], "shape"),
        (lambda rows: rows[:, :3], "shape"),
        (lambda rows: np.full((len(rows), 2), np.nan), "not finite on 37 of 37"),
        (lambda rows: 1 / 0, "raised ZeroDivisionError"),
        (lambda rows: "text", "raised TypeError"),
    ],
)
def test_a_wrong_answer_is_described(answer, found, rows):
    with pytest.raises(ExpertError, match=found):
        load_expert(answer, 5, 2).ask(rows, "act")


def test_something_else_is_no_expert():
    with pytest.raises(ExpertError, match="type int"):
        load_expert(3)


def test_what_holds_an_expert_is_told_how_to_pass_it():
    class Others:
        def select_action(self, rows):
            return rows[:, :2]

    class Result:
        def __init__(self):
            self.student = torch.nn.Identity()

    with pytest.raises(ExpertError, match=r"pass its method, expert\.select_action"):
        load_expert(Others())
    with pytest.raises(ExpertError, match=r"result\.student"):
        load_expert(Result())


@pytest.mark.fault(53)
def test_a_predict_with_memory_is_refused(rows):
    class Recurrent(Predicts):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return observation @ GAIN.T, (np.zeros(3),)

    with pytest.raises(ExpertError, match="state beside its actions"):
        load_expert(Recurrent(), 5, 2).ask(rows, "act")
