"""Students of several sizes from one run's answers: nothing recorded again, resumable, judged."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, FitError, SettingError
from fdtasil.results.shrunk import Candidate
from fdtasil.run.elsewhere import elsewhere, side_by_side

pytestmark = pytest.mark.usefixtures("no_pictures")
SIZES = [(2,), (16, 16)]
FAST = {"sizes": SIZES, "evaluation_episodes": 4, "horizon": 30, "progress": False}


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


@pytest.fixture(scope="module")
def run():
    return fdtasil.distill(
        law, TOY, 5, **{**QUICK, "episodes": 3, "horizon": 30, "fit": fdtasil.Fit(steps=600)}
    )


@pytest.mark.slow
def test_the_smallest_that_keeps_the_level(run, tmp_path):
    asked = []

    def counted(rows):
        asked.append(len(rows))
        return law(rows)

    fit = fdtasil.Fit(steps=1500)
    found = fdtasil.shrink(run, counted, TOY, keep=0.8, fit=fit, out=tmp_path / "s", **FAST)
    names = [(one.name, one.cloned) for one in found.candidates]
    assert names == [(n, c) for n in ("2 relu", "16x16 relu") for c in (False, True)]
    assert found.smallest is not None
    assert found.smallest.keeps(0.8)
    assert found.result.evaluation.ci95 == found.smallest.ci95
    assert found.result.report["size"]["student"]["bytes"] == found.smallest.bytes
    # Answers are those of the run: only acting and the gate ask, and never a probe.
    assert found.result.queries["probe"] == found.result.queries["act"] == 0
    assert "<" in str(found)
    plain = found.smallest_cloned
    assert f"; cloned plainly: {plain.name if plain else 'none'}\n" in str(found)
    table = json.loads((tmp_path / "s" / "sizes.json").read_text())
    assert [one["bytes"] for one in table["candidates"]] == [o.bytes for o in found.candidates]
    assert (tmp_path / "s" / "sizes.png").stat().st_size > 1000

    # It is judged once more, from starts that it was not chosen by.
    assert found.confirmed.episodes == found.result.evaluation.episodes
    assert found.confirmed.expert_return != found.result.evaluation.expert_return
    assert f"from other starts: {found.confirmed.normalized_return:.3f}" in str(found)
    assert table["confirmed"]["normalized_return"] == found.confirmed.normalized_return

    # What is finished is taken as it is: nobody is asked but for that last comparison.
    before = len(asked)
    again = fdtasil.shrink(run, counted, TOY, keep=0.8, fit=fit, out=tmp_path / "s", **FAST)
    assert sum(asked[before:]) <= 2 * FAST["evaluation_episodes"] * FAST["horizon"] + 400
    assert again.candidates == found.candidates
    assert again.confirmed == found.confirmed


def test_none_that_keeps_it(run):
    fit = fdtasil.Fit(steps=2)
    with pytest.warns(FdtasilWarning, match="no student of 2 keeps 100%"):
        found = fdtasil.shrink(
            run, law, TOY, keep=1.0, fit=fit, cloned=False, **{**FAST, "sizes": [(2,), (3,)]}
        )
    assert found.result is None
    assert found.smallest is None
    assert "no student" in str(found)


@pytest.mark.torture
def test_side_by_side_they_are_the_same(tmp_path):
    expert = str(mlp_onnx(tmp_path / "e.onnx"))
    run = fdtasil.distill(expert, TOY, 3, **QUICK)
    options = {**FAST, "fit": fdtasil.Fit(steps=20), "cloned": False, "keep": 0.0}
    alone = fdtasil.shrink(run, expert, TOY, **options, out=tmp_path / "one")
    pair = fdtasil.shrink(run, expert, TOY, **options, out=tmp_path / "two", workers=2)
    for one, other in zip(alone.candidates, pair.candidates, strict=True):
        assert one.ci95 == other.ci95
    names = ("student.onnx", "student.safetensors")
    for name in names:
        parts = [(tmp_path / f / "2-relu" / name).read_bytes() for f in ("one", "two")]
        assert parts[0] == parts[1]


@pytest.mark.parametrize(
    "wrong",
    [
        *({"keep": 2.0}, {"activations": ["gellu"]}, {"workers": 2}),
        *({"sizes": sizes} for sizes in ([], [(0,)], 8, (64, 64), "ab")),
    ],
)
def test_what_can_not_be_shrunk(run, wrong):
    with pytest.raises(SettingError):
        fdtasil.shrink(run, law, TOY, **{**FAST, **wrong})


def test_the_command(tmp_path, inside):
    expert = mlp_onnx(tmp_path / "e.onnx")
    fdtasil.distill(str(expert), TOY, 2, **QUICK).save(tmp_path / "run")
    line = ["shrink", tmp_path / "run", expert, TOY, "--widths", "4", "--keep", "0.0"]
    done = inside(*line, "--evaluation-episodes", "2", "--no-cloned", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "4x4 relu" in done.stdout
    assert (tmp_path / "run-shrunk" / "4x4-relu" / "student.onnx").exists()


def test_micro():
    result = fdtasil.distill(law, TOY, 2, **{**QUICK, "student": "micro"})
    assert result.student.architecture == fdtasil.Mlp((64, 64), "relu")
    with pytest.raises(SettingError, match="micro"):
        fdtasil.distill(law, TOY, 2, **{**QUICK, "student": "macro"})


@pytest.mark.fault(257)
def test_another_call_in_the_same_folder_is_refused(run, tmp_path):
    options = {**FAST, "fit": fdtasil.Fit(steps=5), "cloned": False, "keep": 0.0}
    fdtasil.shrink(run, law, TOY, **options, out=tmp_path / "s")
    with pytest.raises(SettingError, match="seed was 0, is 1"):
        fdtasil.shrink(run, law, TOY, **options, seed=1, out=tmp_path / "s")
    with pytest.raises(SettingError, match=r"fit\.steps was 5, is 6"):
        fdtasil.shrink(
            run, law, TOY, **{**options, "fit": fdtasil.Fit(steps=6)}, out=tmp_path / "s"
        )


@pytest.mark.slow
@pytest.mark.fault(257)
@pytest.mark.fault(352)
def test_a_killed_one_goes_on(run, tmp_path, monkeypatch):
    """Within a student's training, and to the same bytes."""
    options = {**FAST, "fit": fdtasil.Fit(steps=300), "cloned": False, "keep": 0.0}
    whole = fdtasil.shrink(run, law, TOY, **options, out=tmp_path / "whole")
    monkeypatch.setattr("fdtasil.run.folder.CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as patched:
        patched.setattr("fdtasil.run.pipeline.evaluate_pair", _interrupt)
        with pytest.raises(KeyboardInterrupt) as killed:
            fdtasil.shrink(run, law, TOY, **options, out=tmp_path / "killed")
    (note,) = killed.value.__notes__
    assert note.endswith("killed: the same call again goes on with it")
    again = fdtasil.shrink(run, law, TOY, **options, out=tmp_path / "killed")
    assert [one.ci95 for one in again.candidates] == [one.ci95 for one in whole.candidates]
    parts = [(tmp_path / f / "2-relu" / "student.onnx").read_bytes() for f in ("whole", "killed")]
    assert parts[0] == parts[1]


def _interrupt(*_):
    raise KeyboardInterrupt


def test_cloned_ones_train_as_long_as_those_that_ask_anew(tmp_path):
    expert = str(mlp_onnx(tmp_path / "e.onnx"))
    fit = fdtasil.Fit(epochs=3)
    run = fdtasil.distill(expert, TOY, "fresh", **{**QUICK, "fit": fit})
    fdtasil.shrink(run, expert, TOY, fit=fit, keep=0.0, out=tmp_path / "s", **FAST)
    students = [fdtasil.Distilled.load(tmp_path / "s" / f"2-relu{c}") for c in ("", "-cloned")]
    asked, plain = (one.report["steps"] for one in students)
    assert asked == plain
    assert students[1].settings["probes"] == "none"


@pytest.mark.torture
def test_a_script_without_a_guard_runs_once(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    fdtasil.distill(str(expert), TOY, 2, **QUICK).save(tmp_path / "run")
    script = tmp_path / "script.py"
    script.write_text(f"""
import fdtasil
print("begun")
found = fdtasil.shrink(
    "run", "e.onnx", "{TOY}", sizes=[(2,), (3,)], cloned=False, workers=2,
    keep=0.0, horizon=20, evaluation_episodes=2, fit=fdtasil.Fit(steps=5),
)
print(len(found.candidates))
""")
    paths = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=paths, capture_output=True, text=True
    )
    assert done.stdout.split() == ["begun", "2"], done.stderr


@pytest.mark.torture
def test_a_failure_side_by_side_ends_the_others():
    begun = time.monotonic()
    with pytest.raises(SettingError, match="the first"):
        for _ in side_by_side(str, _fail_or_sleep, [0, 60, 60, 60], 2):
            pass
    assert time.monotonic() - begun < 30


def _fail_or_sleep(seconds):
    if not seconds:
        raise SettingError("the first", "another", "none")
    time.sleep(seconds)


def test_students_see_what_the_runs_student_saw():
    some = fdtasil.distill(law, TOY, 2, student_obs=[0, 2, 3], **QUICK)
    options = {**FAST, "sizes": [(3,)], "fit": fdtasil.Fit(steps=5), "keep": 0.0}
    found = fdtasil.shrink(some, law, TOY, **options)
    assert found.result.student.observation_size == 3
    past = fdtasil.distill(law, TOY, 2, history=2, **QUICK)
    found = fdtasil.shrink(past, law, TOY, **options)
    assert found.result.student.observation_size == past.student.observation_size
    through = fdtasil.distill(law, TOY, 2, student_obs=lambda rows: rows[:, :2], **QUICK)
    with pytest.raises(SettingError, match="sees through"):
        fdtasil.shrink(through, law, TOY, **options)


@pytest.mark.fault(267)
def test_what_was_distilled_by_force_is_shrunk_by_force():
    def wild(rows):
        return 9 * law(rows)  # beyond the bounds, which the gate refuses

    with pytest.warns(FdtasilWarning, match="forced"):
        some = fdtasil.distill(wild, TOY, 2, force=True, **QUICK)
    options = {**FAST, "sizes": [(3,)], "fit": fdtasil.Fit(steps=5), "keep": 0.0}
    with pytest.raises(ExpertError, match="force=True"):
        fdtasil.shrink(some, wild, TOY, **options)
    with pytest.warns(FdtasilWarning, match="forced"):
        fdtasil.shrink(some, wild, TOY, **options, force=True)
    with pytest.warns(FdtasilWarning, match="forced"):
        fdtasil.diagnose(some, wild, TOY, episodes=2, horizon=20, force=True)


def test_a_run_that_was_made_anew_is_told_what_to_remove(run, tmp_path):
    options = {**FAST, "fit": fdtasil.Fit(steps=5), "cloned": False, "keep": 0.0}
    fdtasil.shrink(run, law, TOY, **options, out=tmp_path / "s")
    other = fdtasil.distill(law, TOY, 5, **{**QUICK, "episodes": 3, "horizon": 30, "seed": 3})
    options["seed"] = 0
    with pytest.raises(SettingError, match=r"dataset was [0-9a-f]{12}\.\.\., .*\n.*\n.*remove "):
        fdtasil.shrink(other, law, TOY, **options, out=tmp_path / "s")


def test_where_no_share_means_anything_none_is_chosen(run, monkeypatch):
    monkeypatch.setattr("fdtasil.run.shrinking._candidate", _unknown)
    options = {**FAST, "sizes": [(3,)], "fit": fdtasil.Fit(steps=5)}
    found = fdtasil.shrink(run, law, TOY, **options)
    assert "means nothing here" in str(found)
    assert "no student of these" not in str(found)
    assert found.draw().startswith(b"\x89PNG")


def _unknown(job, _):
    plain = job.cloned is not None
    return Candidate(job.hidden, job.activation, plain, 1, 1, 1.0, None, None, 1.0)


def test_another_environment_than_the_runs_is_told_of(linear):
    gravity = fdtasil.Environment("Pendulum-v1", {"g": 5.0})
    swing = lambda x: np.clip(-8 * x[:, 1:2] - 2 * x[:, 2:], -2, 2)  # noqa: E731
    run = {"episodes": 1, "horizon": 20, "evaluation_episodes": 2, "progress": False}
    result = fdtasil.distill(swing, gravity, 2, fit=fdtasil.Fit(steps=5), **run)
    small = {"sizes": [(4,)], "fit": fdtasil.Fit(steps=5), "evaluation_episodes": 2}
    with pytest.warns(FdtasilWarning, match="distilled in another Pendulum-v1"):
        fdtasil.shrink(result, swing, "Pendulum-v1", keep=0.01, progress=False, **small)


@pytest.mark.fault(344)
def test_nobody_to_judge_by_is_refused_at_once(run, tmp_path):
    with pytest.raises(SettingError, match="horizon") as early:
        fdtasil.shrink(run, law, TOY, **{**FAST, "horizon": -1}, out=tmp_path / "none")
    assert not getattr(early.value, "__notes__", [])
    for expert, env in ((None, TOY), (law, None)):
        with pytest.raises(SettingError, match="to judge students with"):
            fdtasil.shrink(run, expert, env, **FAST)


@pytest.mark.fault(349)
def test_students_are_trained_as_the_runs_was(run):
    fit = fdtasil.Fit(epochs=2, weight=0.1, batch_size=50, learning_rate=0.002)
    one = fdtasil.distill(law, TOY, 2, **{**QUICK, "fit": fit})
    options = {**FAST, "sizes": np.array([[3]]), "cloned": False, "keep": 0.0}
    found = fdtasil.shrink(one, law, TOY, **options)
    assert found.result.settings["fit"] == one.settings["fit"]
    for anew in (False, True):
        for said in (fdtasil.Fit(), fdtasil.Fit(steps=40), fit):
            assert fdtasil.Fit.from_json(said.to_json(anew=anew), anew=anew) == said


@pytest.mark.fault(345)
def test_what_can_not_be_sent_is_said_before_anything_is_trained(run, tmp_path):
    expert = str(mlp_onnx(tmp_path / "e.onnx"))
    env = fdtasil.Environment(TOY, reset_options={"f": lambda: 0})
    with pytest.raises(SettingError, match="can't be sent"):
        fdtasil.shrink(run, expert, env, **FAST, workers=2)


@pytest.mark.fault(345)
def test_a_process_that_ends_before_it_is_called_is_named(monkeypatch):
    monkeypatch.setattr("fdtasil.run.elsewhere.sys.executable", "/bin/false")
    with elsewhere("the student", len, bytes(2**24)) as call, pytest.raises(FitError) as ended:
        call.outcome()
    assert "the student ended with code 1" in str(ended.value)
