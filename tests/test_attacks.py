"""Files whose authors want to run code: nothing of them runs with default arguments.

What each promise of SECURITY.md is held by stands there.
"""

import io
import json
import pickle
import re
import sys
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from conftest import QUICK, TOY, mlp_onnx
from onnx import helper
from sb3_agents import Marker, booby_trap, make_agent, rewrite, save_agent

import fdtasil
from fdtasil.errors import ExpertError, FdtasilError, SettingError
from fdtasil.student.policy import Student


def pickled(protocol, marker):
    return pickle.dumps(Marker(marker), protocol)


def saved_by_torch(marker, *, legacy=False):
    target = io.BytesIO()
    torch.save(Marker(marker), target, _use_new_zipfile_serialization=not legacy)
    return target.getvalue()


def saved_by_numpy(marker):
    target = io.BytesIO()
    np.save(target, np.array([Marker(marker)], object), allow_pickle=True)
    return target.getvalue()


def zipped(marker, name="data", content=None):
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr(name, pickled(4, marker) if content is None else content)
    return target.getvalue()


def trapped_agent(marker, folder, member, name="PPO", **record):
    path = save_agent(folder, make_agent(name), "source.zip")
    booby_trap(path, marker, member)
    if record:
        rewrite(path, record=lambda data: data.update(record))
    return path.read_bytes()


def trapped_class(marker, folder):
    """An agent that names a class of the attacker's module, which would be imported."""
    (folder / "attacker.py").write_text(f"open({str(marker)!r}, 'w').close()\n")
    path = save_agent(folder, make_agent("PPO"), "source.zip")

    def record(data):
        data["policy_class"]["__module__"] = "attacker"
        data["policy_kwargs"]["activation_fn"] = "<class 'attacker.Activation'>"
        data["observation_space"][":type:"] = "<class 'attacker.Box'>"

    return rewrite(path, record=record).read_bytes()


def weights_after_a_zip(marker, folder):
    """A policy.pth that is a pickle, and no zip."""
    path = save_agent(folder, make_agent("PPO"), "source.zip")
    return rewrite(path, add={"policy.pth": pickled(2, marker)}).read_bytes()


def model_with_code(marker, folder, operator, domain):
    """A model with an operator that would run Python or native code, if anybody gave it one."""
    path = mlp_onnx(folder / "source.onnx")
    model = onnx.load(path)
    node = helper.make_node(operator, ["z_actions"], ["actions"], domain=domain)
    node.attribute.append(helper.make_attribute("compute", pickled(4, marker)))
    model.graph.node[-1].CopyFrom(node)
    model.opset_import.append(helper.make_opsetid(domain, 1))
    helper.set_model_props(model, {"custom_ops_library": "./attacker.so"})
    return model.SerializeToString()


ATTACKS = {
    **{
        f"pickle, protocol {protocol}": lambda marker, _, p=protocol: pickled(p, marker)
        for protocol in range(6)
    },
    "torch.save": lambda marker, _: saved_by_torch(marker),
    "torch.save, before 1.6": lambda marker, _: saved_by_torch(marker, legacy=True),
    "numpy.save": lambda marker, _: saved_by_numpy(marker),
    "zip of a pickle": lambda marker, _: zipped(marker),
    "zip with code": lambda marker, _: zipped(
        marker, "__main__.py", f"open({str(marker)!r}, 'w').close()"
    ),
    "zip with pickled weights": lambda marker, _: zipped(marker, "policy.pth"),
    "pickle after a model": lambda marker, folder: (
        mlp_onnx(folder / "source.onnx").read_bytes() + pickled(4, marker)
    ),
    "model in Python": lambda marker, folder: model_with_code(marker, folder, "PyOp", "pyop"),
    "model with a library": lambda marker, folder: model_with_code(
        marker, folder, "PyCustomOp", "ai.onnx.contrib"
    ),
    "agent, pickles of its record": lambda marker, folder: trapped_agent(marker, folder, "data"),
    "agent, pickled weights": lambda marker, folder: trapped_agent(marker, folder, "policy.pth"),
    "agent with gSDE": lambda marker, folder: trapped_agent(marker, folder, "data", use_sde=True),
    "agent of SAC": lambda marker, folder: trapped_agent(marker, folder, "data", "SAC"),
    "agent of a class to import": trapped_class,
    "agent, weights that are a pickle": weights_after_a_zip,
}
SUFFIXES = (".onnx", ".zip", ".pt", ".pkl", "")


def ways_to_open(path):
    """Every way in which a user hands a file to the library."""
    yield lambda: fdtasil.load_expert(path)
    yield lambda: fdtasil.load_expert(str(path), 5, 2)
    yield lambda: fdtasil.load_expert(path, 3, 1, output="actions", workers=1).ask(
        np.zeros((1, 3), np.float32), "act"
    )
    yield lambda: fdtasil.distill(path, TOY, 1, **QUICK)
    yield lambda: fdtasil.evaluate(path, lambda rows: rows[:, :2], TOY, episodes=1)


@pytest.mark.slow
@pytest.mark.fault(7, 8)
@pytest.mark.filterwarnings("ignore")
def test_no_code_of_a_file_runs(tmp_path, monkeypatch, figure):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    marker, opened = tmp_path / "marker", 0
    for attack, make in ATTACKS.items():
        content = make(marker, tmp_path)
        for suffix in SUFFIXES:
            path = tmp_path / f"expert{suffix}"
            path.write_bytes(content)
            for number, way in enumerate(ways_to_open(path)):
                with suppress(FdtasilError):  # what it says is under test elsewhere
                    way()
                assert not marker.exists(), (attack, suffix, number)
            path.unlink()
            opened += 1
    figure("attack files, default arguments", f"{opened} opened in 5 ways, 0 marker files")


@pytest.mark.parametrize("protocol", range(6))
def test_the_attacks_are_real_ones(protocol, tmp_path):
    pickle.loads(pickled(protocol, tmp_path / "marker"))
    assert (tmp_path / "marker").exists()


def test_the_weights_of_a_student_are_no_pickle(tmp_path):
    marker = tmp_path / "marker"
    for content in (pickled(4, marker), saved_by_torch(marker)):
        with pytest.raises(FdtasilError):
            Student.from_bytes(content)
    assert not marker.exists()


def test_demonstrations_are_no_pickle(tmp_path):
    marker, path = tmp_path / "marker", tmp_path / "demonstrations.npz"
    contents = [pickled(4, marker), saved_by_numpy(marker), zipped(marker, "observations.npy")]
    contents.append(zipped(marker, "observations.npy", saved_by_numpy(marker)))
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(FdtasilError):
            fdtasil.distill(dataset=path, probes=0, fit=fdtasil.Fit(steps=1))
    assert not marker.exists()


def remembered(folder, **changes):
    """Write the arguments of a run, as `fdtasil distill` leaves them in its folder."""
    arguments = {"expert": "e.onnx", "env": TOY, "trust": None} | changes
    (folder / "command.json").write_text(json.dumps(arguments))


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"env": "attacker:Env-v0"}, "attacker:Env-v0"),
        ({"env": "Pendulum-v1", "trust": "pickle"}, "trust"),
    ],
)
def test_a_file_can_not_ask_for_an_import_or_for_trust(changes, found, tmp_path, monkeypatch):
    from fdtasil.shell.distill import _remembered

    (tmp_path / "attacker.py").write_text("open('marker', 'w').close()")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    remembered(tmp_path, **changes)
    with pytest.raises(SettingError, match=found):
        _remembered(tmp_path)
    assert not Path("marker").exists()


def test_every_promise_names_tests_that_exist():
    tests = Path(__file__).parent
    text = (tests.parent / "SECURITY.md").read_text()
    sources = "".join(path.read_text() for path in tests.glob("test_*.py"))
    named = set(re.findall(r"`(test_\w+)`", text))
    assert len(named) > 20
    assert not {name for name in named if f"def {name}(" not in sources}
    for promise in text.partition("## Promised")[2].partition("## Not promised")[0].split("\n\n"):
        assert not promise.strip() or "`test_" in promise


def test_a_student_with_hostile_metadata(tmp_path):
    model = onnx.load(mlp_onnx(tmp_path / "e.onnx"))
    for columns in ("0,x", "\x1b[2J", ""):
        helper.set_model_props(model, {"fdtasil.observation_columns": columns})
        onnx.save(model, tmp_path / "e.onnx")
        with pytest.raises(ExpertError, match="it sees the columns") as caught:
            fdtasil.evaluate(
                tmp_path / "e.onnx", lambda x: x[:, :2] / 9, TOY, episodes=1, horizon=5
            )
        assert str(caught.value).replace("\n", "").isprintable()
