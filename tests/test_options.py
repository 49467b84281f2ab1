"""Options of training that users expect: validation, clipping, callbacks, logs, Minari."""

import csv
import json

import numpy as np
import pytest
import torch
from conftest import QUICK, TOY

import fdtasil
from fdtasil.errors import FdtasilWarning, SettingError, StorageError
from fdtasil.student.fit_state import FitState


def test_validation_keeps_the_best_weights(linear):
    held = {**QUICK, "episodes": 5, "steps": 1000, "validation": 0.4}
    result = fdtasil.distill(linear, TOY, 3, **held)
    losses = [entry["validation_loss"] for entry in result.history]
    training = [entry["loss"] for entry in result.history]
    assert losses != training
    assert min(losses) < losses[0]


def test_the_best_weights_are_those_of_the_best_validation():
    student = torch.nn.Linear(1, 1, device="meta").to_empty(device="cpu")
    state = FitState(student, torch.optim.AdamW(student.parameters()))
    for weight, held_out in [(1.0, 3.0), (2.0, 0.5), (3.0, 0.7)]:
        with torch.no_grad():
            student.weight.fill_(weight)
        state.count(torch.ones(4))
        assert state.log(held_out)["validation_loss"] == held_out
    assert state.stale == 1
    state.keep_best()
    assert float(student.weight) == 2.0


def test_patience_stops_early(linear):
    held = {**QUICK, "episodes": 4, "validation": 0.5, "patience": 2, "learning_rate": 0.0}
    result = fdtasil.distill(linear, TOY, 0, **{**held, "steps": 5000})
    assert [entry["step"] for entry in result.history] == [100, 200, 300]
    assert result.report["steps"] == 300
    with pytest.raises(SettingError, match="patience=2 without validation"):
        fdtasil.distill(linear, TOY, 0, **QUICK, patience=2)


@pytest.mark.fault(96)
def test_a_single_episode_holds_none_out_and_says_so(linear):
    said = r"validation=0\.3 of a single episode: none is held out"
    with pytest.warns(FdtasilWarning, match=said):
        result = fdtasil.distill(linear, TOY, 2, **{**QUICK, "episodes": 1}, validation=0.3)
    entry = result.history[-1]
    assert entry["validation_loss"] == entry["loss"]
    assert len(result.report["warnings"]) == 1
    with pytest.warns(FdtasilWarning, match=said):
        fdtasil.distill(demonstrations=result.dataset, validation=0.3, steps=5, hidden=4)


@pytest.mark.fault(96)
def test_a_first_round_of_one_episode_is_no_news(linear):
    """The last round has more of them, and holds some out."""
    run = {**QUICK, "episodes": 3, "validation": 0.3}
    result = fdtasil.distill(linear, TOY, 0, trainer="dagger", **run)
    assert result.report["warnings"] == []
    first, last = result.history
    assert first["validation_loss"] == first["loss"]
    assert last["validation_loss"] != last["loss"]


def test_gradient_clipping_bounds_the_step(linear):
    free = fdtasil.distill(linear, TOY, 2, **QUICK)
    clipped = fdtasil.distill(linear, TOY, 2, **QUICK, max_gradient_norm=1e-9)
    start = fdtasil.distill(linear, TOY, 2, **QUICK, learning_rate=0.0)
    assert free.student.to_bytes() != clipped.student.to_bytes()
    assert start.history[-1]["loss"] > free.history[-1]["loss"]


def test_callbacks_hear_of_everything(linear):
    heard = []
    quick = {**QUICK, "episodes": 6, "steps": 200}
    result = fdtasil.distill(linear, TOY, 2, trainer="dagger", callback=heard.append, **quick)
    kinds = [event.kind for event in heard]
    assert kinds == ["entry", "entry", "round"] * 3 + ["evaluation"]
    assert [event.round for event in heard if event.kind == "round"] == [0, 1, 2]
    assert heard[-1].evaluation == result.evaluation
    assert [event.entry for event in heard if event.kind == "entry"] == result.history


def test_logs_through_stable_baselines3(linear, tmp_path):
    formats = ("csv", "json", "log", "tensorboard")
    fdtasil.distill(linear, TOY, 2, **QUICK, out=tmp_path, log_formats=formats)
    rows = list(csv.DictReader((tmp_path / "log/progress.csv").open()))
    assert float(rows[0]["train/loss"]) > 0
    lines = [json.loads(line) for line in (tmp_path / "log/progress.json").open()]
    assert "eval/normalized_return" in lines[-1]
    assert list((tmp_path / "log").glob("events.out.tfevents*"))


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"log_formats": ("csv",)}, "without a folder"),
        ({"log_formats": ("excel",), "out": "runs/x"}, "excel"),
        ({"validation": 1.0}, "validation=1.0"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm=0.0"),
        ({"order": 3}, "order=3"),
        ({"order": 2, "probes": "sphere:3,forward"}, "forward stencil"),
        ({"resume": "nowhere"}, "no run to resume"),
    ],
)
def test_wrong_options_are_named(wrong, found, linear, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingError, match=found):
        fdtasil.distill(linear, TOY, **{"probes": 2, **QUICK, **wrong})


@pytest.fixture
def minari_folder(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def test_minari_there_and_back(quick, minari_folder):
    written = fdtasil.to_minari(quick.dataset, "toy/linear-v0", algorithm_name="linear")
    episode = next(written.iterate_episodes())
    assert episode.infos["probe_values"].shape == (21, 3, 1, 2)
    assert episode.rewards.sum() > 0
    again = fdtasil.from_minari("toy/linear-v0")
    for name in ("observations", "actions", "episode", "taken", "rewards"):
        found, expected = (getattr(d.demonstrations, name) for d in (again, quick.dataset))
        assert np.array_equal(found, expected), name
    assert np.array_equal(again.low, quick.dataset.low)
    with pytest.raises(StorageError, match="toy/linear-v0"):
        fdtasil.to_minari(quick.dataset, "toy/linear-v0")


def test_cloning_from_a_dataset_alone(quick, minari_folder):
    """No expert and no environment: the same student as plain cloning in the run itself."""
    fdtasil.to_minari(quick.dataset, "toy/alone-v0")
    settings = {"hidden": QUICK["hidden"], "steps": QUICK["steps"]}
    cloned = fdtasil.distill(
        demonstrations=fdtasil.from_minari("toy/alone-v0"), probes=0, **settings
    )
    again = fdtasil.distill(demonstrations=quick.dataset, probes=0, **settings)
    rows = quick.demonstrations.observations
    assert np.array_equal(cloned.student.act(rows), again.student.act(rows))
    assert np.abs(cloned.student.act(rows)).max() <= 1


def test_a_missing_dataset_is_named(minari_folder):
    with pytest.raises(StorageError, match="no Minari dataset 'toy/none-v0'"):
        fdtasil.from_minari("toy/none-v0")
