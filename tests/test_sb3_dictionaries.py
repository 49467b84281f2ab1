"""Agents of stable-baselines3 on dictionaries of observations, read out of their zips."""

import json
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from conftest import QUICK
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from sb3_agents import fresh_agent, save_agent, seeded, shake
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.export import export_sb3
from fdtasil.experts.sb3.observations import read_observed
from fdtasil.experts.sb3.scores import scores_of
from fdtasil.rollouts.spaces import layout_of

NUMBERS, CHOICE = Box(-1, 1, (2,), np.float32), Discrete(3)
GOAL = Dict(
    observation=Box(-np.inf, np.inf, (4,), np.float32),
    achieved_goal=Box(-1, 1, (2,), np.float32),
    desired_goal=Box(-1, 1, (2,), np.float32),
)
MIXED = Dict(
    {
        "grid": Box(-1, 1, (2, 2), np.float32),
        "mode": Discrete(3),
        "modes": MultiDiscrete([2, 3]),
        "on": MultiBinary(2),
        "it's": Box(np.zeros(3, np.float32), np.arange(1, 4, dtype=np.float32)),
    }
)
AGENTS = [
    *[(name, GOAL, NUMBERS) for name in ("SAC", "TD3", "DDPG", "TQC", "PPO", "A2C", "TRPO")],
    *[(name, MIXED, CHOICE) for name in ("DQN", "QRDQN", "PPO")],
    ("PPO", MIXED, NUMBERS),
]


class Drawn(gymnasium.Env):
    """Observations at random, of any space."""

    def __init__(self, observations=GOAL, actions=NUMBERS):
        self.observation_space, self.action_space = observations, actions

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._drawn(), {}

    def step(self, action):
        return self._drawn(), float(np.sum(action)), False, False, {}

    def _drawn(self):
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample()


def saved(folder, name="PPO", observations=GOAL, actions=NUMBERS, **settings):
    kind = {"policy": "MultiInputPolicy"}
    if name in ("DQN", "QRDQN"):
        kind["buffer_size"] = 10
    agent = fresh_agent(name, Drawn(observations, actions), {"net_arch": [8], **settings}, **kind)
    return shake(agent), save_agent(folder, agent)


@pytest.mark.fault(360)
@pytest.mark.parametrize(("name", "observations", "actions"), AGENTS)
def test_answers_as_predict(name, observations, actions, tmp_path):
    agent, _ = saved(tmp_path, name, observations, actions)
    path = save_agent(tmp_path, agent)  # as it is shaken
    layout, drawn = layout_of(observations, "observations"), Drawn(observations)
    seen = [drawn.reset(seed=seed)[0] for seed in range(32)]
    rows = np.stack([layout.row(one) for one in seen]).astype(np.float32)
    found = read_agent(path).module(torch.from_numpy(rows)).numpy()
    expected = np.stack([agent.predict(one, deterministic=True)[0] for one in seen])
    if actions is CHOICE:
        assert (found.argmax(axis=1) == expected).all()
        expected = scores_of(agent.policy)(layout.values(rows))
        found, expected = (
            scores - scores.mean(axis=1, keepdims=True) for scores in (found, expected)
        )
    assert np.abs(found - expected).max() <= 1e-5


def test_a_stack_of_frames(tmp_path):
    frames = Box(-1, 1, (3, 4), np.float32)
    agent = shake(fresh_agent("PPO", Drawn(frames), {"net_arch": [8]}))
    path = save_agent(tmp_path, agent)
    quick = {**QUICK, "evaluation_episodes": 0}
    states = fdtasil.distill(path, lambda: Drawn(frames), 0, force=True, **quick).demonstrations
    seen = states.observations.reshape(-1, 3, 4).astype(np.float32)
    expected = agent.predict(seen, deterministic=True)[0]
    assert states.actions == pytest.approx(expected, abs=1e-5)


def test_a_shell_distils_the_zip(tmp_path, inside, monkeypatch):
    gymnasium.register("toy/Goal-v0", entry_point=Drawn)
    try:
        agent, _ = saved(tmp_path)
        path, run = save_agent(tmp_path, agent), tmp_path / "run"
        quick = ["--episodes", 1, "--horizon", 10, "--steps", 5, "--evaluation-episodes", 0]
        done = inside("distill", path, "toy/Goal-v0", "--force", *quick, "--out", run)
        assert done.returncode == 0, done.stderr
        states = fdtasil.Distilled.load(run).demonstrations
        layout = layout_of(GOAL, "observations")
        expected = agent.predict(layout.values(states.observations), deterministic=True)[0]
        assert states.actions == pytest.approx(expected, abs=1e-5)
        export_sb3(path, tmp_path / "e.onnx", env=Drawn)
        quick = {**QUICK, "evaluation_episodes": 0}
        as_file = fdtasil.distill(tmp_path / "e.onnx", Drawn, 0, force=True, **quick)
        assert as_file.student.spaces.observations.names == tuple(GOAL.spaces)
    finally:
        del gymnasium.registry["toy/Goal-v0"]


@pytest.mark.parametrize(
    "other",
    [
        Dict({name: GOAL[name] for name in sorted(GOAL)}),  # another order
        Dict({"x": Box(-1, 1, (8,), np.float32)}),
        Dict(
            observation=Box(-1, 1, (6,)),
            achieved_goal=Box(-1, 1, (1,)),
            desired_goal=Box(-1, 1, (1,)),
        ),
    ],
)
def test_another_dictionary_is_refused(other, tmp_path):
    _, path = saved(tmp_path)
    with pytest.raises(ExpertError, match=r"observes observation \(4\), achieved_goal \(2\)"):
        fdtasil.distill(path, lambda: Drawn(other), 0, **QUICK)
    with pytest.raises(ExpertError, match="observes"):
        export_sb3(path, tmp_path / "e.onnx", env=lambda: Drawn(other))


def test_images_and_what_needs_trust_are_passed_themselves(tmp_path):
    pictures = Dict({"camera": Box(0, 255, (36, 36, 3), np.uint8), "speed": NUMBERS})
    _, path = saved(tmp_path, observations=pictures)
    with pytest.raises(ExpertError, match=r"camera.*\n.*without images\n.*the agent itself"):
        read_agent(path)
    _, path = saved(tmp_path, activation_fn=torch.nn.PReLU)
    with pytest.raises(ExpertError, match=r"PReLU(.*\n)*.*the agent itself"):
        read_agent(path, trust="pickle")


def test_statistics_of_some_parts(tmp_path):
    venv = VecNormalize(DummyVecEnv([Drawn]), norm_obs_keys=["observation", "desired_goal"])
    kind = {"policy": "MultiInputPolicy", "n_steps": 8, "batch_size": 8}
    agent = fresh_agent("PPO", venv, {"net_arch": [8]}, **kind)
    with seeded():
        agent.learn(16)
    venv.training, venv.clip_obs = False, 0.5
    path = save_agent(tmp_path, shake(agent))
    with pytest.warns(FdtasilWarning, match="trained in VecNormalize"):
        fdtasil.load_expert(path)
    venv.save(tmp_path / "stats.pkl")
    with pytest.raises(ExpertError, match=r"stats\.pkl is a Python pickle"):
        read_agent(path, vecnormalize=tmp_path / "stats.pkl")
    read = read_agent(path, vecnormalize=tmp_path / "stats.pkl", trust="pickle")
    layout, drawn = layout_of(GOAL, "observations"), Drawn()
    seen = [drawn.reset(seed=seed)[0] for seed in range(32)]
    rows = np.stack([layout.row(one) for one in seen]).astype(np.float32)
    found = read.module(torch.from_numpy(rows)).numpy()
    expected = agent.predict(venv.normalize_obs(layout.values(rows)), deterministic=True)[0]
    assert np.abs(found - expected).max() <= 1e-5
    plain = agent.predict(layout.values(rows), deterministic=True)[0]
    assert np.abs(found - plain).max() > 0.01
    _, other = saved(tmp_path, observations=MIXED)
    with pytest.raises(ExpertError, match="it has statistics of observation, desired_goal"):
        read_agent(other, vecnormalize=tmp_path / "stats.pkl", trust="pickle")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("{'a': Box(-1.0, 1.0, (2, 3), float32)}", (("a", 6),)),
        ("OrderedDict([('b', Discrete(3)), ('a', Box(-inf, inf, (2,), float64))])", "b3 a2"),
        ("OrderedDict({'a': MultiDiscrete([2 3]), 'b': MultiBinary(4)})", "a5 b4"),
        ("{'a': Box([-1.\\n -2.], [1. 2.], (2,), float32)}".replace("\\n", "\n"), "a2"),
        ("""{"it's": Discrete(2), 'a"b': Discrete(4)}""", (("it's", 2), ('a"b', 4))),
        ("{'a': Box((2,), (3,), (2,), float32)}", None),
        ("{'a': Box(-1.0, 1.0, (0,), float32)}", None),
        ("{'a': Box(0, 255, (3, 36, 36), uint8)}", None),
        ("{'a': Discrete(3, start=1)}", None),
        ("{'a': Text(3)}", None),
        ("{'a': Dict('b': Discrete(3))}", None),
        ("{'a': Discrete(3) 'b': Discrete(3)}", None),
        ("{'a': Discrete(10000000)}", None),
        ("{__import__('os'): Discrete(3)}", None),
        ("{}", None),
        ("", None),
        ("{" + "'a': Discrete(3), " * 100_000, None),
    ],
)
def test_the_text_of_a_dictionary(text, parts):
    space = {":type:": "<class 'gymnasium.spaces.dict.Dict'>", "spaces": text}
    record = {"observation_space": space}
    if parts is None:
        with pytest.raises(ExpertError, match="Dict") as caught:
            read_observed(record, "a.zip")
        assert len(str(caught.value)) < 600
        return
    if isinstance(parts, str):
        parts = tuple((word[0], int(word[1:])) for word in parts.split())
    found = read_observed(record, "a.zip")
    assert (found.parts, found.size) == (parts, sum(size for _, size in parts))


def test_what_a_zip_says_is_what_is_read(tmp_path):
    """The text that today's stable-baselines3 writes is one of those above."""
    _, path = saved(tmp_path, observations=MIXED)
    with zipfile.ZipFile(path) as archive:
        record = json.loads(archive.read("data"))
    layout = layout_of(MIXED, "observations")
    assert read_observed(record, "a").parts == tuple((p.name, p.size) for p in layout.parts)
