"""Statistics of VecNormalize: folded in with trust, never forgotten, never another agent's."""

import re
from functools import partial

import gymnasium
import numpy as np
import pytest
from sb3_agents import (
    OFF_POLICY,
    algorithm_class,
    answers,
    booby_trap,
    make_agent,
    predict,
    save_agent,
    save_old_statistics,
    seeded,
    states_for,
)
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.export import export_sb3
from fdtasil.files.onnx.model import read_model
from fdtasil.files.onnx.session import open_session, run_session


@pytest.fixture
def save(tmp_path):
    return partial(save_agent, tmp_path)


@pytest.fixture
def plain(save):
    return save(make_agent("PPO"))


@pytest.fixture
def statistics(tmp_path):
    wrapper = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), clip_obs=2.5)
    wrapper.obs_rms.mean = np.array([0.3, -1.7, 1234.567])
    wrapper.obs_rms.var = np.array([0.1, 4.0, 0.02])
    wrapper.save(tmp_path / "statistics.pkl")
    return wrapper


def test_statistics_are_folded_in(save, statistics, tmp_path):
    agent, file = make_agent("SAC"), tmp_path / "statistics.pkl"
    source = save(agent)
    raw = states_for(agent) * 0.3 + statistics.obs_rms.mean.astype(np.float32)
    normalised = statistics.normalize_obs(raw)
    assert (np.abs(normalised) == 2.5).any()  # clipping shows
    expected = predict(agent, normalised)
    read = read_agent(source, vecnormalize=file, trust="pickle")
    assert np.abs(answers(read, raw) - expected).max() <= 1e-5
    out = export_sb3(source, tmp_path / "out.onnx", vecnormalize=file, trust="pickle")
    model, _ = read_model(out)
    found = run_session(open_session(model, "test"), "actions", raw)
    assert np.abs(found - expected).max() <= 1e-5
    assert "vecnormalize_sha256" in {entry.key for entry in model.metadata_props}


def test_trust_in_statistics_runs_no_code_of_the_zip(plain, statistics, tmp_path):
    booby_trap(plain, tmp_path / "marker", "data")
    read_agent(plain, vecnormalize=tmp_path / "statistics.pkl", trust="pickle")
    assert not (tmp_path / "marker").exists()


def test_unused_statistics(save, statistics, tmp_path):
    agent = make_agent("SAC")
    statistics.norm_obs = False
    statistics.save(tmp_path / "statistics.pkl")
    read = read_agent(save(agent), vecnormalize=tmp_path / "statistics.pkl", trust="pickle")
    assert read.statistics_sha256 is None
    states = states_for(agent)
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5


def test_statistics_of_another_agent(save, statistics, tmp_path):
    source = save(make_agent("SAC", "Hopper-v5"))
    with pytest.raises(ExpertError, match="belong together"):
        read_agent(source, vecnormalize=tmp_path / "statistics.pkl", trust="pickle")


def test_old_statistics(save, statistics, tmp_path):
    agent, old = make_agent("SAC"), save_old_statistics(statistics, tmp_path / "old.pkl")
    assert b"gymnasium" not in old.read_bytes()
    raw = states_for(agent) * 0.3 + statistics.obs_rms.mean.astype(np.float32)
    read = read_agent(save(agent), vecnormalize=old, trust="pickle")
    assert np.abs(answers(read, raw) - predict(agent, statistics.normalize_obs(raw))).max() <= 1e-5


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x04K\x03.", b"PK\x03\x04"])
def test_other_files(content, plain, tmp_path):
    (tmp_path / "other").write_bytes(content)
    with pytest.raises(ExpertError, match=r"can't be used|has 0 bytes"):
        read_agent(plain, vecnormalize=tmp_path / "other", trust="pickle")


def test_other_values(plain):
    with pytest.raises(SettingError, match="vecnormalize=True"):
        read_agent(plain, vecnormalize=True)
    with pytest.raises(ExpertError, match="can't be read"):
        read_agent(plain, vecnormalize="nowhere.pkl", trust="pickle")


NEIGHBOURS = [
    ["vecnormalize.pkl"],
    ["vec_normalize.pkl"],
    ["vecnorm.pkl"],
    ["agent/vecnormalize.pkl"],
    ["Pendulum-v1/vecnormalize.pkl", "Pendulum-v1/config.yml"],  # rl-zoo
]


def touch(folder, names):
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")


@pytest.mark.fault(48)
@pytest.mark.parametrize("names", NEIGHBOURS, ids=str)
def test_statistics_are_not_forgotten(names, plain, tmp_path):
    touch(tmp_path, names)
    for ask in (partial(export_sb3, out=tmp_path / "out.onnx"), fdtasil.load_expert):
        with pytest.raises(ExpertError, match=r"\.pkl lies beside agent\.zip") as caught:
            ask(plain)
        command = rf"fdtasil export-sb3 .*agent\.zip .*{re.escape(names[0])} --trust pickle"
        assert re.match(command, caught.value.next_step)
    for said in (False, "False"):  # as in Python, as in a shell
        assert read_agent(plain, vecnormalize=said).statistics_sha256 is None


def test_the_statistics_of_the_same_step_are_named_first(save, tmp_path):
    source = save(make_agent("PPO"), "walker_2000_steps.zip")
    touch(tmp_path, [f"walker_vecnormalize_{step}_steps.pkl" for step in (1000, 2000, 3000)])
    with pytest.raises(ExpertError, match=r"_2000_steps\.pkl \(and 2 more\) lies beside"):
        read_agent(source)


def test_statistics_of_other_agents_below_do_not_matter(plain, tmp_path):
    touch(tmp_path, ["another/vecnormalize.pkl", "another/vec_normalize.pkl"])
    read_agent(plain)


def learnt(name, wrap):
    """An agent that has learnt for a moment, since only then its zip says what it saw."""
    few = {"buffer_size": 10, "learning_starts": 20} if name in OFF_POLICY else {"n_steps": 8}
    few |= {"batch_size": 8} if name in ("PPO", "TRPO") else {}
    environments = wrap(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    with seeded():
        return algorithm_class(name)("MlpPolicy", environments, device="cpu", **few).learn(8)


@pytest.mark.fault(283)
@pytest.mark.parametrize("name", ["PPO", "A2C", "TRPO"])
def test_a_zip_that_says_that_it_was_normalised_is_warned_of(name, save, tmp_path):
    agent = learnt(name, VecNormalize)
    source = save(agent)
    for ask in (read_agent, fdtasil.load_expert):
        with pytest.warns(FdtasilWarning, match=r"agent\.zip was trained in VecNormalize") as said:
            ask(source)
        assert f"fdtasil export-sb3 {source} --out agent.onnx --vecnorm" in str(said[0].message)
    assert read_agent(source, vecnormalize=False).statistics_sha256 is None
    # The two ways that it names.
    environments, states = agent.get_env(), states_for(agent)
    environments.save(tmp_path / "stats.pkl")
    expected = predict(agent, environments.normalize_obs(states))
    read = read_agent(source, vecnormalize=tmp_path / "stats.pkl", trust="pickle")
    assert np.abs(answers(read, states) - expected).max() <= 1e-5
    wrapped = VecNormalize.load(tmp_path / "stats.pkl", environments.venv)
    with seeded():
        whole = type(agent).load(source, env=wrapped, device="cpu")
        alone = type(agent).load(source, device="cpu")
    found = fdtasil.load_expert(whole, 3, 1).ask(states, "act")
    assert np.abs(found - expected).max() <= 1e-5
    with pytest.warns(FdtasilWarning, match=f"{name} agent was trained in VecNormalize"):
        fdtasil.load_expert(alone, 3, 1)


@pytest.mark.fault(283)
@pytest.mark.parametrize("name", ["PPO", "A2C", "TRPO", "SAC", "TD3"])
def test_a_zip_that_does_not_say_so_is_not_warned_of(name, save):
    """Warnings are errors here: SAC and TD3 keep an observation in each case."""
    wrappers = (lambda one: one, VecNormalize) if name in ("SAC", "TD3") else (lambda one: one,)
    for wrap in wrappers:
        agent = learnt(name, wrap)
        read_agent(save(agent))
        with seeded():
            loaded = type(agent).load(save(agent), device="cpu")
        fdtasil.load_expert(loaded, 3, 1)
    read_agent(save(make_agent(name)))
