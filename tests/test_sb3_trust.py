"""Zips and statistics of stable-baselines3: what is read without trust, with it, and when old."""

import base64
import json
import pickle
import subprocess
import sys
import zipfile
from functools import partial

import numpy as np
import pytest
import torch
from sb3_agents import (
    ALGORITHMS,
    LAYOUTS,
    Marker,
    answers,
    booby_trap,
    fresh_agent,
    make_agent,
    old_layout,
    predict,
    rewrite,
    save_agent,
    shake,
    states_for,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

import fdtasil
from fdtasil.errors import ExpertError, SettingError
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


def assert_answers_as_predict(read, agent):
    states = states_for(agent)
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5


# Without trust nothing runs


@pytest.mark.parametrize("layout", [None, *LAYOUTS])
def test_no_code_of_a_zip_runs(layout, plain, tmp_path):
    marker = tmp_path / "marker"
    booby_trap(old_layout(plain, layout) if layout else plain, marker, "data")
    assert_answers_as_predict(read_agent(plain), make_agent("PPO"))
    export_sb3(plain, tmp_path / "out.onnx")
    fdtasil.load_expert(plain)
    read_agent(plain, trust="pickle")  # not even so, because there is no need
    assert not marker.exists()
    rewrite(plain, record=lambda data: data.update(use_sde=True))
    with pytest.raises(ExpertError, match="gSDE"):
        read_agent(plain)
    assert not marker.exists()
    with pytest.raises(ExpertError):  # the attack is a real one
        read_agent(plain, trust="pickle")
    assert marker.exists()


def test_no_code_of_weights_runs(plain, tmp_path):
    marker = tmp_path / "marker"
    booby_trap(plain, marker, "policy.pth")
    with pytest.raises(ExpertError, match=r"policy\.pth can't be read"):
        read_agent(plain)
    assert not marker.exists()


def test_no_code_of_statistics_runs(plain, tmp_path):
    marker, statistics = tmp_path / "marker", tmp_path / "statistics.pkl"
    statistics.write_bytes(pickle.dumps(Marker(marker)))
    with pytest.raises(ExpertError, match="runs any code"):
        read_agent(plain, vecnormalize=statistics)
    assert not marker.exists()
    with pytest.raises(ExpertError, match="can't be used"):
        read_agent(plain, vecnormalize=statistics, trust="pickle")
    assert marker.exists()


@pytest.mark.slow
def test_the_library_is_not_imported(plain):
    code = (
        "import sys; from fdtasil.experts.sb3.agent import read_agent; read_agent(sys.argv[1]);"
        "assert 'stable_baselines3' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(plain)], check=True)


def test_trust_is_a_word(plain):
    for trust in (True, 1, "Pickle", "yes"):
        with pytest.raises(SettingError, match="trust="):
            read_agent(plain, trust=trust)


# With trust


@pytest.mark.parametrize("name", ["SAC", "TQC", "PPO", "A2C"])
def test_gsde_with_trust(name, save):
    agent = make_agent(name, use_sde=True)
    source = save(agent)
    with pytest.raises(ExpertError, match=r"gSDE.*without unpickling"):
        read_agent(source)
    assert_answers_as_predict(read_agent(source, trust="pickle"), agent)


def test_squashing_ppo_needs_trust(save):
    kwargs = {"net_arch": [9], "squash_output": True}
    agent = shake(fresh_agent("PPO", "Pendulum-v1", kwargs, use_sde=True))
    source = save(agent)
    with pytest.raises(ExpertError, match=r"gSDE.*without unpickling"):
        read_agent(source)
    read = read_agent(source, trust="pickle")
    assert_answers_as_predict(read, agent)
    assert np.abs(answers(read, 100 * states_for(agent))).max() > 1.9  # of 2: rescaled


@pytest.mark.slow
def test_gsde_is_exported_with_trust(save, tmp_path):
    agent = make_agent("SAC", use_sde=True)
    out = export_sb3(save(agent), tmp_path / "out.onnx", trust="pickle")
    states = states_for(agent)
    found = run_session(open_session(read_model(out)[0], "test"), "actions", states)
    assert np.abs(found - predict(agent, states)).max() <= 1e-5


class Squares(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, 6)

    def forward(self, observations):
        return torch.cat([observations, observations**2], 1)


class Doubled(ActorCriticPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)

    def _predict(self, observation, deterministic=False):
        return 2 * super()._predict(observation, deterministic)


class Halved(ActorCriticPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)

    def predict(self, *args, **kwargs):
        actions, state = super().predict(*args, **kwargs)
        return actions / 2, state


@pytest.mark.slow
@pytest.mark.fault(50)
@pytest.mark.parametrize(
    ("policy", "kwargs"),
    [
        ("MlpPolicy", {"features_extractor_class": Squares}),
        ("MlpPolicy", {"activation_fn": torch.nn.PReLU}),
        ("MlpPolicy", {"activation_fn": partial(torch.nn.LeakyReLU, 0.3)}),
        (Doubled, {}),
    ],
)
def test_custom_parts_need_trust(policy, kwargs, save, tmp_path):
    agent = shake(fresh_agent("PPO", "Pendulum-v1", kwargs, policy=policy))
    source = save(agent)
    with pytest.raises(ExpertError, match="without unpickling") as caught:
        read_agent(source)
    assert 'trust="pickle"' in caught.value.next_step
    assert_answers_as_predict(read_agent(source, trust="pickle"), agent)
    export_sb3(source, tmp_path / "out.onnx", trust="pickle", env="Pendulum-v1")


def test_a_predict_of_its_own_is_refused(save):
    agent = shake(fresh_agent("PPO", "Pendulum-v1", {}, policy=Halved))
    with pytest.raises(ExpertError, match=r"predict\(\) of the agent's policy does more"):
        read_agent(save(agent), trust="pickle")


# Old zips


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_old_zips(name, layout, save):
    agent = make_agent(name)
    read = read_agent(old_layout(save(agent), layout, shared=name in ("PPO", "A2C")))
    assert_answers_as_predict(read, agent)
    version = "unknown" if layout == "0.6" else layout + ".0"
    assert (read.algorithm, read.library_version) == (name, version)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_old_zips_with_trust(name, layout, save):
    agent = make_agent(name, use_sde=True)
    assert_answers_as_predict(read_agent(old_layout(save(agent), layout), trust="pickle"), agent)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_pickles_of_old_zips_are_old(layout, plain):
    old_layout(plain, layout)
    with zipfile.ZipFile(plain) as archive:
        record = json.loads(archive.read("data"))
    for name in ("observation_space", "action_space"):
        with pytest.raises(ModuleNotFoundError, match="gym"):
            pickle.loads(base64.b64decode(record[name][":serialized:"]))
