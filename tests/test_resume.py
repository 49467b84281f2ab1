"""A run that was killed goes on, and ends with the bytes of one that never was."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil import Fit
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError, StorageError
from fdtasil.run.folder import RunFolder

FILES = (
    "student.safetensors",
    "student.onnx",
    "demonstrations.npz",
    "progress.csv",
    "config.json",
)
pytestmark = pytest.mark.usefixtures("no_pictures", "many_checkpoints")

RUN = {
    **QUICK,
    "trainer": "dagger",
    "probes": "sphere:2,resample",
    "episodes": 6,
    "fit": Fit(steps=105),  # an entry at 100, one at the end
}


class Stop(Exception):
    """Stands for a kill in the tests that stay in this process."""


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


@pytest.fixture(scope="module")
def golden(expert, tmp_path_factory):
    """The folder of a run that was left alone."""
    folder = tmp_path_factory.mktemp("golden") / "run"
    fdtasil.distill(expert, TOY, out=folder, **RUN)
    return folder


def read(folder):
    return {name: (Path(folder) / name).read_bytes() for name in FILES}


def stop_at(count):
    """A callback that stops the run at its `count`-th event."""
    seen = 0

    def callback(event):
        nonlocal seen
        seen += 1
        if seen == count:
            raise Stop

    return callback


@pytest.mark.fault(115)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 9])
def test_stopped_anywhere_it_ends_with_the_same_bytes(count, expert, golden, tmp_path):
    expected, folder = read(golden), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(count), **RUN)
    result = fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected
    assert result.report["rows_asked_again_after_resuming"] > 0
    uninterrupted = fdtasil.Distilled.load(golden)
    assert result.queries == uninterrupted.queries
    assert not (folder / "checkpoints").exists()


def test_stopped_again_and_again(expert, golden, tmp_path):
    expected, folder = read(golden), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(1), **RUN)
    for count in (1, 2, 1, 3):
        with pytest.raises(Stop):
            fdtasil.distill(expert, TOY, resume=folder, callback=stop_at(count), **RUN)
    fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected


def test_validation_and_best_weights_are_resumed(expert, tmp_path):
    run = {**RUN, "trainer": "bc", "fit": Fit(steps=300, validation=0.3, patience=50)}
    fdtasil.distill(expert, TOY, out=tmp_path / "golden", **run)
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(3), **run)
    fdtasil.distill(expert, TOY, resume=tmp_path / "run", **run)
    assert read(tmp_path / "run") == read(tmp_path / "golden")


def test_a_round_keeps_what_it_adds_and_not_what_was_there_before(expert, tmp_path):
    """The checkpoints of many rounds grew with their square."""
    run = RUN | {"trainer": fdtasil.DAgger(updates=(2, 4, 6, 8)), "episodes": 10}
    # Every round has an entry at 100 steps, one at its end, and the event of the round.
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(15), **run)
    kept = sorted((tmp_path / "run/checkpoints").glob("*/added-0/demonstrations.npz"))
    rows = [len(np.load(path)["values"]) for path in kept]
    assert rows == [2 * QUICK["horizon"]] * 5


@pytest.mark.fault(113)
def test_another_configuration_is_refused_with_the_difference(expert, tmp_path):
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(2), **RUN)
    other = {**RUN, "seed": 4, "fit": replace(RUN["fit"], weight_decay=0.5)}
    with pytest.raises(
        SettingError, match=r"fit\.weight_decay was 0\.01, is 0\.5; seed was 0, is 4"
    ):
        fdtasil.distill(expert, TOY, resume=tmp_path / "run", **other)
    with pytest.raises(SettingError, match="not ended"):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", **RUN)
    with pytest.raises(SettingError, match="no run to resume"):
        fdtasil.distill(expert, TOY, resume=tmp_path / "nothing", **RUN)


def test_a_finished_run_is_read_back(expert, tmp_path):
    first = fdtasil.distill(expert, TOY, out=tmp_path / "run", **RUN)
    again = fdtasil.distill(expert, TOY, resume=tmp_path / "run", **RUN)
    assert again.evaluation == first.evaluation
    assert again.student.to_bytes({}) == first.student.to_bytes({})


@pytest.mark.fault(116)
def test_a_broken_checkpoint_is_named_and_an_earlier_one_used(expert, golden, tmp_path):
    expected, folder = read(golden), tmp_path / "run"
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=folder, callback=stop_at(5), **RUN)
    (newest,) = sorted(folder.glob("checkpoints/1/training-*"))
    weights = newest / "fit.safetensors"
    weights.write_bytes(weights.read_bytes()[:-3])
    with pytest.warns(FdtasilWarning, match=r"fit\.safetensors changed after writing"):
        fdtasil.distill(expert, TOY, resume=folder, **RUN)
    assert read(folder) == expected


@pytest.mark.slow
@pytest.mark.parametrize("probes", ["sphere:2,forward", "sphere:12,forward,resample", "fresh:12"])
def test_a_run_that_asked_all_it_may_is_resumed(probes, expert, tmp_path):
    """What was asked again is no part of the budget, and the budget may be another."""
    run = {**RUN, "trainer": "bc", "probes": probes}
    whole = fdtasil.distill(expert, TOY, **run).report["predicted_queries"]
    budget = sum(whole.values())
    for name, later in (("same", budget), ("higher", 2 * budget)):
        folder = tmp_path / name
        with pytest.raises(Stop):
            fdtasil.distill(
                expert, TOY, out=folder, callback=stop_at(2), max_queries=budget, **run
            )
        report = fdtasil.distill(expert, TOY, resume=folder, max_queries=later, **run).report
        assert report["rows_asked_again_after_resuming"] > 0


def test_warnings_of_the_interrupted_run_are_kept(expert, tmp_path):
    run = {**RUN, "trainer": "bc", "probes": "sphere:2,radius=3e-7"}  # lost in rounding
    with warnings.catch_warnings(record=True, action="always") as first, pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", callback=stop_at(2), **run)
    with warnings.catch_warnings(record=True, action="always") as again:
        report = fdtasil.distill(expert, TOY, resume=tmp_path / "run", **run).report
    said = [" ".join(str(one.message) for one in some) for some in (first, again)]
    assert ["rounds away" in text for text in said] == [True, False]
    assert any("rounds away" in note for note in report["warnings"])


def test_a_resumed_run_stays_in_its_own_folder(expert, tmp_path):
    with pytest.raises(SettingError, match="leave out= out"):
        fdtasil.distill(expert, TOY, out=tmp_path / "a", resume=tmp_path / "b", **RUN)


@pytest.mark.slow
@pytest.mark.parametrize("kept", [0, 1, 3])
def test_stopped_while_the_probes_are_asked_nothing_is_lost(kept, tmp_path, monkeypatch):
    """Demonstrations are kept before the probes, and the answers on the way, block by block."""
    monkeypatch.setattr("fdtasil.probes.answers._ROWS", 500)
    monkeypatch.setattr(RunFolder, "due", property(lambda folder: folder._path is not None))
    run = {**QUICK, "episodes": 5, "horizon": 40, "probes": "sphere:10,forward"}
    blocks, last, acting = 0, None, 0

    def expert(observations):
        nonlocal blocks, acting
        if len(observations) == 500:  # nothing else is as long
            if blocks == last:
                raise KeyboardInterrupt
            blocks += 1
        acting += len(observations) < 10
        return observations[:, :2] * 0.1

    whole = fdtasil.distill(expert, TOY, out=tmp_path / "whole", **run)
    assert (blocks, acting > 40) == (4, True)
    blocks, last = 0, kept
    with pytest.raises(KeyboardInterrupt):
        fdtasil.distill(expert, TOY, out=tmp_path / "run", **run)
    blocks, last, acting = 0, None, 0
    resumed = fdtasil.distill(expert, TOY, resume=tmp_path / "run", **run)
    assert blocks == 4 - kept
    assert read(tmp_path / "run") == read(tmp_path / "whole")
    assert resumed.queries == whole.queries


@pytest.mark.filterwarnings(
    "ignore:.*(asked|observations) (twice|alone)", "ignore:.*has changed during the run"
)
def test_an_expert_that_does_not_repeat_itself_is_no_other_one(tmp_path):
    """The gate was told to let it through."""
    random, run = np.random.default_rng(0), {**QUICK, "probes": 0, "force": True}

    def noisy(rows):
        return 0.5 * np.tanh(rows[:, :2]) + random.normal(0, 0.01, (len(rows), 2))

    with pytest.raises(Stop):
        fdtasil.distill(noisy, TOY, out=tmp_path, callback=stop_at(1), **run)
    fdtasil.distill(noisy, TOY, resume=tmp_path, **run)


class WithDerivatives:
    """A linear law that says its own derivatives."""

    def predict(self, observations, deterministic=True):
        return observations @ GAIN.T, None

    def jacobian(self, observations):
        return np.broadcast_to(GAIN, (len(observations), *GAIN.shape))


@pytest.mark.slow
@pytest.mark.fault(236)
@pytest.mark.parametrize("count", [3, 5])
def test_own_derivatives_are_compared_once_over_interruptions(count, tmp_path):
    run = {**RUN, "probes": "jacobian"}
    whole = fdtasil.distill(WithDerivatives(), TOY, out=tmp_path / "golden", **run)
    with pytest.raises(Stop):
        fdtasil.distill(
            WithDerivatives(), TOY, out=tmp_path / "run", callback=stop_at(count), **run
        )
    most = sum(whole.queries.values())
    result = fdtasil.distill(
        WithDerivatives(), TOY, resume=tmp_path / "run", max_queries=most, **run
    )
    assert result.queries == whole.queries
    assert result.student.to_bytes() == whole.student.to_bytes()


@pytest.mark.fault(237)
def test_a_warning_is_not_said_again_when_probes_are_asked_on(tmp_path, monkeypatch):
    """Stopped while they are asked; the warning is of where they are asked."""
    monkeypatch.setattr(RunFolder, "due", property(lambda folder: folder._path is not None))
    run = {**QUICK, "episodes": 8, "horizon": 40, "probes": "sphere:10,raw,radius=1.2e-7"}
    asked = 0

    def law(rows):
        nonlocal asked
        asked += len(rows)
        if asked > limit:
            raise TimeoutError("too late")
        return rows @ GAIN.T

    limit = np.inf
    with pytest.warns(FdtasilWarning, match="rounds away"):
        whole = fdtasil.distill(law, TOY, out=tmp_path / "golden", **run)
    limit, asked = sum(whole.queries.values()) - 1200, 0
    with pytest.raises(ExpertError), pytest.warns(FdtasilWarning):
        fdtasil.distill(law, TOY, out=tmp_path / "run", **run)
    assert list((tmp_path / "run" / "checkpoints").rglob("asked-*"))
    limit = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = fdtasil.distill(law, TOY, resume=tmp_path / "run", **run)
    assert result.report["warnings"] == whole.report["warnings"]


@pytest.mark.fault(303)
def test_a_run_whose_checkpoints_could_not_be_dropped_is_finished(expert, tmp_path, monkeypatch):
    run = {**QUICK, "progress": False}
    first = fdtasil.distill(expert, TOY, 2, out=tmp_path / "run", **run)
    left = tmp_path / "run" / "checkpoints"
    left.mkdir()
    (left / "config.json").write_bytes((tmp_path / "run" / "config.json").read_bytes())
    told = []
    again = fdtasil.distill(expert, TOY, 2, resume=tmp_path / "run", callback=told.append, **run)
    assert told == []
    assert again.student.to_bytes() == first.student.to_bytes()


@pytest.mark.fault(303)
def test_a_finished_run_is_not_handed_out_for_the_one_that_begins_in_its_place(
    expert, tmp_path, monkeypatch
):
    run = {**QUICK, "progress": False}
    fdtasil.distill(expert, TOY, 2, out=tmp_path / "run", **run)

    def full(folder, files):
        raise StorageError("no space", "room", "free some")

    with monkeypatch.context() as patch:
        patch.setattr("fdtasil.run.folder.write_folder", full)
        with (
            pytest.raises(StorageError, match="no space"),
            pytest.warns(FdtasilWarning, match="holds a finished run, which this one replaces"),
        ):
            fdtasil.distill(expert, TOY, 0, seed=7, out=tmp_path / "run", **run)
    assert (tmp_path / "run" / "checkpoints" / "config.json").exists()
    again = fdtasil.distill(expert, TOY, 0, seed=7, resume=tmp_path / "run", **run)
    assert again.settings["seed"] == 7


@pytest.mark.fault(313)
def test_a_run_that_has_begun_over_a_finished_one_is_told_of(quick, tmp_path, linear):
    folder = quick.save(tmp_path / "run")
    fdtasil.Distilled.load(folder)
    left = folder / "checkpoints"
    left.mkdir()
    (left / "config.json").write_bytes((folder / "config.json").read_bytes())
    fdtasil.Distilled.load(folder)  # its own, which could not be dropped
    other = json.loads((folder / "config.json").read_text()) | {"seed": 9}
    (left / "config.json").write_text(json.dumps(other))
    with pytest.warns(FdtasilWarning, match="another one that has not ended"):
        read = fdtasil.Distilled.load(folder)
    assert read.student.to_bytes() == quick.student.to_bytes()
    with pytest.warns(FdtasilWarning, match="another one that has not ended"):
        fdtasil.evaluate(folder, linear, TOY, episodes=2, horizon=5, progress=False)
