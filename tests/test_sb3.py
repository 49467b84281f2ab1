"""Agents of stable-baselines3 answer as predict() does: as modules, as ONNX files, as experts."""

import runpy
import sys
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from conftest import QUICK
from sb3_agents import (
    ALGORITHMS,
    SHAPES,
    algorithm_class,
    answers,
    fresh_agent,
    make_agent,
    predict,
    save_agent,
    seeded,
    shake,
    states_for,
)
from stable_baselines3.common.torch_layers import FlattenExtractor

import fdtasil
from fdtasil.errors import SettingError
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.export import export_sb3
from fdtasil.files.onnx.model import read_model
from fdtasil.files.onnx.session import open_session, run_session

SHARED_AGENTS = Path(__file__).parents[2] / "shared" / "agents"
ACTIVATIONS = [
    *("CELU", "ELU", "GELU", "Hardswish", "Hardtanh", "Identity", "LeakyReLU", "Mish", "ReLU"),
    *("ReLU6", "SELU", "SiLU", "Sigmoid", "Softplus", "Softsign", "Tanh"),
]


@pytest.fixture
def save(tmp_path):
    return partial(save_agent, tmp_path)


def assert_answers_as_predict(agent, source, scale=1):
    states = scale * states_for(agent)
    assert np.abs(answers(read_agent(source), states) - predict(agent, states)).max() <= 1e-5


@pytest.mark.fault(46, 49)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("environment", ["Pendulum-v1", "Hopper-v5"])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_answers_as_predict(name, environment, shape, save):
    agent = make_agent(name, environment, shape)
    read = read_agent(save(agent))
    states = states_for(agent)
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5
    assert (read.algorithm, read.observation_size) == (name, states.shape[1])
    np.testing.assert_array_equal(read.action_low, agent.action_space.low)
    np.testing.assert_array_equal(read.action_high, agent.action_space.high)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_activations(name, activation, save):
    kwargs = {"net_arch": [9, 8], "activation_fn": getattr(torch.nn, activation)}
    agent = shake(fresh_agent(name, "Pendulum-v1", kwargs))
    assert_answers_as_predict(agent, save(agent))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        *[(name, {"normalize_images": False}) for name in ("SAC", "TD3", "PPO")],
        *[
            (name, {"features_extractor_class": FlattenExtractor})
            for name in ("SAC", "TD3", "PPO")
        ],
        *[(name, {"share_features_extractor": True}) for name in ("SAC", "TD3")],
        *[(name, {"share_features_extractor": False}) for name in ("PPO", "A2C")],
        *[(name, {"use_expln": True, "log_std_init": -1}) for name in ("SAC", "PPO")],
        *[(name, {"ortho_init": False, "full_std": False}) for name in ("PPO", "A2C")],
        *[(name, {"n_critics": 1}) for name in ("SAC", "TD3", "TQC")],
        ("TQC", {"n_quantiles": 5}),
        ("SAC", {"clip_mean": 0.1}),
        ("PPO", {"squash_output": False}),
        ("PPO", {"optimizer_class": torch.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}}),
    ],
)
def test_settings_that_the_actor_does_not_see(name, settings, save):
    agent = shake(fresh_agent(name, "Pendulum-v1", {"net_arch": [9, 8], **settings}))
    assert_answers_as_predict(agent, save(agent))


class Spaces(gymnasium.Env):
    """An environment of given spaces, which is never stepped."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


FREE = gymnasium.spaces.Box(-np.inf, np.inf, (3,))


@pytest.mark.parametrize("name", ["SAC", "TD3", "PPO"])
def test_unequal_bounds(name, save):
    space = gymnasium.spaces.Box(np.float32([-1 / 3, -2.5, -7]), np.float32([1e-7, 7, -1 / 7]))
    agent = make_agent(name, Spaces(FREE, space))
    source = save(agent)
    read = read_agent(source)
    np.testing.assert_array_equal(read.action_low, space.low)
    np.testing.assert_array_equal(read.action_high, space.high)
    actions = predict(agent, 10 * states_for(agent))
    for bound in (space.low, space.high):  # they are reached, so that they show
        assert np.isclose(actions, bound, atol=1e-3).any()
    assert_answers_as_predict(agent, source, scale=10)


def test_clipping_is_exact(save):
    space = gymnasium.spaces.Box(np.float32([-1 / 3, -2e5]), np.float32([1e-7, 7]))
    agent = make_agent("PPO", Spaces(FREE, space))
    states = 10 * states_for(agent)
    found = answers(read_agent(save(agent)), states)
    np.testing.assert_array_equal(found, predict(agent, states))


@pytest.mark.parametrize("kind", [np.float64, np.uint8])
def test_other_types_of_observations(kind, save):
    observations = gymnasium.spaces.Box(0, 255, (5,), kind)
    agent = make_agent("PPO", Spaces(observations, gymnasium.spaces.Box(-1, 1, (2,))))
    states = np.random.default_rng(0).integers(0, 256, (64, 5)).astype(kind)
    found = answers(read_agent(save(agent)), states.astype(np.float32))
    assert np.abs(found - predict(agent, states)).max() <= 1e-5


# ONNX files


@pytest.mark.parametrize(
    ("name", "environment"), [("SAC", None), ("TD3", "Hopper-v5"), ("PPO", "Hopper-v5")]
)
def test_onnx_answers_as_predict(name, environment, save, tmp_path):
    agent = make_agent(name, "Hopper-v5")
    source = save(agent)
    (tmp_path / "empty").mkdir()
    out = export_sb3(source, tmp_path / "empty" / "out.onnx", env=environment)
    assert list(out.parent.iterdir()) == [out]  # one file
    model, _ = read_model(out)
    for rows in (1, 37):
        states = states_for(agent, rows)
        found = run_session(open_session(model, "test"), "actions", states)
        assert np.abs(found - predict(agent, states)).max() <= 1e-5
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["algorithm"] == name
    assert metadata["source_sha256"] == read_agent(source).sha256
    assert metadata["observation_size"] == "11"
    assert metadata["action_high"] == "1.0, 1.0, 1.0"
    assert ("Hopper-v5" in metadata["compared_on"]) == (environment is not None)


@pytest.mark.skipif(not SHARED_AGENTS.is_dir(), reason="needs ../shared/agents")
@pytest.mark.parametrize("environment", ["HalfCheetah-v5", "Walker2d-v5"])
def test_trained_agents(environment, tmp_path):
    source = SHARED_AGENTS / f"{environment}.zip"
    out = export_sb3(source, tmp_path / "out.onnx", env=environment)
    with seeded():
        agent = algorithm_class("SAC").load(source, device="cpu", buffer_size=1)
    states = 3 * states_for(agent, 500)
    found = run_session(open_session(read_model(out)[0], "test"), "actions", states)
    assert np.abs(found - predict(agent, states)).max() <= 1e-5


def test_nothing_is_overwritten(save, tmp_path):
    source = save(make_agent("PPO"))
    content = source.read_bytes()
    for out in (source, tmp_path / "folder" / ".." / source.name, tmp_path):
        with pytest.raises(SettingError, match=r"own zip|is a folder"):
            export_sb3(source, out)
    assert source.read_bytes() == content


# As experts


def test_the_suffix_may_be_left_out(save):
    source = save(make_agent("PPO"))
    assert read_agent(str(source.with_suffix(""))).source == source


def test_an_agent_in_memory_is_not_a_zip(tmp_path):
    with pytest.raises(SettingError, match=r"type PPO") as caught:
        export_sb3(make_agent("PPO"), tmp_path / "out.onnx")
    assert "agent.save(" in caught.value.next_step


class Answers(torch.nn.Module):
    """Says three things when it is called, and an action when it is asked."""

    def forward(self, rows):
        return rows[:, :1], rows.sum(1, keepdim=True), rows.sum(1)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return 2 * observation[:, :1], None


@pytest.mark.parametrize("name", ["PPO", "A2C", "own"])
def test_a_module_that_says_more_than_actions_is_asked_by_predict(name):
    policy = Answers() if name == "own" else make_agent(name).policy
    states = np.random.default_rng(0).standard_normal((40, 3)).astype(np.float32)
    expected = policy.predict(states, deterministic=True)[0]
    found = fdtasil.load_expert(policy, 3, 1).ask(states, "act")
    assert np.abs(found - expected).max() <= 1e-5


def test_distill_takes_the_zip(save):
    agent = make_agent("SAC")
    source = save(agent)
    options = {**QUICK, "episodes": 1}
    result = fdtasil.distill(source, "Pendulum-v1", 2, **options)
    states = result.demonstrations.observations
    assert np.abs(result.demonstrations.actions - predict(agent, states)).max() <= 1e-5
    assert result.report["expert"]["sha256"] == read_agent(source).sha256


def test_export_from_a_shell(save, monkeypatch, capsys, tmp_path):
    (tmp_path / "vecnormalize.pkl").write_bytes(b"")
    source, out = save(make_agent("PPO")), tmp_path / "out.onnx"
    line = ["fdtasil", "export-sb3", str(source), "--out", str(out), "--env", "Pendulum-v1"]
    monkeypatch.setattr("sys.argv", line)
    from fdtasil.shell.main import main

    with pytest.raises(SystemExit):
        main()
    assert "--vecnormalize False" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", [*line, "--vecnormalize", "False"])
    main()
    assert capsys.readouterr().out == f"written: {out}\n"
    assert fdtasil.load_expert(out).action_size == 1


@pytest.mark.slow
def test_the_parity_table(monkeypatch, capsys):
    """A short version of what experts/parity.py shows of every algorithm."""
    script = str(Path(__file__).parents[1] / "experts" / "parity.py")
    short = ["--algorithms", "TD3", "PPO", "--environments", "Pendulum-v1", "--steps", "70"]
    monkeypatch.setattr("sys.argv", [script, *short])
    monkeypatch.setattr("sys.path", list(sys.path))
    with seeded(), pytest.raises(SystemExit, match=r"^0$"):
        runpy.run_path(script, run_name="__main__")
    table = capsys.readouterr().out
    assert table.count("| Pendulum-v1 |") == 8
    assert "has written: 0" in table
