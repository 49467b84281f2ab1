"""RecurrentPPO's zip: the LSTM is read without unpickling, and carried along episodes."""

import numpy as np
import pytest
from conftest import QUICK
from sb3_agents import fresh_agent, rewrite, save_agent, shake
from toy_forms import InForm

import fdtasil
from fdtasil.errors import ExpertError, ExportError
from fdtasil.experts.sb3.agent import read_agent

pytestmark = pytest.mark.usefixtures("no_pictures")


def recurrent(environment=None, **settings):
    kwargs = {"lstm_hidden_size": 6, "net_arch": [5], **settings}
    options = {"n_steps": 8, "batch_size": 8, "policy": "MlpLstmPolicy"}
    return shake(fresh_agent("RecurrentPPO", environment or InForm(), kwargs, **options))


def played(agent, rows):
    """Actions of an agent's own predict along episodes side by side."""
    state, found = None, []
    for step, row in enumerate(rows):
        begun = np.full(len(row), step == 0)
        actions, state = agent.predict(row, state, begun, deterministic=True)
        found.append(actions)
    return np.stack(found)


def read_along(agent, rows):
    memory, found = np.zeros((rows.shape[1], agent.memory), np.float32), []
    for row in rows:
        actions, memory = agent.module.step(row, memory)
        found.append(actions)
    return np.stack(found)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"n_lstm_layers": 2},
        {"shared_lstm": True, "enable_critic_lstm": False},
        {"enable_critic_lstm": False, "net_arch": []},
    ],
)
def test_it_answers_as_its_library_does(settings, tmp_path):
    agent = recurrent(**settings)
    read = read_agent(save_agent(tmp_path, agent))
    assert read.algorithm == "RecurrentPPO"
    assert read.memory == 2 * 6 * settings.get("n_lstm_layers", 1)
    rows = np.random.default_rng(0).standard_normal((9, 3, 5)).astype(np.float32)
    assert read_along(read, rows) == pytest.approx(played(agent, rows), abs=1e-5)


def test_zip_and_object_teach_the_same(tmp_path):
    agent = recurrent()
    path = save_agent(tmp_path, agent)
    runs = [
        fdtasil.distill(one, InForm, 2, history=2, force=True, **QUICK)
        for one in (str(path), agent)
    ]
    ours, theirs = (run.demonstrations for run in runs)
    assert ours.observations == pytest.approx(theirs.observations, abs=1e-4)
    assert ours.actions == pytest.approx(theirs.actions, abs=1e-4)


def test_choices_with_a_memory(tmp_path):
    agent = recurrent(InForm("box", "choice"))
    read = read_agent(save_agent(tmp_path, agent))
    rows = np.random.default_rng(0).standard_normal((9, 3, 5)).astype(np.float32)
    assert np.array_equal(read_along(read, rows).argmax(-1), played(agent, rows))


@pytest.mark.fault(219)
def test_damaged_weights_are_refused(tmp_path):
    path = save_agent(tmp_path, recurrent())
    with pytest.raises(ExpertError, match="LSTM"):
        read_agent(rewrite(path, weights=lambda tensors: tensors.pop("lstm_actor.bias_hh_l0")))


def test_it_is_no_onnx_file_of_one_input(tmp_path):
    from fdtasil.experts.sb3.export import export_sb3

    with pytest.raises(ExportError, match="memory"):
        export_sb3(save_agent(tmp_path, recurrent()), tmp_path / "a.onnx")
