"""Agents of stable-baselines3: read without unpickling, equal to predict(), or refused."""

import base64
import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from fdtasil.errors import ExpertError, SettingError
from fdtasil.onnx_files import open_session, read_model, run_session
from fdtasil.sb3 import export_sb3, read_agent

ALGORITHMS = {"SAC": SAC, "TD3": TD3, "DDPG": DDPG, "PPO": PPO, "A2C": A2C}
OFF_POLICY = {"SAC", "TD3", "DDPG", "TQC"}
SHAPES = {
    "default": {},
    "other": {"net_arch": [9, 8, 7], "activation_fn": torch.nn.ELU},
    "split": {"net_arch": {"pi": [6], "qf": [5], "vf": [5]}, "activation_fn": torch.nn.Tanh},
    "linear": {"net_arch": []},
}
SHARED_AGENTS = Path(__file__).parents[2] / "shared" / "agents"


def algorithm_class(name):
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    return getattr(pytest.importorskip("sb3_contrib"), name)


@contextmanager
def seeded():
    """Keep stable-baselines3's draws from the global generators to itself."""
    numbers = np.random.get_state()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
    np.random.set_state(numbers)


@cache
def make_agent(name, environment="Pendulum-v1", shape="other", **settings):
    """A fresh agent whose weights are large enough that squashing and clipping show."""
    settings |= {"buffer_size": 10} if name in OFF_POLICY else {}
    settings |= {"policy_kwargs": dict(SHAPES[shape]), "device": "cpu"}
    with seeded(), torch.no_grad():
        agent = algorithm_class(name)("MlpPolicy", environment, **settings)
        for parameter in agent.policy.parameters():
            parameter.add_(torch.randn_like(parameter) / parameter.shape[-1] ** 0.5)
    return agent


def states_for(agent, count=64):
    size = agent.observation_space.shape[0]
    return np.random.default_rng(0).standard_normal((count, size)).astype(np.float32)


def predict(agent, states):
    return agent.predict(states, deterministic=True)[0]


def answers(read, states):
    return read.module(torch.from_numpy(states)).numpy()


@pytest.fixture
def save(tmp_path):
    def save(agent, name="agent.zip"):
        agent.save(tmp_path / name)
        return tmp_path / name

    return save


@pytest.fixture
def plain(save):
    return save(make_agent("PPO"))


def rewrite(path, *, record=None, weights=None, drop=(), rename=(), legacy=False):
    """Change a zip: `record` and `weights` edit the parsed member in place."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if record is not None:
        data = json.loads(members["data"])
        record(data)
        members["data"] = json.dumps(data).encode()
    if weights is not None or legacy:
        tensors = torch.load(io.BytesIO(members["policy.pth"]), weights_only=True)
        if weights is not None:
            weights(tensors)
        target = io.BytesIO()
        torch.save(tensors, target, _use_new_zipfile_serialization=not legacy)
        members["policy.pth"] = target.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if name not in drop:
                archive.writestr(dict(rename).get(name, name), content)
    return path


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"echo run > {self.path}",)


# Parity


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("environment", ["Pendulum-v1", "Hopper-v5"])
@pytest.mark.parametrize("name", [*ALGORITHMS, "TQC", "TRPO"])
def test_answers_as_predict(name, environment, shape, save):
    agent = make_agent(name, environment, shape)
    read = read_agent(save(agent))
    states = states_for(agent)
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5
    assert (read.algorithm, read.observation_size) == (name, states.shape[1])
    np.testing.assert_array_equal(read.action_low, agent.action_space.low)
    np.testing.assert_array_equal(read.action_high, agent.action_space.high)


@pytest.mark.parametrize(
    ("name", "environment"), [("SAC", None), ("TD3", "Hopper-v5"), ("PPO", "Hopper-v5")]
)
def test_onnx_answers_as_predict(name, environment, save, tmp_path):
    agent = make_agent(name, "Hopper-v5")
    source = save(agent)
    out = export_sb3(source, tmp_path / "out.onnx", env=environment)
    model, _ = read_model(out)
    states = states_for(agent, 37)
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
        agent = SAC.load(source, device="cpu", buffer_size=1)
    states = 3 * states_for(agent, 500)
    found = run_session(open_session(read_model(out)[0], "test"), "actions", states)
    assert np.abs(found - predict(agent, states)).max() <= 1e-5


def test_unequal_bounds(save):
    space = gymnasium.spaces.Box(np.float32([-1 / 3, -2e5]), np.float32([1e-7, 7]))

    class Wide(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
        action_space = space

    agent = make_agent("PPO", Wide())
    read = read_agent(save(agent))
    np.testing.assert_array_equal(read.action_low, space.low)
    np.testing.assert_array_equal(read.action_high, space.high)
    states = 10 * states_for(agent)
    np.testing.assert_array_equal(answers(read, states), predict(agent, states))


# Old zips


def old_layout(path, *, shared=False):
    """Write a fresh zip as stable-baselines3 0.6 wrote it: gym, other names, no version."""

    def record(data):
        for name in ("observation_space", "action_space"):
            space = data[name]
            space[":type:"] = "<class 'gym.spaces.box.Box'>"
            space["shape"] = space.pop("_shape")
        policy = data["policy_class"]
        policy[":type:"] = "<class 'type'>"
        if policy["__module__"] == "stable_baselines3.common.policies":
            policy["__module__"] = "stable_baselines3.ppo.policies"
            policy["__init__"] = "<function PPOPolicy.__init__ at 0x7ff160fce160>"
        else:
            data["policy_kwargs"]["device"] = "auto"
        for entry in data.values():  # unreadable today: they name modules that are gone
            if isinstance(entry, dict) and ":serialized:" in entry:
                entry[":serialized:"] = "gone"

    def weights(tensors):
        for part in ("weight", "bias"):
            net = "mlp_extractor.{}_net.{}." + part
            tensors[net.format("shared", 0)] = tensors.pop(net.format("policy", 0))
            for index in (2, 4):
                tensors[net.format("policy", index - 2)] = tensors.pop(net.format("policy", index))

    return rewrite(
        path,
        record=record,
        weights=weights if shared else None,
        drop=["_stable_baselines3_version", "system_info.txt"],
        rename={"pytorch_variables.pth": "tensors.pth"}.items(),
        legacy=True,
    )


@pytest.mark.parametrize("name", [*ALGORITHMS, "TQC"])
def test_old_zips(name, save):
    agent = make_agent(name)
    read = read_agent(old_layout(save(agent), shared=name in ("PPO", "A2C")))
    states = states_for(agent)
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5
    assert (read.algorithm, read.library_version) == (name, "unknown")


# Trust


def test_no_code_of_a_zip_runs(plain, tmp_path):
    marker = tmp_path / "marker"
    attack = base64.b64encode(pickle.dumps(Marker(marker))).decode()

    def record(data):
        data["extra"] = {":type:": "<class 'int'>", ":serialized:": attack}
        data["policy_kwargs"][":serialized:"] = attack

    rewrite(plain, record=record)
    read_agent(plain)
    assert not marker.exists()
    with pytest.raises(ExpertError):  # the attack is a real one
        read_agent(plain, trust="pickle")
    assert marker.exists()


def test_no_code_of_weights_runs(plain, tmp_path):
    marker = tmp_path / "marker"
    rewrite(plain, weights=lambda tensors: tensors.update(extra=Marker(marker)))
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


def test_the_library_is_not_imported(plain):
    code = (
        "import sys, fdtasil, fdtasil.sb3; fdtasil.sb3.read_agent(sys.argv[1]);"
        "assert 'stable_baselines3' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(plain)], check=True)


@pytest.mark.parametrize(
    ("name", "settings"),
    [("SAC", {}), ("SAC", {"use_sde": True}), ("PPO", {}), ("PPO", {"use_sde": True})],
)
def test_with_trust_the_library_loads(name, settings, save):
    agent = make_agent(name, **settings)
    states = states_for(agent)
    read = read_agent(save(agent), trust="pickle")
    assert np.abs(answers(read, states) - predict(agent, states)).max() <= 1e-5


def test_gsde_is_exported_with_trust(save, tmp_path):
    agent = make_agent("SAC", use_sde=True)
    out = export_sb3(save(agent), tmp_path / "out.onnx", trust="pickle")
    states = states_for(agent)
    found = run_session(open_session(read_model(out)[0], "test"), "actions", states)
    assert np.abs(found - predict(agent, states)).max() <= 1e-5


def test_trust_is_a_word(plain):
    with pytest.raises(SettingError, match="trust=True"):
        read_agent(plain, trust=True)


# VecNormalize


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


def test_unused_statistics(save, statistics, tmp_path):
    agent = make_agent("SAC")
    statistics.norm_obs = False
    statistics.save(tmp_path / "statistics.pkl")
    read = read_agent(save(agent), vecnormalize=tmp_path / "statistics.pkl", trust="pickle")
    assert read.statistics_sha256 is None
    assert (
        np.abs(answers(read, states_for(agent)) - predict(agent, states_for(agent))).max() < 1e-5
    )


def test_statistics_of_another_agent(save, statistics, tmp_path):
    source = save(make_agent("SAC", "Hopper-v5"))
    with pytest.raises(ExpertError, match="belong together"):
        read_agent(source, vecnormalize=tmp_path / "statistics.pkl", trust="pickle")


@pytest.mark.parametrize(
    "name", ["vecnormalize.pkl", "vec_normalize.pkl", "Pendulum-v1/vecnormalize.pkl"]
)
def test_statistics_are_not_forgotten(name, plain, tmp_path):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ExpertError, match=r"normalize\.pkl lies beside"):
        export_sb3(plain, tmp_path / "out.onnx")
    read_agent(plain, vecnormalize=False)


# Refusals


def setting(**values):
    return lambda data: data.update(policy_kwargs=values)


def policy_class(module, name):
    init = f"<function {name}.__init__ at 0x7f>"
    return lambda data: data["policy_class"].update(__module__=module, __init__=init)


def space(name, **values):
    return lambda data: data[name].update(
        {f":{k}:" if k == "type" else k: v for k, v in values.items()}
    )


DISCRETE, DICTIONARY = (
    f"<class 'gymnasium.spaces.{k}'>" for k in ("discrete.Discrete", "dict.Dict")
)
UNTRUSTED = {
    "gSDE": lambda data: data.update(use_sde=True),
    "squashes": setting(squash_output=True),
    "the feature extractor <class '__main__.Mine'>": setting(
        features_extractor_class="<class '__main__.Mine'>"
    ),
    "the activation functools.partial": setting(
        activation_fn="functools.partial(<class 'torch.nn.modules.activation.ReLU'>)"
    ),
    "the activation <class '__main__.ReLU'>": setting(activation_fn="<class '__main__.ReLU'>"),
    "the setting temperature": setting(temperature=2),
    "the policy class __main__.Mine": policy_class("__main__", "Mine"),
    "the policy class .*TD3Policy": policy_class("stable_baselines3.td3.policies", "TD3Policy"),
}
HOPELESS = {
    "images": policy_class("stable_baselines3.common.policies", "ActorCriticCnnPolicy"),
    "dictionaries": policy_class(
        "stable_baselines3.common.policies", "MultiInputActorCriticPolicy"
    ),
    "memory": policy_class("sb3_contrib.common.recurrent.policies", "RecurrentActorCriticPolicy"),
    "Discrete": space("action_space", type=DISCRETE, _shape=[]),
    "int8": space("action_space", dtype="int8"),
    "Dict": space("observation_space", type=DICTIONARY),
    r"shape \[64, 64, 3\]": space("observation_space", _shape=[64, 64, 3]),
    "no agent of a known algorithm": lambda data: data.pop("vf_coef") and data.pop("n_epochs"),
    "abbreviated": space("action_space", low="[-1. -1. ... -1. -1.]"),
    "low of the actions": space("action_space", low="[what]"),
    "action bounds": space("action_space", low="[3.]"),
    r"layers of shapes \(9, 3\), \(8, 9\)": space("observation_space", _shape=[4]),
    "no dictionary": lambda data: data.update(policy_kwargs=[3]),
}


@pytest.mark.parametrize("reason", [*UNTRUSTED, *HOPELESS])
def test_what_is_refused(reason, plain):
    rewrite(plain, record={**UNTRUSTED, **HOPELESS}[reason])
    with pytest.raises(ExpertError, match=reason) as caught:
        read_agent(plain)
    assert ('trust="pickle"' in caught.value.next_step) == (
        reason in UNTRUSTED or reason == "no dictionary"
    )
    assert len(str(caught.value).splitlines()) <= 6


def test_real_gsde_and_discrete_agents_are_refused(save):
    with pytest.raises(ExpertError, match="gSDE"):
        read_agent(save(make_agent("SAC", use_sde=True)))
    with pytest.raises(ExpertError, match="Discrete"):
        read_agent(save(make_agent("PPO", "CartPole-v1")))


def test_own_bounds(plain):
    rewrite(plain, record=space("action_space", low="[-1. ... -1.]", high="[1. ... 1.]"))
    read = read_agent(plain, action_low=[-0.5], action_high=0.25)
    assert (read.action_low, read.action_high) == (-0.5, 0.25)
    assert answers(read, states_for(make_agent("PPO"))).max() == 0.25
    with pytest.raises(SettingError, match="action_low"):
        read_agent(plain, action_low=[-0.5])
    with pytest.raises(SettingError, match="action_high"):
        read_agent(plain, action_low=[-1, -1], action_high=[1, 1])


def test_squashing_needs_bounds(save):
    source = rewrite(save(make_agent("SAC")), record=space("action_space", high="[inf]"))
    with pytest.raises(ExpertError, match="finite bounds"):
        read_agent(source)


def swap(name, tensor):
    return lambda tensors: tensors.update({name: tensor})


LAYER = "mlp_extractor.policy_net.2.weight"
BAD_WEIGHTS = {
    "features_extractor.cnn.weight": swap("features_extractor.cnn.weight", torch.zeros(2, 2)),
    "not linear": swap("mlp_extractor.policy_net.1.weight", torch.zeros(9)),
    "not linear: .*action_net": lambda tensors: tensors.pop("action_net.bias"),
    "finite": swap(LAYER, torch.full((8, 9), torch.nan)),
    "lead from 3": swap(LAYER, torch.zeros(8, 7)),
    "finite layers": swap(LAYER, torch.zeros(1).expand(8, 9)),
    "no state dict": swap("action_net.bias", 3),
}


@pytest.mark.parametrize("reason", BAD_WEIGHTS)
def test_bad_weights(reason, plain):
    rewrite(plain, weights=BAD_WEIGHTS[reason])
    with pytest.raises(ExpertError, match=reason):
        read_agent(plain)


def test_wrong_environment(save, tmp_path):
    source = save(make_agent("PPO"))
    with pytest.raises(ExpertError, match="3 observations and 1 actions"):
        export_sb3(source, tmp_path / "out.onnx", env="Hopper-v5")
    rewrite(source, record=space("action_space", low="[-1.]", high="[1.]"))
    with pytest.raises(ExpertError, match="action bounds"):
        export_sb3(source, tmp_path / "out.onnx", env="Pendulum-v1")
    assert not (tmp_path / "out.onnx").exists()


# Damaged and hostile files


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_truncated(part, plain):
    content = plain.read_bytes()
    plain.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ExpertError, match=r"no whole zip|copied whole"):
        read_agent(plain)


@pytest.mark.parametrize("member", ["data", "policy.pth"])
def test_missing_and_doubled_members(member, plain):
    with zipfile.ZipFile(plain, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(member, b"{}")
    with pytest.raises(ExpertError, match=f"has 2 members named {member}"):
        read_agent(plain)
    rewrite(plain, drop=[member])
    with pytest.raises(ExpertError, match=f"has 0 members named {member}"):
        read_agent(plain)


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 200_000, '{"a": \xff}'])
def test_strange_records(text, tmp_path):
    with zipfile.ZipFile(tmp_path / "agent.zip", "w") as archive:
        archive.writestr("data", text.encode("latin-1"))
    with pytest.raises(ExpertError, match="no JSON"):
        read_agent(tmp_path / "agent.zip")


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.zip", tmp_path):
        with pytest.raises(ExpertError, match="can't be read"):
            read_agent(path)


def test_flipped_bits_raise_nothing_else(plain):
    content, random = plain.read_bytes(), np.random.default_rng(0)
    for position in random.integers(len(content), size=150):
        damaged = bytearray(content)
        damaged[position] ^= 1 << random.integers(8)
        plain.write_bytes(damaged)
        with suppress(ExpertError):  # a bit in the optimiser's state does no harm
            read_agent(plain)


def zeros(archive, name, mebibytes):
    with archive.open(name, "w") as member:
        for _ in range(mebibytes):
            member.write(bytes(2**20))


def test_zip_bombs(plain, tmp_path):
    pack = partial(zipfile.ZipFile, mode="w", compression=zipfile.ZIP_DEFLATED, compresslevel=1)
    rewrite(plain, drop=["policy.pth"])
    whole = plain.read_bytes()
    with pack(tmp_path / "data.zip") as archive:
        zeros(archive, "data", 17)
    with pack(tmp_path / "inner") as archive:
        zeros(archive, "archive/data/0", 257)
    plain.write_bytes(whole)
    with zipfile.ZipFile(plain, "a") as archive:
        archive.write(tmp_path / "inner", "policy.pth")
    for path, name in ((tmp_path / "data.zip", "data"), (plain, r"policy\.pth")):
        assert path.stat().st_size < 3 * 2**20
        with pytest.raises(ExpertError, match=f"{name} unpacks to"):
            read_agent(path)
