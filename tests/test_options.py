"""Options of training that users expect: validation, clipping, callbacks, logs, Minari."""

import csv
import inspect
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import QUICK, TOY

import fdtasil
from fdtasil import Fit, Mlp
from fdtasil.errors import FdtasilWarning, SettingError, StorageError
from fdtasil.student.fit_state import FitState
from fdtasil.student.loss import TaylorLoss


def test_validation_keeps_the_best_weights(linear):
    held = {**QUICK, "episodes": 5, "fit": Fit(steps=1000, validation=0.4)}
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
        state.count(torch.ones(len(TaylorLoss._fields)))
        assert state.log(held_out)["validation_loss"] == held_out
    assert state.stale == 1
    state.keep_best()
    assert float(student.weight) == 2.0


def test_the_best_validation_is_remembered_over_an_interruption():
    def fresh():
        student = torch.nn.Linear(1, 1, device="meta").to_empty(device="cpu")
        for weights in student.parameters():
            torch.nn.init.zeros_(weights)
        optimiser = torch.optim.AdamW(student.parameters(), lr=0.0)
        student(torch.ones(1, 1)).sum().backward()
        optimiser.step()
        return student, FitState(student, optimiser)

    def validate(student, state, weight, held_out):
        with torch.no_grad():
            student.weight.fill_(weight)
        state.count(torch.ones(len(TaylorLoss._fields)))
        state.log(held_out)

    student, state = fresh()
    validate(student, state, 1.0, 0.5)
    validate(student, state, 2.0, 0.6)
    again, resumed = fresh()
    resumed.restore(state.to_bytes())
    validate(again, resumed, 3.0, 0.55)
    assert (resumed.step, resumed.stale, len(resumed.history)) == (3, 2, 3)
    resumed.keep_best()
    assert float(again.weight.detach()) == 1.0


def test_an_entry_is_the_mean_of_the_steps_since_the_last_one():
    student = torch.nn.Linear(1, 1, device="meta").to_empty(device="cpu")
    for weights in student.parameters():
        torch.nn.init.zeros_(weights)
    state = FitState(student, torch.optim.AdamW(student.parameters()))
    entries = []
    for losses in ((1.0, 3.0), (5.0,)):
        for loss in losses:
            state.count(torch.full((len(TaylorLoss._fields),), loss))
        entries.append(state.log(None))
    assert [entry["step"] for entry in entries] == [2, 3]
    assert [entry["loss"] for entry in entries] == [2.0, 5.0]
    assert all("validation_loss" not in entry for entry in entries)


def test_patience_stops_early(linear):
    held = Fit(steps=5000, validation=0.5, patience=2, learning_rate=1e-30)
    result = fdtasil.distill(linear, TOY, 0, **{**QUICK, "episodes": 4, "fit": held})
    assert [entry["step"] for entry in result.history] == [100, 200, 300]
    assert result.report["steps"] == 300
    with pytest.raises(SettingError, match="patience=2 without validation"):
        Fit(patience=2)


@pytest.mark.fault(96)
def test_a_single_episode_holds_none_out_and_says_so(linear):
    said = r"validation=0\.3 of a single episode: none is held out"
    held = Fit(steps=40, validation=0.3)
    with pytest.warns(FdtasilWarning, match=said):
        result = fdtasil.distill(linear, TOY, 2, **{**QUICK, "episodes": 1, "fit": held})
    assert "validation_loss" not in result.history[-1]
    assert len(result.report["warnings"]) == 1
    with pytest.warns(FdtasilWarning, match=said):
        fdtasil.distill(dataset=result.dataset, student=Mlp(4), fit=held)


@pytest.mark.fault(96)
def test_a_first_round_of_one_episode_is_no_news(linear, tmp_path):
    """The last round has more of them, and holds some out."""
    run = {**QUICK, "episodes": 3, "fit": Fit(steps=40, validation=0.3)}
    result = fdtasil.distill(linear, TOY, 0, trainer="dagger", **run)
    assert result.report["warnings"] == []
    first, last = result.history
    assert "validation_loss" not in first
    assert last["validation_loss"] != last["loss"]
    read = fdtasil.Distilled.load(result.save(tmp_path / "run"))
    assert read.history == result.history


def test_gradient_clipping_bounds_the_step(linear):
    free = fdtasil.distill(linear, TOY, 2, **QUICK)
    clipped, start = (
        fdtasil.distill(linear, TOY, 2, **{**QUICK, "fit": Fit(steps=40, **change)})
        for change in ({"max_gradient_norm": 1e-9}, {"learning_rate": 1e-30})
    )
    assert free.student.to_bytes() != clipped.student.to_bytes()
    assert start.history[-1]["loss"] > free.history[-1]["loss"]


def test_callbacks_hear_of_everything(linear):
    heard = []
    quick = {**QUICK, "episodes": 6, "fit": Fit(steps=200)}
    result = fdtasil.distill(linear, TOY, 2, trainer="dagger", callback=heard.append, **quick)
    kinds = [event.kind for event in heard]
    assert kinds == ["entry", "entry", "round"] * 3 + ["evaluation"]
    assert [event.round for event in heard if event.kind == "round"] == [0, 1, 2]
    assert [event.step for event in heard if event.kind == "round"] == [200, 400, 600]
    assert heard[-1].evaluation == result.evaluation
    assert [event.entry for event in heard if event.kind == "entry"] == result.history


def test_logs_through_stable_baselines3(linear, tmp_path):
    heard, log = [], fdtasil.Log(tmp_path / "log", "csv", "json", "log", "tensorboard")
    result = fdtasil.distill(linear, TOY, 2, **QUICK, callback=[log, heard.append])
    assert heard[-1].evaluation == result.evaluation
    rows = list(csv.DictReader((tmp_path / "log/progress.csv").open()))
    assert float(rows[0]["train/loss"]) > 0
    lines = [json.loads(line) for line in (tmp_path / "log/progress.json").open()]
    assert "eval/normalized_return" in lines[-1]
    assert list((tmp_path / "log").glob("events.out.tfevents*"))


@pytest.mark.parametrize("formats", [(), ("excel",), ("csv", "excel")])
def test_a_log_of_no_known_format_is_refused(formats, tmp_path):
    with pytest.raises(SettingError, match=r"log formats: (none|excel)"):
        fdtasil.Log(tmp_path, *formats)


def test_a_second_log_spares_the_first(linear, tmp_path):
    """A logger begins its files anew."""
    for _ in range(2):
        fdtasil.distill(linear, TOY, 0, **QUICK, callback=fdtasil.Log(tmp_path / "log", "csv"))
    assert {path.parent.name for path in tmp_path.rglob("progress.csv")} == {"log", "log-2"}


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"validation": 1.0}, "validation=1.0"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm=0.0"),
        ({"order": 3}, "order=3"),
        ({"order": 0}, "order=0"),
        ({"epochs": 3, "steps": 3}, "steps=3, epochs=3"),
    ],
)
def test_a_wrong_setting_of_the_fit_is_named(wrong, found):
    with pytest.raises(SettingError, match=found):
        Fit(**wrong)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"fit": Fit(order=2), "probes": "sphere:3,forward"}, "forward stencil"),
        ({"resume": "nowhere"}, "no run to resume"),
    ],
)
def test_wrong_options_are_named(wrong, found, linear, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingError, match=found):
        fdtasil.distill(linear, TOY, **{"probes": 2, **QUICK, **wrong})
    assert not list(tmp_path.iterdir())


@pytest.mark.fault(192)
def test_a_warning_names_the_callers_own_line(linear):
    """Of whatever calls the library, however deep in it the warning is found."""
    run = {**QUICK, "evaluation_episodes": 1}
    line = inspect.currentframe().f_lineno + 2
    with pytest.warns(FdtasilWarning, match="rounds away") as caught:
        fdtasil.distill(linear, TOY, "sphere:2,radius=3e-7", **run)
    assert {(one.filename, one.lineno) for one in caught} == {(__file__, line)}
    line = inspect.currentframe().f_lineno + 2
    with pytest.warns(FdtasilWarning, match="ends its episodes at 40 steps") as caught:
        fdtasil.evaluate(linear, linear, TOY, episodes=2, horizon=50)
    assert {(one.filename, one.lineno) for one in caught} == {(__file__, line)}


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


@pytest.mark.fault(342)
def test_minari_of_a_run_that_left_out_an_episode(linear, minari_folder):
    whole = fdtasil.distill(linear, TOY, 3, **{**QUICK, "episodes": 3})
    kept = np.flatnonzero(whole.demonstrations.episode != 1)
    states = whole.demonstrations.at(kept)
    some = replace(whole.dataset, demonstrations=states, answers=whole.answers.at(kept))
    fdtasil.to_minari(some, "toy/some-v0")
    again = fdtasil.from_minari("toy/some-v0")
    assert np.unique(again.demonstrations.episode).tolist() == [0, 1]
    assert np.array_equal(again.demonstrations.observations, states.observations)


def test_cloning_from_a_dataset_alone(quick, minari_folder):
    """No expert and no environment: the same student as plain cloning in the run itself."""
    fdtasil.to_minari(quick.dataset, "toy/alone-v0")
    settings = {"student": QUICK["student"], "fit": QUICK["fit"]}
    cloned = fdtasil.distill(dataset=fdtasil.from_minari("toy/alone-v0"), probes=0, **settings)
    again = fdtasil.distill(dataset=quick.dataset, probes=0, **settings)
    rows = quick.demonstrations.observations
    assert np.array_equal(cloned.student.act(rows), again.student.act(rows))
    assert np.abs(cloned.student.act(rows)).max() <= 1


def test_a_missing_dataset_is_named(minari_folder):
    with pytest.raises(StorageError, match="no Minari dataset 'toy/none-v0'"):
        fdtasil.from_minari("toy/none-v0")
