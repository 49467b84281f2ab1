"""Experts of strangers: what they are is found out before they teach, and said plainly."""

import ast
import os
import pickle
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
import warnings
from contextlib import suppress
from functools import partial

import gymnasium
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from onnx import TensorProto, helper, numpy_helper
from sb3_agents import make_agent, predict, save_agent, seeded, shake, states_for

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, first_line, shown, without_secrets
from fdtasil.experts import http_expert, trial
from fdtasil.experts.sizes import size_hint
from fdtasil.rollouts.spaces import layout_of
from fdtasil.student.view import View
from fdtasil.testing import check_expert


@pytest.fixture
def rows():
    return np.random.default_rng(0).uniform(-1, 1, (40, 5)).astype(np.float32)


def error_of(source, *sizes, **options):
    with pytest.raises(ExpertError) as caught:
        fdtasil.load_expert(source, *sizes, **options)
    assert len(str(caught.value).splitlines()) <= 6
    return caught.value


def linear_by_name(rows):
    return rows @ GAIN.T


# --- what stands beside an agent


def trained_in(*wrappers):
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    environments = make_vec_env("Pendulum-v1", n_envs=1, seed=0)
    for wrapper in wrappers:
        environments = wrapper(environments)
    with seeded():
        return shake(PPO("MlpPolicy", environments, device="cpu")), environments


@pytest.mark.fault(150)
def test_an_agent_brings_its_vecnormalize():
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    agent, environments = trained_in(VecNormalize, VecMonitor)
    statistics = environments.venv.obs_rms
    statistics.mean, statistics.var = np.array([0.5, -0.2, 3.0]), np.array([0.1, 2.0, 9.0])
    states = states_for(agent)
    expected = predict(agent, environments.venv.normalize_obs(states))
    assert not np.allclose(expected, predict(agent, states))
    found = fdtasil.load_expert(agent, 3, 1)
    assert np.allclose(found.ask(states, "act"), expected, atol=1e-6)
    again = pickle.loads(pickle.dumps(found))
    assert np.allclose(again.ask(states, "act"), expected, atol=1e-6)
    environments.venv.norm_obs = False
    plain = fdtasil.load_expert(agent, 3, 1)
    assert np.allclose(plain.ask(states, "act"), predict(agent, states), atol=1e-6)


@pytest.mark.fault(150)
def test_an_agent_of_other_wrappers_is_refused():
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

    stacked = partial(VecFrameStack, n_stack=3)
    agent, _ = trained_in(stacked)
    error = error_of(agent, 9, 1)
    assert "VecFrameStack makes" in error.found
    assert error.next_step.endswith("and pass agent.policy")
    error = error_of(trained_in(VecNormalize, stacked)[0], 9, 1)
    assert "VecNormalize does" in error.next_step
    assert error.next_step.endswith("and pass agent.policy")


@pytest.mark.fault(283)
def test_the_advice_to_an_agent_of_stacked_frames_keeps_its_vecnormalize():
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

    agent, environments = trained_in(partial(VecFrameStack, n_stack=3), VecNormalize)
    environments.seed(0)
    environments.reset()
    statistics = environments.obs_rms
    statistics.mean, statistics.var = np.linspace(-1, 1, 9), np.linspace(0.1, 9, 9)
    error = error_of(agent, 9, 1)
    single = gymnasium.wrappers.FrameStackObservation(
        gymnasium.make("Pendulum-v1"), 3, padding_type="zero"
    )
    single = gymnasium.wrappers.FlattenObservation(single)
    row = environments.get_original_obs()
    assert single.reset(seed=0)[0] == pytest.approx(row[0])
    expected = predict(agent, environments.normalize_obs(row))
    asks = evaluated(error, agent=agent)
    assert asks(row) == pytest.approx(expected, abs=1e-6)
    assert not np.allclose(predict(agent, row), expected)


# --- batches and time


def only_few(rows):
    answers = np.zeros((len(rows), 2), np.float32)
    answers[:64] = 0.3 + rows[:64] @ GAIN.T
    return answers


@pytest.mark.fault(151)
def test_a_batch_as_large_as_the_probes_is_asked(nothing_is_trained):
    with pytest.raises(ExpertError, match="observations at once otherwise than few") as caught:
        fdtasil.distill(only_few, TOY, 3, **QUICK)
    step = re.search(r"load_expert\(\.\.\., batch=(\d+)\)", caught.value.next_step)
    assert step is not None
    findings = check_expert(fdtasil.load_expert(only_few, batch=int(step[1])), TOY)
    assert not [one.name for one in findings if one.problem and one.name != "return"]
    names = [one.name for one in check_expert(only_few, TOY) if one.problem]
    assert "large batches" in names


@pytest.mark.fault(151)
def test_an_expert_that_refuses_large_batches_is_found_first(nothing_is_trained):
    def choosy(rows):
        if len(rows) > 100:
            raise MemoryError("too many rows")
        return rows @ GAIN.T

    with pytest.raises(ExpertError, match="too many rows") as caught:
        fdtasil.distill(choosy, TOY, 3, force=True, **QUICK)
    assert "batch=16" in caught.value.next_step


class Tired:
    """Changes after so many calls."""

    __name__ = "tired"

    def __init__(self, calls, change):
        self.left, self.change = calls, change

    def __call__(self, rows):
        self.left -= 1
        return rows @ GAIN.T + (self.change if self.left < 0 else 0)


@pytest.mark.fault(152)
@pytest.mark.filterwarnings("default::fdtasil.errors.FdtasilWarning")
def test_an_expert_that_changes_is_found_at_the_end():
    calls = Tired(10**9, 0)
    quiet = fdtasil.distill(calls, TOY, 1, **QUICK)
    assert not quiet.report["warnings"]
    asked = 10**9 - calls.left
    with pytest.warns(FdtasilWarning, match="has changed during the run"):
        result = fdtasil.distill(Tired(asked - 2, 0.01), TOY, 1, **QUICK)
    assert any("differ by up to 0.01" in note for note in result.report["warnings"])
    assert result.queries == result.report["predicted_queries"]
    with pytest.warns(FdtasilWarning, match="do not rely on this student"):
        fdtasil.distill(Tired(asked - 2, 5.0), TOY, 1, **QUICK)


# --- functions and modules of users


@pytest.mark.fault(153)
def test_a_view_may_work_in_place(rows):
    def view(given):
        given[:, 2] /= 8
        return given

    kept = rows.copy()
    found = View.of(view, rows)
    seen = found.look(rows)
    assert np.array_equal(rows, kept)
    assert np.array_equal(seen[:, 2], kept[:, 2] / 8)


@pytest.mark.fault(154)
@pytest.mark.parametrize("kind", ["onnx", "fixed", "module", "agent", "function", "zip", "http"])
def test_opened_experts_go_to_other_processes(kind, rows, tmp_path):
    with torch.random.fork_rng():
        module = torch.nn.Linear(5, 2)
    agent = make_agent("PPO")
    sources = {
        "onnx": lambda: mlp_onnx(tmp_path / "e.onnx"),
        "fixed": lambda: mlp_onnx(tmp_path / "f.onnx", batch=1),
        "module": lambda: module,
        "agent": lambda: agent,
        "function": lambda: linear_by_name,
        "zip": lambda: save_agent(tmp_path, agent),
        "http": lambda: "http://127.0.0.1:9/act?key=1",
    }
    expert = fdtasil.load_expert(sources[kind]())
    again = pickle.loads(pickle.dumps(expert))
    assert again.name == expert.name
    if kind != "http":
        states = states_for(agent) if kind in ("agent", "zip") else rows
        assert np.array_equal(again.ask(states, "act"), expert.ask(states, "act"))
    if expert.module is not None and kind == "onnx":
        assert torch.equal(again.module(torch.ones(1, 5)), expert.module(torch.ones(1, 5)))


@pytest.mark.fault(154)
def test_an_expert_with_workers_says_that_it_stays():
    expert = fdtasil.load_expert(linear_by_name, workers=1, threads=True)
    with pytest.raises(ExpertError, match="can't be sent to another process"):
        pickle.dumps(expert)


class Locked(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer, self.lock = torch.nn.Linear(5, 2), threading.Lock()
        self.layers = [self.layer]

    def forward(self, rows):
        with self.lock:
            return self.layers[0](rows)


class Remembers(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(5, 2)
        self.last = {"output": self.layer(torch.zeros(1, 5))}

    def forward(self, rows):
        self.last["output"] = self.layer(rows)
        return self.last["output"]


def normed():
    layer = torch.nn.utils.weight_norm(torch.nn.Linear(5, 2))
    layer(torch.zeros(1, 5))
    return torch.nn.Sequential(layer, torch.nn.Tanh())


@pytest.mark.fault(155)
@pytest.mark.parametrize("make", [Locked, Remembers, normed])
@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_modules_that_deepcopy_can_not_take(make, rows):
    with torch.random.fork_rng():
        module = make()
    before = module(torch.from_numpy(rows)).detach().numpy()
    expert = fdtasil.load_expert(module, 5, 2)
    assert np.allclose(expert.ask(rows, "act"), before)
    with torch.no_grad():  # the caller's goes on training
        for weight in module.parameters():
            weight.add_(1.0)
    assert module.training
    assert np.allclose(expert.ask(rows, "act"), before)


@pytest.mark.fault(155)
def test_a_gsde_agent_works_after_the_advice_of_its_error(tmp_path):
    agent = make_agent("SAC", use_sde=True)
    path = save_agent(tmp_path, agent)
    assert 'trust="pickle"' in error_of(path).next_step
    expert = fdtasil.load_expert(path, trust="pickle")
    states = states_for(agent)
    assert np.allclose(expert.ask(states, "act"), predict(agent, states), atol=1e-5)
    again = fdtasil.load_expert(expert.module, 3, 1)
    assert np.allclose(again.ask(states, "act"), predict(agent, states), atol=1e-5)


# --- what leaves, and what reaches a terminal


@pytest.mark.slow
@pytest.mark.fault(156)
def test_an_empty_home_stays_empty(tmp_path):
    path, home = mlp_onnx(tmp_path / "e.onnx"), tmp_path / "home"
    home.mkdir()
    code = f"""
import numpy as np, os, fdtasil
expert = fdtasil.load_expert({str(path)!r}, workers=1)
expert.ask(np.zeros((3, 5), np.float32), "act")
print(os.environ["ORT_DISABLE_TELEMETRY"])
"""
    kept = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY"}
    run = partial(subprocess.run, [sys.executable, "-c", code], capture_output=True, text=True)
    shown_ = run(env=kept | {"HOME": str(home), "XDG_CACHE_HOME": str(home)}, check=True)
    assert shown_.stdout.split() == ["1"]
    assert not list(home.rglob("*"))


@pytest.mark.fault(157)
def test_addresses_are_shown_without_secrets(capsys):
    for address in ("http://me:word@host/act", "http://host/act?key=word", "http://me:word?x@h"):
        assert "word" not in without_secrets(address)
    for address in (
        "http://me:word@[::1",
        "http://h:word",
        "http://h:word?key=word",
        "http:word@",
    ):
        error = error_of(address)
        assert "key" not in str(error)
        assert "me:word" not in str(error)
    assert fdtasil.load_expert("http://127.0.0.1/act?key=word").name == "http://127.0.0.1/act"


@pytest.mark.fault(157)
def test_a_file_that_holds_a_key_is_private(inside, tmp_path, monkeypatch):
    from fdtasil.shell import distill as shell

    modes = []

    def stop(arguments):
        modes.append((tmp_path / "run" / "command.json").stat().st_mode & 0o777)
        raise KeyboardInterrupt

    monkeypatch.setattr(shell, "distil", stop)
    for address in ("http://127.0.0.1:9/act?api_key=word", "e.onnx"):
        inside("distill", address, TOY, "--out", tmp_path / "run")
    assert modes[0] == 0o600
    assert modes[1] & 0o044


class Unspeakable(Exception):
    def __str__(self):
        raise RuntimeError("no words")


@pytest.mark.fault(158)
def test_no_text_from_outside_moves_a_terminal(rows):
    assert shown("a\x1b[2J\r\u202e") == "a?[2J??"
    assert "Unspeakable" in first_line(Unspeakable())

    def rude(given):
        raise ValueError("\x1b[2J\x07")

    def silent(given):
        raise Unspeakable

    for function in (rude, silent):
        with pytest.raises(ExpertError) as caught:
            fdtasil.load_expert(function).ask(rows, "act")
        assert str(caught.value).replace("\n", "").isprintable()
    assert "\x1b" not in str(ExpertError("\x1b[2J", "x", "y"))


# --- files that end a process


def graph(nodes, *constants, output=("batch", 2), inputs=(("obs", 5),)):
    weights = [numpy_helper.from_array(np.full((5, 2), 0.1, np.float32), "w")]
    weights += [numpy_helper.from_array(np.asarray(value), name) for name, value in constants]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in inputs
    ]
    out = helper.make_tensor_value_info("actions", TensorProto.FLOAT, list(output))
    whole = helper.make_graph(list(nodes), "strange", ends, [out], weights)
    return helper.make_model(whole, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def divided():
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["y"]),
        helper.make_node("Div", ["least", "minus"], ["q"]),
        helper.make_node("Cast", ["q"], ["z"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["y", "z"], ["actions"]),
    ]
    return graph(nodes, ("least", np.int32([-(2**31)])), ("minus", np.int32([-1])))


def squared(times):
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["y"]),
        helper.make_node("Expand", ["one", "shape"], ["e0"]),
        *(helper.make_node("MatMul", [f"e{k}"] * 2, [f"e{k + 1}"]) for k in range(times)),
        helper.make_node("ReduceSum", [f"e{times}"], ["z"], keepdims=0),
        helper.make_node("Add", ["y", "z"], ["actions"]),
    ]
    return graph(nodes, ("one", np.float32([[1]])), ("shape", np.int64([3000, 3000])))


def written(path, model):
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.fault(159)
def test_a_file_that_ends_its_process_is_refused(tmp_path, monkeypatch):
    path = written(tmp_path / "e.onnx", divided())
    assert "was killed by SIGFPE" in error_of(path).found
    monkeypatch.setattr(trial, "_SECONDS", 2.0)
    start = time.monotonic()
    endless = written(tmp_path / "s.onnx", squared(300))
    assert "took more than 2 s" in error_of(endless).found
    assert time.monotonic() - start < 20


@pytest.mark.fault(159)
def test_what_passed_is_not_tried_again(tmp_path, monkeypatch):
    path = mlp_onnx(tmp_path / "e.onnx", scale=1.7)
    tried = []
    monkeypatch.setattr(trial, "in_a_process", lambda *_: tried.append(1))
    for _ in range(3):
        fdtasil.load_expert(path)
    assert tried == [1]


# --- servers


def talking(say):
    """Serve one connection by `say(connection)`, in a thread; return both."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        with server:
            connection, _ = server.accept()
            with connection, suppress(OSError):
                say(connection)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return f"http://127.0.0.1:{server.getsockname()[1]}/", thread


def dripping(first, part):
    def say(connection):
        connection.recv(10**6)
        connection.sendall(first)
        while True:
            connection.sendall(part)
            time.sleep(0.05)

    return say


DRIPS = {
    "continue": (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "headers": (b"HTTP/1.1 200 OK\r\n", b"X"),
    "extension": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n1;", b"x"),
    "trailer": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n", b"A"),
    "body": (b"HTTP/1.1 200 OK\r\nContent-Length: 9000\r\n\r\n", b" "),
    "closing": (b"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: 9000\r\n\r\n", b" "),
    "older": (b"HTTP/1.0 200 OK\r\n\r\n", b" "),
}


@pytest.mark.slow
@pytest.mark.fault(160)
@pytest.mark.parametrize("drip", DRIPS)
def test_the_timeout_is_for_the_whole_exchange(drip, rows):
    address, _ = talking(dripping(*DRIPS[drip]))
    start = time.monotonic()
    with pytest.raises(ExpertError, match=r"gave no answer within 0\.5 s"):
        fdtasil.load_expert(address, timeout=0.5).ask(rows[:2], "act")
    assert time.monotonic() - start < 5


def answer_of(number):
    body = b'{"actions": [[%d]]}' % number
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body


@pytest.mark.fault(161)
@pytest.mark.parametrize("late", [0.0, 0.2])
def test_two_answers_to_one_request_are_an_error(late, rows, monkeypatch):
    monkeypatch.setattr(http_expert, "_PAUSES", (0.01,))

    def say(connection):
        connection.recv(10**6)
        connection.sendall(answer_of(1))
        time.sleep(late)
        connection.sendall(answer_of(2))
        connection.recv(10**6)

    address, _ = talking(say)
    expert = fdtasil.load_expert(address, timeout=2)

    def ask_twice():
        expert.ask(rows[:1], "act")
        time.sleep(0.5)
        expert.ask(rows[:1], "act")

    with pytest.raises(ExpertError, match="more than one answer"):
        ask_twice()


# --- causes and next steps


def evaluated(error, **names):
    """Return what the expression in an error's next step is worth when it is typed."""
    step = error.next_step
    code = step.partition("expert = ")[2] or step.partition(": ")[2]
    setup = re.search(r"session = ([^;]+);", step)
    known = {"onnxruntime": onnxruntime, "torch": torch, "np": np, "gymnasium": gymnasium} | names
    if setup:
        known["session"] = eval(setup[1], known)
    return eval(code, known)


@pytest.mark.fault(162)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_torchscript_file_is_named(tmp_path, rows):
    with torch.random.fork_rng():
        module = torch.nn.Linear(5, 2)
    path = tmp_path / "policy.pt"
    torch.jit.script(module).save(path)
    error = error_of(path)
    assert "TorchScript" in error.found
    expert = fdtasil.load_expert(evaluated(error), 5, 2)
    assert np.allclose(expert.ask(rows, "act"), module(torch.from_numpy(rows)).detach())
    torch.save(module.state_dict(), path)
    assert "torch.save" in error_of(path).found
    np.savez(tmp_path / "d.npz", rows)
    assert "numpy arrays" in error_of(tmp_path / "d.npz").found


def summed(first, second):
    nodes = [
        helper.make_node("Concat", [first, second], ["obs"], axis=1),
        helper.make_node("MatMul", ["obs", "w"], ["actions"]),
    ]
    return graph(nodes, inputs=((first, 2), (second, 3)))


@pytest.mark.fault(163)
def test_several_inputs_are_parts_of_an_observation_or_a_memory(tmp_path, rows):
    error = error_of(written(tmp_path / "e.onnx", summed("position", "command")), 5, 2)
    assert "memory" not in str(error)
    (said,) = re.findall(r"inputs=({.*?})", error.next_step)
    expert = fdtasil.load_expert(tmp_path / "e.onnx", 5, 2, inputs=ast.literal_eval(said))
    assert np.allclose(expert.ask(rows, "act"), rows @ np.full((5, 2), 0.1), atol=1e-6)


@pytest.mark.fault(163)
def test_one_number_a_row_is_named(tmp_path, rows):
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["y"]),
        helper.make_node("Gather", ["y", "zero"], ["actions"], axis=1),
    ]
    model = graph(nodes, ("zero", np.int64(0)), output=("batch",))
    error = error_of(written(tmp_path / "e.onnx", model), 5, 1)
    assert "with shape (2,)" in error.found
    expert = fdtasil.load_expert(evaluated(error), 5, 1)
    assert np.allclose(expert.ask(rows, "act")[:, 0], rows.sum(axis=1) * 0.1, atol=1e-6)


@pytest.mark.fault(163)
def test_memory_behind_a_function_is_not_called_noise_alone():
    state = np.zeros(2)

    def remembers(rows):
        state[:] = 0.5 * state + (rows @ GAIN.T).mean(axis=0)
        return rows @ GAIN.T + state

    with pytest.raises(ExpertError, match="asked twice differs") as caught:
        fdtasil.distill(remembers, TOY, 1, **QUICK)
    assert "memory" in caught.value.expected
    assert "--force" in caught.value.next_step


class Spaces(gymnasium.Env):
    observation_space = gymnasium.spaces.Dict(
        {
            "a": gymnasium.spaces.Box(-1, 1, (2,), np.float32),
            "b": gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8),
        }
    )
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._drawn(), {}

    def step(self, action):
        return self._drawn(), 0.0, False, False, {}

    def _drawn(self):
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample()


class Pictures(Spaces):
    observation_space = gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8)


class Square(Spaces):
    observation_space = gymnasium.spaces.Box(-1, 1, (2, 2), np.float32)
    action_space = gymnasium.spaces.MultiBinary(2)


NOT_READ = {
    "MultiInputPolicy": (Spaces, r"Dict .*36, 36", {"probes": 0}),
    "CnnPolicy": (Pictures, "images", {"probes": 0}),
    "MlpPolicy": (Square, r"MultiBinary.* of shape \[2\]", {}),
}


@pytest.mark.fault(163)
@pytest.mark.filterwarnings("ignore::fdtasil.errors.FdtasilWarning")  # rewards are all zero
@pytest.mark.parametrize("policy", NOT_READ)
def test_an_agent_that_is_not_read_is_asked_as_its_error_says(policy, tmp_path):
    from stable_baselines3 import PPO

    environment, reason, options = NOT_READ[policy]
    with seeded():
        path = save_agent(tmp_path, PPO(policy, environment(), device="cpu"))
        agent = PPO.load(path, device="cpu")
        trained = PPO(policy, environment(), device="cpu")  # still in its environment
    error = error_of(path)
    assert re.search(reason, error.found)
    step = "load it with its own library, and pass the agent itself: distill(agent, env)"
    assert error.next_step == step + " with probes=0" * bool(options)
    for one in (agent, trained):
        result = fdtasil.distill(one, environment, **options, **{**QUICK, "horizon": 5})
        states = result.demonstrations.observations
        layout = layout_of(environment.observation_space, "observations")
        expected = one.predict(layout.values(states), deterministic=True)[0]
        found = result.demonstrations.actions
        if policy == "MlpPolicy":  # scores of no and yes
            found = found[:, 1::2] > found[:, ::2]
        assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.fault(164)
def test_a_steep_agent_is_exported(tmp_path, rows):
    """Large values inside, and small actions: float32 rounds more than the fifth digit."""
    from fdtasil.files.onnx.export import export_module

    with torch.random.fork_rng():
        torch.manual_seed(0)
        layers = [torch.nn.Linear(5, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2), torch.nn.Tanh()]
    with torch.no_grad():
        layers[2].weight.mul_(3000)
    module = torch.nn.Sequential(*layers)
    model = onnx.load_model_from_string(export_module(module, rows, {}))
    assert model.graph.node


@pytest.mark.fault(165)
@pytest.mark.parametrize("said", ["pickle", "False"])
def test_the_command_for_statistics_works(said, tmp_path, inside):
    from stable_baselines3.common.vec_env import VecNormalize

    agent, environments = trained_in(VecNormalize)
    folder = tmp_path / "with spaces"
    folder.mkdir()
    path = save_agent(folder, agent)
    environments.save(folder / "vec_normalize.pkl")
    error = error_of(path)
    assert "vecnormalize=" not in str(error).replace("--vecnormalize", "")
    command = error.next_step.partition(" (or")[0].removeprefix("fdtasil ")
    words = shlex.split(command)
    if said == "False":
        words = [*words[: words.index("--vecnormalize")], "--vecnormalize", "False"]
    done = inside(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert fdtasil.load_expert(tmp_path / "agent.onnx", 3, 1)


@pytest.mark.fault(165)
def test_inspect_takes_trust(tmp_path, inside):
    path = save_agent(tmp_path, make_agent("SAC", use_sde=True))
    line = ["inspect", path, "Pendulum-v1", "--episodes", "2", "--horizon", "20"]
    assert inside(*line).returncode == 1
    assert inside(*line, "--trust", "pickle").returncode == 0


@pytest.mark.fault(166)
def test_a_size_says_what_it_may_come_from():
    assert "TimeAwareObservation" in size_hint(12, 11)
    assert "Ant-v5 105" in size_hint(27, 105)
    assert "3 stacked" in size_hint(33, 11)
    assert "Ant" not in size_hint(7, 5) + size_hint(11, 12) + size_hint(40, 7)


@pytest.mark.fault(167)
def test_a_worker_that_ends_by_itself_is_not_called_killed(rows):
    def leaves(given):
        import os
        import time
        from contextlib import suppress

        os.close(1)
        for descriptor in range(3, 64):
            with suppress(OSError):
                os.close(descriptor)
        time.sleep(0.3)
        os._exit(7)

    with pytest.raises(ExpertError, match="ended with exit code 7") as caught:
        fdtasil.load_expert(leaves, workers=1).ask(rows, "act")
    assert "memory" not in str(caught.value)


@pytest.mark.fault(168)
def test_our_files_can_be_quantised(quick, tmp_path, rows):
    from onnxruntime.quantization import quantize_dynamic

    source, target = quick.to_onnx(tmp_path / "s.onnx"), tmp_path / "q.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quantize_dynamic(source, target)
    session = onnxruntime.InferenceSession(target.read_bytes())
    assert session.run(None, {"obs": rows})[0].shape == (40, 2)
