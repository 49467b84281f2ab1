"""Agents of stable-baselines3 for tests and experts/parity.py: fresh, changed, old, hostile."""

import base64
import io
import json
import os
import pickle
import sys
import zipfile
from contextlib import ExitStack, contextmanager
from functools import cache
from types import ModuleType
from unittest.mock import patch

import numpy as np
import sb3_contrib
import stable_baselines3
import torch

ALGORITHMS = ("SAC", "TD3", "DDPG", "TQC", "PPO", "A2C", "TRPO")
OFF_POLICY = {"SAC", "TD3", "DDPG", "TQC", "CrossQ"}
SHAPES = {
    "default": {},
    "other": {"net_arch": [9, 8, 7], "activation_fn": torch.nn.ELU},
    "split": {"net_arch": {"pi": [6], "qf": [5], "vf": [5]}, "activation_fn": torch.nn.Tanh},
    "linear": {"net_arch": []},
}
LAYOUTS = ("0.6", "1.5")


def algorithm_class(name):
    library = stable_baselines3 if hasattr(stable_baselines3, name) else sb3_contrib
    return getattr(library, name)


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
    return shake(fresh_agent(name, environment, dict(SHAPES[shape]), **settings))


def fresh_agent(name, environment, policy_kwargs, policy="MlpPolicy", **settings):
    settings |= {"buffer_size": 10} if name in OFF_POLICY else {}
    with seeded():
        return algorithm_class(name)(
            policy, environment, policy_kwargs=policy_kwargs, device="cpu", **settings
        )


def shake(agent, seed=0):
    """Add noise to the weights, as large as the weights of a fresh layer."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in agent.policy.parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter.add_(noise / parameter.shape[-1] ** 0.5)
    return agent


def states_for(agent, count=64):
    size = agent.observation_space.shape[0]
    return np.random.default_rng(0).standard_normal((count, size)).astype(np.float32)


def predict(agent, states):
    return agent.predict(states, deterministic=True)[0]


def answers(read, states):
    return read.module(torch.from_numpy(states)).numpy()


def save_agent(folder, agent, name="agent.zip"):
    agent.save(folder / name)
    return folder / name


def rewrite(path, *, record=None, weights=None, drop=(), add=(), rename=(), legacy=False):
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
        for name, content in {**members, **dict(add)}.items():
            if name not in drop:
                archive.writestr(dict(rename).get(name, name), content)
    return path


# Old zips


def old_layout(path, version="0.6", *, shared=False):
    """Rewrite a fresh zip as stable-baselines3 0.6 (2020) or 1.5 (2022) wrote it.

    Args:
        path: The zip.
        version: One of `LAYOUTS`.
        shared: Put the first layer of an on-policy agent before policy and value function, as
            net_arch=[64, dict(...)] did; that is possible where both have it in common.
    """
    ancient = version == "0.6"

    def record(data):
        for name in ("observation_space", "action_space"):
            _old_space(data[name], ancient)
        if ancient:
            _old_policy(data)

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
        drop=["_stable_baselines3_version", "system_info.txt"] if ancient else [],
        add={} if ancient else {"_stable_baselines3_version": b"1.5.0"},
        rename={"pytorch_variables.pth": "tensors.pth"} if ancient else {},
        legacy=ancient,
    )


def save_old_statistics(wrapper, path):
    """Write what VecNormalize.save() wrote when spaces were gym's."""
    with _absent_class("gym.spaces.box", "Box") as box, ExitStack() as stack:
        for name in ("observation_space", "action_space"):
            space = box()
            vars(space).update(vars(getattr(wrapper, name)))
            stack.enter_context(patch.object(wrapper, name, space))
        wrapper.save(path)
    return path


@contextmanager
def _absent_class(module, name):
    """A class that can be pickled here, and that exists nowhere when it is unpickled."""
    kind, stand_in = type(name, (), {"__module__": module}), ModuleType(module)
    setattr(stand_in, name, kind)
    parts = module.split(".")
    parents = [".".join(parts[:length]) for length in range(1, len(parts))]
    absent = {parent: ModuleType(parent) for parent in parents if parent not in sys.modules}
    with patch.dict(sys.modules, {**absent, module: stand_in}):
        yield kind


def _old_space(entry, ancient):
    state = vars(pickle.loads(base64.b64decode(entry[":serialized:"])))
    if ancient:  # gym called it so until 0.19
        state["shape"], entry["shape"] = state.pop("_shape"), entry.pop("_shape")
    entry[":type:"] = "<class 'gym.spaces.box.Box'>"
    with _absent_class("gym.spaces.box", "Box") as box:
        space = box()
        vars(space).update(state)
        entry[":serialized:"] = base64.b64encode(pickle.dumps(space)).decode()


def _old_policy(data):
    policy = data["policy_class"]
    policy[":type:"] = "<class 'type'>"
    if policy["__module__"] != "stable_baselines3.common.policies":
        data["policy_kwargs"]["device"] = "auto"
        return
    policy["__module__"] = "stable_baselines3.ppo.policies"
    policy["__init__"] = "<function PPOPolicy.__init__ at 0x7ff160fce160>"
    with _absent_class("stable_baselines3.ppo.policies", "PPOPolicy") as kind:
        policy[":serialized:"] = base64.b64encode(pickle.dumps(kind)).decode()


# Hostile zips


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"echo run > {self.path}",)


def booby_trap(path, marker, member):
    """Put code into a zip that writes `marker` when its "data" or "policy.pth" is unpickled."""
    if member == "policy.pth":
        return rewrite(path, weights=lambda tensors: tensors.update(extra=Marker(marker)))
    attack = base64.b64encode(pickle.dumps(Marker(marker))).decode()

    def record(data):
        data["extra"] = {":type:": "<class 'int'>", ":serialized:": attack}
        for entry in data.values():
            if isinstance(entry, dict) and ":serialized:" in entry:
                entry[":serialized:"] = attack

    return rewrite(path, record=record)
