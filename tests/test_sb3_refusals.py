"""What is no readable agent is refused with the reason: other agents, damaged and hostile zips."""

import json
import zipfile
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
import torch
from sb3_agents import answers, make_agent, rewrite, save_agent, states_for

from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.export import export_sb3


@pytest.fixture
def save(tmp_path):
    return partial(save_agent, tmp_path)


@pytest.fixture
def plain(save):
    return save(make_agent("PPO"))


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
    "masks on dictionaries": policy_class(
        "sb3_contrib.common.maskable.policies", "MaskableMultiInputActorCriticPolicy"
    ),
    "memory on images": policy_class(
        "sb3_contrib.common.recurrent.policies", "RecurrentActorCriticCnnPolicy"
    ),
    r"sbx, .*JAX.*\(sbx\.sac": policy_class("sbx.sac.policies", "SACPolicy"),
    "stable-baselines 2, of TensorFlow": lambda data: data.update(
        policy=data.pop("policy_class") | {"__module__": "stable_baselines.sac.policies"}
    ),
    "has no observation_space": lambda data: data.pop("observation_space"),
    r"shape \[1000000000000\]": space("observation_space", _shape=[10**12]),
    r"shape \[-3\]": space("observation_space", _shape=[-3]),
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


@pytest.mark.fault(43, 50)
def test_a_real_gsde_agent_is_refused(save):
    with pytest.raises(ExpertError, match="gSDE"):
        read_agent(save(make_agent("SAC", use_sde=True)))


@pytest.mark.fault(46)
def test_another_algorithm_with_the_settings_of_sac(save):
    for trust in (None, "pickle"):
        with pytest.raises(ExpertError, match=r"no agent of a known algorithm .*CrossQPolicy"):
            read_agent(save(make_agent("CrossQ")), trust=trust)


ODD = [None, True, -1, 1e300, "x", "\x1b[2J\n\n" + "x" * 10**6, [], [[]], {}, {"a": [None]}]


@pytest.mark.slow
@pytest.mark.parametrize("odd", ODD, ids=lambda odd: repr(odd)[:12])
def test_odd_records_raise_nothing_else(odd, plain):
    """Also where bounds are given, which are as long as the file says."""
    with zipfile.ZipFile(plain) as archive:
        record = json.loads(archive.read("data"))
    paths = [(key,) for key in record]
    for key in ("policy_class", "policy_kwargs", "observation_space", "action_space"):
        paths += [(key, inner) for inner in record[key]]
    for path in paths:
        changed = json.loads(json.dumps(record))
        target = changed[path[0]] if path[1:] else changed
        target[path[-1]] = odd
        rewrite(plain, record=lambda data, changed=changed: data.update(changed))
        for bounds in ({}, {"action_low": -1, "action_high": 1}):
            try:
                read_agent(plain, **bounds)
            except ExpertError as error:
                text = str(error)
                assert len(text.splitlines()) == 3
                assert len(text) < 1000
                assert text.replace("\n", "").isprintable()


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


@pytest.mark.fault(51)
def test_wrong_environment(save, tmp_path):
    source = save(make_agent("PPO"))
    with pytest.raises(ExpertError, match="3 observations and 1 actions"):
        export_sb3(source, tmp_path / "out.onnx", env="Hopper-v5")
    rewrite(source, record=space("action_space", low="[-1.]", high="[1.]"))
    with pytest.raises(ExpertError, match="action bounds"):
        export_sb3(source, tmp_path / "out.onnx", env="Pendulum-v1")
    assert not (tmp_path / "out.onnx").exists()


# Damaged and hostile files


@pytest.mark.fault(47)
@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_truncated(part, plain):
    content = plain.read_bytes()
    plain.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ExpertError, match=r"no whole zip|copied whole|has 0 bytes"):
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
