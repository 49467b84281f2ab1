"""Files that are damaged, hostile or new: refused in few words, read no farther, within limits."""

import ctypes
import os
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from itertools import product

import numpy as np
import onnx
import pytest
from conftest import QUICK, TOY, mlp_onnx
from mutated_files import open_mutated
from onnx import TensorProto, helper, numpy_helper
from sb3_agents import make_agent, save_agent

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts import twin
from fdtasil.files.onnx import limits

pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((7, 5)).astype(np.float32)


def refused(source, **options):
    """Return the text of the error for an expert, after checking its form."""
    with pytest.raises(ExpertError) as caught:
        fdtasil.load_expert(source, 5, 2, **options)
    text = str(caught.value)
    assert len(text.splitlines()) == 3
    assert text.replace("\n", "").isprintable()
    return text


def edit(path, change):
    """Change the model of a file, whose weights may be elsewhere."""
    model = onnx.load(path, load_external_data=False)
    change(model)
    path.write_bytes(model.SerializeToString())
    return path


# --- newer or foreign files


@pytest.mark.fault(11)
def test_an_opset_that_is_too_new(tmp_path):
    def age(model):
        model.opset_import[0].version = 99

    text = refused(edit(mlp_onnx(tmp_path / "e.onnx"), age))
    assert "needs opset 99" in text
    assert "knows opset" in text
    assert "an older opset such as 17" in text


@pytest.mark.fault(12)
def test_an_ir_version_that_is_too_new(tmp_path):
    def age(model):
        model.ir_version = 99

    text = refused(edit(mlp_onnx(tmp_path / "e.onnx"), age))
    assert "IR 99" in text
    assert "knows IR" in text


@pytest.mark.fault(13)
def test_an_operator_of_a_library_is_named(tmp_path):
    def replace(model):
        model.graph.node[-1].op_type, model.graph.node[-1].domain = "FancyAct", "my.ops"
        model.opset_import.append(helper.make_opsetid("my.ops", 1))

    text = refused(edit(mlp_onnx(tmp_path / "e.onnx"), replace))
    assert "my.ops::FancyAct" in text
    assert "libraries of native code are never loaded" in text


def test_a_function_of_the_models_own_is_no_library(tmp_path, rows):
    def replace(model):
        body = [helper.make_node("Tanh", ["x"], ["y"])]
        opsets = [helper.make_opsetid("", 17)]
        model.functions.append(helper.make_function("mine", "F", ["x"], ["y"], body, opsets))
        model.graph.node[-1].op_type, model.graph.node[-1].domain = "F", "mine"
        model.opset_import.append(helper.make_opsetid("mine", 1))

    plain = fdtasil.load_expert(mlp_onnx(tmp_path / "plain.onnx")).ask(rows, "act")
    own = fdtasil.load_expert(edit(mlp_onnx(tmp_path / "e.onnx"), replace)).ask(rows, "act")
    np.testing.assert_allclose(own, plain, atol=1e-6)


@pytest.mark.fault(10)
def test_a_model_without_opsets(tmp_path):
    refused(edit(mlp_onnx(tmp_path / "e.onnx"), lambda model: model.ClearField("opset_import")))


@pytest.mark.fault(10)
def test_names_that_are_hostile_to_a_terminal(tmp_path):
    def rename(model):
        model.graph.output[0].name = model.graph.node[-1].output[0] = "\x1b[2J\n" * 9

    refused(edit(mlp_onnx(tmp_path / "e.onnx", sizes=(5, 8, 3)), rename))


@pytest.mark.fault(24)
@pytest.mark.parametrize("external", [None, "重み 1.bin"])
def test_a_path_in_many_scripts(external, tmp_path, rows):
    folder = tmp_path / "ünï çødé 路径"
    folder.mkdir()
    path = mlp_onnx(folder / "専門家 عربي.onnx", external=external)
    assert fdtasil.load_expert(path, 5, 2).ask(rows, "act").shape == (7, 2)
    assert str(path) in refused(path, output="none")


# --- a known hash


@pytest.mark.fault(9)
def test_a_resumed_run_refuses_a_file_with_another_bit(tmp_path):
    class Stop(Exception):
        pass

    def stop(event):
        raise Stop

    expert, folder = mlp_onnx(tmp_path / "e.onnx"), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, 2, out=folder, callback=stop, **QUICK)
    content = expert.read_bytes()
    weight = content.index(onnx.load(expert).graph.initializer[0].raw_data)
    flipped = bytearray(content)
    flipped[weight] ^= 1
    expert.write_bytes(flipped)
    fdtasil.load_expert(expert)  # nothing in the file says that it is another
    with pytest.raises(SettingError, match=r"expert_sha256 was \w{12}\.\.\., is \w{12}\."):
        fdtasil.distill(expert, TOY, 2, resume=folder, **QUICK)
    expert.write_bytes(content)
    assert fdtasil.distill(expert, TOY, 2, resume=folder, **QUICK).evaluation


@pytest.mark.fault(9, 14)
@pytest.mark.parametrize("place", ["initializer", "attribute"])
def test_the_hash_holds_the_side_files_of_every_tensor(place, tmp_path):
    path, side = mlp_onnx(tmp_path / "e.onnx"), tmp_path / "side"
    side.write_bytes(np.float32([0.25, 0.5]).tobytes())
    edit(path, partial(PLACES[place], location="side"))
    before = fdtasil.load_expert(path)
    side.write_bytes(np.float32([0.25, 0.75]).tobytes())
    after = fdtasil.load_expert(path)
    states = np.zeros((1, 5), np.float32)
    assert (after.ask(states, "act") - before.ask(states, "act")).ravel().tolist() == [0, 0.25]
    assert after.origin.sha256 != before.origin.sha256


# --- side files


def outside(location, **entries):
    """Return two numbers that are kept elsewhere."""
    tensor = TensorProto(name="c", data_type=TensorProto.FLOAT, dims=[2])
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, **entries}.items():
        tensor.external_data.add(key=key, value=str(value))
    return tensor


def add_to_actions(model, name):
    """Add a value to the actions, so that it shows in them."""
    (last,) = (node for node in model.graph.node if "actions" in node.output)
    last.output[0] = "before"
    model.graph.node.append(helper.make_node("Add", ["before", name], ["actions"]))


def as_initializer(model, **entries):
    model.graph.initializer.append(outside(**entries))
    add_to_actions(model, "c")


def as_attribute(model, **entries):
    model.graph.node.append(helper.make_node("Constant", [], ["c"], value=outside(**entries)))
    add_to_actions(model, "c")


def in_a_branch(model, **entries):
    constant = helper.make_node("Constant", [], ["c"], value=outside(**entries))
    output = [helper.make_tensor_value_info("c", TensorProto.FLOAT, [2])]
    branch = helper.make_graph([constant], "branch", [], output)
    model.graph.initializer.append(numpy_helper.from_array(np.array(True), "condition"))
    branches = {"then_branch": branch, "else_branch": branch}
    model.graph.node.append(helper.make_node("If", ["condition"], ["chosen"], **branches))
    add_to_actions(model, "chosen")


def in_a_branchs_initializer(model, **entries):
    in_a_branch(model, **entries)
    for attribute in model.graph.node[-2].attribute:
        del attribute.g.node[:]
        attribute.g.initializer.append(outside(**entries))


def in_a_function(model, **entries):
    constant = helper.make_node("Constant", [], ["y"], value=outside(**entries))
    opsets = [helper.make_opsetid("", 17)]
    model.functions.append(helper.make_function("mine", "F", [], ["y"], [constant], opsets))
    model.opset_import.append(helper.make_opsetid("mine", 1))
    model.graph.node.append(helper.make_node("F", [], ["c"], domain="mine"))
    add_to_actions(model, "c")


def as_sparse(model, **entries):
    sparse = model.graph.sparse_initializer.add(dims=[2])
    sparse.values.CopyFrom(outside(**entries))
    sparse.indices.CopyFrom(numpy_helper.from_array(np.array([0, 1]), "i"))
    add_to_actions(model, "c")


def for_training(model, **entries):
    model.training_info.add().algorithm.initializer.append(outside(**entries))


PLACES = {
    "initializer": as_initializer,
    "attribute": as_attribute,
    "branch": in_a_branch,
    "branch's initializer": in_a_branchs_initializer,
    "function": in_a_function,
    "sparse": as_sparse,
    "training": for_training,
}


@contextmanager
def read_of(path):
    """Yield a function that says whether the file was read since, whoever did it."""
    if sys.platform != "linux":
        pytest.skip("needs inotify")
    kernel = ctypes.CDLL(None, use_errno=True)
    handle = kernel.inotify_init1(os.O_NONBLOCK)
    assert handle >= 0
    assert kernel.inotify_add_watch(handle, os.fsencode(path), 1) >= 0  # IN_ACCESS

    def was_read():
        try:
            return bool(os.read(handle, 4096))
        except BlockingIOError:
            return False

    try:
        yield was_read
    finally:
        os.close(handle)


def link(how):
    """Return how a name beside the model comes to lead to the secret."""

    def make(secret, folder):
        how(secret, folder / "linked")
        return "linked"

    return make


def linked_folder(secret, folder):
    (folder / "linked").symlink_to(secret.parent, target_is_directory=True)
    return "linked/secret"


def link_inside(secret, folder):
    """Also a link that stays inside the folder is one."""
    (folder / "deep").mkdir()
    secret.replace(folder / "deep" / "secret")
    secret.symlink_to(folder / "deep" / "secret")
    (folder / "linked").symlink_to(folder / "deep" / "secret")
    return "linked"


ESCAPES = {
    "absolute": lambda secret, folder: str(secret),
    "dots": lambda secret, folder: "../secret",
    "dots inside": lambda secret, folder: "deep/../../secret",
    "dots to itself": lambda secret, folder: f"../{folder.name}/side",
    "symlink": link(lambda secret, name: name.symlink_to(secret)),
    "symlinked folder": linked_folder,
    "symlink inside": link_inside,
    "hard link": link(lambda secret, name: os.link(secret, name)),
    "NUL": lambda secret, folder: "side\0../secret",
    "backslashes": lambda secret, folder: "..\\secret",
    "URI": lambda secret, folder: f"file://{secret}",
    "memory": lambda secret, folder: "*/_ORT_MEM_ADDR_/*",
    "folder": lambda secret, folder: ".",
    "nothing": lambda secret, folder: "",
}


@pytest.mark.fault(17, 18)
def test_a_side_file_elsewhere_is_refused_and_not_read(tmp_path, figure):
    count = 0
    for escape, place in product(ESCAPES, PLACES):
        folder = tmp_path / str(count) / "models"
        folder.mkdir(parents=True)
        secret = folder.parent / "secret"
        secret.write_bytes(np.float32([7, 8]).tobytes())
        (folder / "side").write_bytes(secret.read_bytes())
        location = ESCAPES[escape](secret, folder)
        path = edit(mlp_onnx(folder / "e.onnx"), partial(PLACES[place], location=location))
        with read_of(secret) as was_read:
            assert "keeps weights in" in refused(path), (escape, place)
            assert not was_read(), (escape, place)
            secret.read_bytes()
            assert was_read()  # the watch is a real one
        count += 1
    figure("side files outside of the model's folder", f"{count} of {count} refused, none read")


@pytest.mark.fault(17)
def test_what_a_side_file_could_wait_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    path = edit(mlp_onnx(tmp_path / "e.onnx"), partial(as_initializer, location="pipe"))
    assert "no plain file" in refused(path)


@pytest.mark.fault(19)
@pytest.mark.parametrize("place", ["initializer", "attribute", "function"])
@pytest.mark.parametrize(
    "entries",
    [
        {"offset": 10**9},
        {"offset": -4},
        {"offset": 2**63},
        {"offset": 2**64 + 8},
        {"offset": "x"},
        {"offset": 4, "length": 8},
        {"length": 4},
        {"length": -1},
        {"length": 10**12},
        {"offset": 4},  # without a length: all that follows, which is too little
    ],
    ids=str,
)
def test_offsets_outside_of_the_side_file(entries, place, tmp_path):
    (tmp_path / "side").write_bytes(np.float32([7, 8]).tobytes())
    change = partial(PLACES[place], location="side", **entries)
    refused(edit(mlp_onnx(tmp_path / "e.onnx"), change))


@pytest.mark.fault(16)
def test_a_pair_that_was_renamed_names_the_file_that_it_wants(tmp_path):
    path = mlp_onnx(tmp_path / "old.onnx", external="old.onnx.data")
    path.replace(tmp_path / "new.onnx")
    (tmp_path / "old.onnx.data").replace(tmp_path / "new.onnx.data")
    text = refused(tmp_path / "new.onnx")
    assert "keeps weights in old.onnx.data" in text
    assert "under their old names" in text


@pytest.mark.fault(20)
def test_a_cache_of_links_as_the_hub_keeps_it(tmp_path, rows):
    """A file alone is read through its link; one with a side file is named with a way out."""
    blobs, snapshot = tmp_path / "blobs", tmp_path / "snapshots" / "1a2b"
    blobs.mkdir()
    snapshot.mkdir(parents=True)
    mlp_onnx(blobs / "aaaa")
    (snapshot / "whole.onnx").symlink_to(blobs / "aaaa")
    assert fdtasil.load_expert(snapshot / "whole.onnx").ask(rows, "act").shape == (7, 2)
    mlp_onnx(blobs / "bbbb", external="model.data")
    (blobs / "model.data").replace(blobs / "cccc")
    (snapshot / "model.onnx").symlink_to(blobs / "bbbb")
    (snapshot / "model.data").symlink_to(blobs / "cccc")
    assert "hf://org/repo/file" in refused(snapshot / "model.onnx")


@pytest.mark.fault(23)
@pytest.mark.parametrize("large", ["model", "side file"])
def test_more_than_two_gigabytes_are_refused_unread(large, tmp_path):
    """Files with holes: they take no room on the disk."""
    path, side = tmp_path / "e.onnx", tmp_path / "side"
    path, side = mlp_onnx(path), mlp_onnx(side)
    edit(path, partial(as_initializer, location="side"))
    try:
        os.truncate(path if large == "model" else side, 3 * 2**30)
    except OSError:
        pytest.skip("needs a file system with holes")
    start = time.monotonic()
    assert "3,221,225,472 bytes" in refused(path)
    assert time.monotonic() - start < 2


# --- memory and time


def graph(nodes, *constants):
    """Return a linear model of (batch, 5) -> (batch, 2) with more nodes; `z` is added to it."""
    weights = [numpy_helper.from_array(np.ones((5, 2), np.float32), "w")]
    weights += [numpy_helper.from_array(np.array(value), name) for name, value in constants]
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["y"]),
        *nodes,
        helper.make_node("Add", ["y", "z"], ["actions"]),
    ]
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])]
        for name, width in (("obs", 5), ("actions", 2))
    ]
    whole = helper.make_graph(nodes, "bomb", *ends, weights)
    return helper.make_model(whole, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def sum_of_many(count):
    """A constant of so many zeros, which a file names with eight bytes."""
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["many"]),
        helper.make_node("ReduceSum", ["many"], ["z"], keepdims=0),
    ]
    return graph(nodes, ("shape", np.array([count])))


def doubled(times, start):
    """A tensor that is put beside itself again and again."""
    pairs = [helper.make_node("Concat", [start] * 2, ["d0"], axis=0)]
    pairs += [
        helper.make_node("Concat", [f"d{k}"] * 2, [f"d{k + 1}"], axis=0) for k in range(times)
    ]
    total = helper.make_node("ReduceMean", [f"d{times}"], ["z"], keepdims=0)
    return graph([*pairs, total], ("one", np.ones((1, 1), np.float32)))


def repeated(times):
    """A loop that runs `times` times, times the largest observation."""
    value = partial(helper.make_tensor_value_info, shape=[])
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["going"]),
            helper.make_node("Neg", ["v"], ["negative"]),
        ],
        "body",
        [
            value("i", TensorProto.INT64),
            value("go", TensorProto.BOOL),
            value("v", TensorProto.FLOAT),
        ],
        [value("going", TensorProto.BOOL), value("negative", TensorProto.FLOAT)],
    )
    nodes = [
        helper.make_node("ReduceMax", ["obs"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "times"], ["product"]),
        helper.make_node("Cast", ["product"], ["trips"], to=TensorProto.INT64),
        helper.make_node("Loop", ["trips", "", "zero"], ["z"], body=body),
    ]
    return graph(nodes, ("times", np.float32(times)), ("zero", np.float32(0)))


def bomb(path, model):
    path.write_bytes(model.SerializeToString())
    assert path.stat().st_size < 5000
    return path


@pytest.mark.fault(21)
@pytest.mark.parametrize(
    "model",
    [
        sum_of_many(2 * 10**9),
        sum_of_many(10**12),
        sum_of_many(10**18),
        pytest.param(doubled(60, "one"), marks=pytest.mark.torture),
    ],
)
def test_a_small_file_that_unpacks_to_gigabytes(model, tmp_path):
    text = refused(bomb(tmp_path / "e.onnx", model))
    assert "takes more than the 4 GiB" in text or "can't be asked" in text


@pytest.mark.fault(21)
def test_a_model_within_the_memory_is_asked(tmp_path, rows):
    path = bomb(tmp_path / "e.onnx", sum_of_many(10**6))
    assert fdtasil.load_expert(path, 5, 2).ask(rows, "act").shape == (7, 2)


@pytest.mark.fault(21)
def test_a_twin_is_not_built_of_what_is_large(tmp_path, monkeypatch):
    """What onnxruntime can do within its limits, torch would keep all at once."""
    nodes = [helper.make_node("Concat", ["obs"] * 2, ["d0"], axis=1)]
    nodes += [helper.make_node("Concat", [f"d{k}"] * 2, [f"d{k + 1}"], axis=1) for k in range(12)]
    nodes.append(helper.make_node("Slice", ["d12", "zero", "two", "one", "one"], ["z"]))
    numbers = {"zero": [0], "one": [1], "two": [2]}
    path = bomb(tmp_path / "e.onnx", graph(nodes, *numbers.items()))
    assert fdtasil.load_expert(path, 5, 2).module is not None
    monkeypatch.setattr(twin, "_LARGEST", 10**6)  # 64 rows of 40,960 numbers are more
    assert fdtasil.load_expert(path, 5, 2).module is None
    assert fdtasil.load_expert(mlp_onnx(tmp_path / "mlp.onnx")).module is not None


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(limits, "CALL_SECONDS", 0.4)
    monkeypatch.setattr(limits, "_watcher", [])  # the usual one may be asleep for three seconds


@pytest.mark.fault(22)
def test_a_loop_that_does_not_end(tmp_path, rows, impatient):
    path = bomb(tmp_path / "e.onnx", repeated(1e9))
    expert = fdtasil.load_expert(path, 5, 2)  # asked about zeros it is quick
    start = time.monotonic()
    with pytest.raises(ExpertError, match=r"TimeoutError on 7 observations: one call took more than 0\.4 s"):  # fmt: skip  # noqa: E501
        expert.ask(np.abs(rows), "act")
    assert time.monotonic() - start < 10
    assert expert.ask(np.zeros((3, 5), np.float32), "act").shape == (3, 2)  # it is used on


@pytest.mark.fault(22)
def test_a_loop_that_does_not_end_in_a_recurrent_model(tmp_path, impatient):
    model, float32 = repeated(1e9), TensorProto.FLOAT
    entry, leaving = (
        helper.make_tensor_value_info(name, float32, [1, 1, 3]) for name in ("h_in", "h_out")
    )
    model.graph.input.append(entry)
    model.graph.output.append(leaving)
    model.graph.node.append(helper.make_node("Identity", ["h_in"], ["h_out"]))
    expert = fdtasil.load_expert(bomb(tmp_path / "e.onnx", model), 5, 2)
    assert expert.memory is not None
    start = time.monotonic()
    with pytest.raises(ExpertError, match=r"one call took more than 0\.4 s"):
        expert.ask(np.ones((1, 8), np.float32), "act")
    assert time.monotonic() - start < 10


@pytest.mark.fault(22)
def test_many_turns_in_time_are_no_fault(tmp_path, rows):
    path = bomb(tmp_path / "e.onnx", repeated(1e3))
    assert np.isfinite(fdtasil.load_expert(path, 5, 2).ask(rows, "act")).all()


def test_the_limits_cost_one_thread(tmp_path, rows):
    experts = [fdtasil.load_expert(mlp_onnx(tmp_path / f"{k}.onnx")) for k in range(5)]
    for expert in experts:
        expert.ask(rows, "act")
    names = [thread.name for thread in threading.enumerate()]
    assert names.count("fdtasil-limits") <= 3  # one more for each test that was impatient


# --- mutations


@pytest.fixture
def models(tmp_path):
    """Three small models: plain, with a fixed batch in float64, with a reshape in float16."""
    odd = {"sizes": (3, 4, 4, 1), "kind": TensorProto.DOUBLE, "batch": 1}
    return [
        mlp_onnx(tmp_path / "plain.onnx", sizes=(5, 16, 16, 2)),
        mlp_onnx(tmp_path / "odd.onnx", **odd),
        mlp_onnx(tmp_path / "half.onnx", kind=TensorProto.FLOAT16, reshape_to=[-1, 5]),
    ]


@pytest.fixture
def agents(tmp_path):
    return [save_agent(tmp_path, make_agent(name), f"{name}.zip") for name in ("PPO", "SAC")]


ENDINGS = {"refused", "same answers", "other answers", "not finite"}


def summary(outcomes):
    assert set(outcomes) <= ENDINGS, dict(outcomes)
    counts = [f"{outcomes[ending]:,} {ending}" for ending in sorted(ENDINGS)]
    return f"0 crashes, 0 hangs, 0 other exceptions; {', '.join(counts)}"


@pytest.mark.slow
@pytest.mark.fault(10)
@pytest.mark.parametrize("count", [200, pytest.param(12_000, marks=pytest.mark.torture)])
def test_mutated_models(count, models, figure):
    outcomes = open_mutated(models, count)
    found = summary(outcomes)
    if count > 1000:
        figure(f"{count:,} mutated ONNX files", found)
    assert outcomes["refused"] > 0.2 * count
    assert outcomes.total() == count


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, pytest.param(2_000, marks=pytest.mark.torture)])
def test_mutated_agents(count, agents, figure):
    outcomes = open_mutated(agents, count)
    found = summary(outcomes)
    if count > 1000:
        figure(f"{count:,} mutated stable-baselines3 zips", f"0 unpickled; {found}")
    assert outcomes["refused"] > 0.2 * count
    assert outcomes.total() == count
