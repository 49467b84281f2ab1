"""Stored answers train other students without a question; students may see less."""

import importlib
import io
import json
import re
import warnings
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from toy_forms import ACTIONS, OBSERVATIONS, InForm, in_form

import fdtasil
from fdtasil import Fit, Mlp
from fdtasil.demonstrations.dataset import Dataset, load_dataset
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError, StorageError
from fdtasil.probes.answers import Answers
from fdtasil.results.card import card_of
from fdtasil.results.page import page_of
from fdtasil.student.view import View, sees_as


def never(observations):
    raise AssertionError("asked")


pytestmark = pytest.mark.usefixtures("no_pictures")

SMALL = {"student": Mlp(4), "fit": Fit(steps=30)}


@pytest.fixture
def run(quick_folder):
    """A run's folder, which is not to be changed."""
    return quick_folder


@pytest.mark.parametrize("kind", ["folder", "file", "dataset"])
def test_another_student_without_one_question(kind, run, quick):
    source = {"folder": run, "file": run / "demonstrations.npz", "dataset": quick.dataset}[kind]
    result = fdtasil.distill(dataset=source, student=Mlp((4, 4)), fit=Fit(steps=30))
    assert sum(result.queries.values()) == 0
    assert result.evaluation is None
    assert result.student.architecture == Mlp((4, 4))
    assert result.history[0]["derivative_error"] > 0
    assert result.report["probes"] == quick.report["probes"]


def test_the_same_training_as_the_run_itself(run, quick):
    again = fdtasil.distill(dataset=run, student=QUICK["student"], fit=QUICK["fit"])
    assert again.student.to_bytes() == quick.student.to_bytes()


def test_only_the_evaluation_asks(run, linear):
    result = fdtasil.distill(linear, TOY, dataset=run, **QUICK)
    assert result.queries["act"] == result.queries["label"] == result.queries["probe"] == 0
    assert result.queries["evaluate"] > 0
    assert result.evaluation.episodes == 2


def test_demonstrations_of_version_1_are_read(linear):
    """They have one gain for all displacements."""
    given = fdtasil.distill(linear, TOY, 3, **QUICK).dataset
    arrays = dict(np.load(io.BytesIO(given.to_bytes())))
    about = json.loads(arrays["about"].tobytes()) | {"version": 1}
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    arrays["gain"] = arrays.pop("gains")[0]
    target = io.BytesIO()
    np.savez(target, **arrays)
    assert Dataset.from_bytes(target.getvalue()).to_bytes() == given.to_bytes()


def test_stored_probes_can_be_left_or_added(run, linear, tmp_path):
    plain = fdtasil.distill(dataset=run, probes=0, **SMALL)
    assert plain.history[0]["derivative_error"] == 0
    bare = plain.save(tmp_path / "bare")
    with pytest.raises(SettingError, match="and no expert"):
        fdtasil.distill(dataset=Dataset.from_bytes(_without_answers(run)), **SMALL)
    added = fdtasil.distill(linear, dataset=Dataset.from_bytes(_without_answers(run)), **SMALL)
    assert added.queries["probe"] == 10 * len(added.demonstrations)
    assert load_dataset(bare).answers is not None  # what was asked is never thrown away


def _without_answers(run):
    whole = load_dataset(run)
    bounds = whole.low, whole.high
    return Dataset(whole.demonstrations, None, None, *bounds, whole.environment).to_bytes()


def test_a_dataset_reads_back(quick):
    again = Dataset.from_bytes(quick.dataset.to_bytes())
    assert again.probes == quick.dataset.probes
    assert again.to_bytes() == quick.dataset.to_bytes()


def test_missing_parts_are_named(run, linear, tmp_path):
    with pytest.raises(SettingError, match="no expert"):
        fdtasil.distill(env=TOY)
    with pytest.raises(SettingError, match="no env"):
        fdtasil.distill(linear)
    with pytest.raises(SettingError, match="write dataset="):
        fdtasil.distill(load_dataset(run), probes=0)
    with pytest.raises(SettingError, match="sizes"):
        fdtasil.distill(env="Pendulum-v1", dataset=run)
    with pytest.raises(StorageError, match="can't be read"):
        fdtasil.distill(dataset=tmp_path / "nothing")


# --- the student sees less than the expert


def seen(observations):
    return observations[:, :4]


MASK = np.array([True, True, True, True, False])


@pytest.mark.slow
@pytest.mark.parametrize("student_obs", [range(4), seen, (3, 1, 0, 2), MASK])
@pytest.mark.parametrize("trainer", ["bc", "dagger", "dart"])
def test_the_student_sees_less(student_obs, trainer, linear):
    quick = {**QUICK, "episodes": 3}
    result = fdtasil.distill(linear, TOY, 3, student_obs=student_obs, trainer=trainer, **quick)
    assert result.student.observation_size == 4
    assert result.demonstrations.observations.shape[1] == 5
    assert result.evaluation.normalized_return > 0.5
    assert len(result.export_bytes("student.onnx")) > 100


def test_probes_follow_what_the_student_sees(linear):
    blind = fdtasil.distill(linear, TOY, "basis", student_obs=[0, 2], **QUICK)
    moved = np.flatnonzero(np.abs(blind.answers.displacements).sum(axis=0))
    assert moved.tolist() == [0, 2]
    assert blind.queries["probe"] == 2 * len(blind.demonstrations)


def test_indices_and_the_same_function_give_the_same_student(linear):
    chosen = fdtasil.distill(linear, TOY, 3, student_obs=range(4), **QUICK)
    mapped = fdtasil.distill(linear, TOY, 3, student_obs=seen, **QUICK)
    rows = chosen.demonstrations.observations[:, :4]
    assert np.allclose(chosen.student.act(rows), mapped.student.act(rows), atol=1e-3)


def test_a_curved_function_needs_the_forward_stencil(linear):
    def curved(observations):
        return np.concatenate([observations[:, :4], observations[:, :1] ** 2], axis=1)

    result = fdtasil.distill(linear, TOY, 3, student_obs=curved, **QUICK)
    assert result.student.observation_size == 5
    with pytest.raises(SettingError, match="curved"):
        fdtasil.distill(linear, TOY, "sphere:3,central", student_obs=curved, **QUICK)


@pytest.mark.fault(319)
@pytest.mark.parametrize(
    ("offset", "deviation"), [(0.0, 1.0), (1.0, 3e-4), (256.0, 0.05), (2048.0, 0.5)]
)
def test_an_offset_that_a_function_takes_away_is_no_curve(offset, deviation):
    for seed in range(5):
        random = np.random.default_rng(seed)
        states = (offset + deviation * random.standard_normal((300, 3))).astype(np.float32)
        bank = 0.3 * deviation * random.standard_normal((10, 3)).astype(np.float32)
        numbers = np.tile(np.arange(10, dtype=np.int32), (300, 1))
        around = Answers(bank, numbers, np.zeros((300, 10, 2, 1)), np.ones(10))
        view = View.of(lambda rows: rows[:, :2] - np.float32(offset), states)
        view.answers(around, states, (1.0, -1.0))
        curve = View.of(lambda rows: ((rows - np.float32(offset)) / deviation) ** 2, states)
        with pytest.raises(SettingError, match="a curved function"):
            curve.answers(around, states, (1.0, -1.0))


@pytest.mark.fault(319)
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_function_is_curved_in_every_unit(unit):
    states = np.random.default_rng(0).uniform(0.1, 1, (50, 2)).astype(np.float32)
    numbers = np.tile(np.array([0, 1], np.int32), (50, 1))
    moved, values = np.eye(2, dtype=np.float32), np.zeros((50, 2, 2, 1))
    around = Answers(moved, numbers, values, np.ones(2))
    line = View.of(lambda rows: unit * (rows[:, :1] + rows[:, 1:]), states)
    line.answers(around, states, (1.0, -1.0))
    curve = View.of(lambda rows: unit * rows**2, states)
    with pytest.raises(SettingError, match="a curved function"):
        curve.answers(around, states, (1.0, -1.0))


@pytest.mark.parametrize(
    "wrong",
    [
        [5],
        [-1],
        [],
        [0.5],
        slice(2),
        lambda x: x[:2],
        lambda x: x - x.mean(axis=0),
        lambda x: x[:, 0],
    ],
)
def test_a_wrong_view_is_refused(wrong):
    states = np.random.default_rng(0).standard_normal((9, 5)).astype(np.float32)
    with pytest.raises(SettingError, match="student_obs"):
        View.of(wrong, states)


@pytest.mark.fault(275)
def test_a_view_that_cuts_off_where_probes_lead_is_no_identity():
    """No demonstrated state is cut, as with the limits of a normaliser; moved ones are."""
    cut = lambda rows: np.clip(rows, -1, 1)  # noqa: E731
    states = np.random.default_rng(0).uniform(0.1, 1, (50, 2)).astype(np.float32)
    numbers = np.tile(np.array([0, 1], np.int32), (50, 1))
    around = Answers(np.eye(2, dtype=np.float32), numbers, np.zeros((50, 2, 1, 1)), np.ones(2))
    view = View.of(cut, states)
    found = view.answers(around, states, (1.0,))
    trained_at = states[:, None] + found.displacements[found.numbers]
    assert trained_at == pytest.approx(cut(states[:, None] + np.eye(2)), abs=1e-6)
    with pytest.raises(SettingError, match="a curved function"):
        view.answers(around, states, (1.0, -1.0))


def test_a_chosen_view_survives_saving(linear, tmp_path):
    result = fdtasil.distill(linear, TOY, 3, student_obs=[3, 0], **QUICK)
    again = fdtasil.Distilled.load(result.save(tmp_path))
    assert again.view.columns == (3, 0)
    rows = result.demonstrations.observations
    assert np.array_equal(again.student.act(again.view.look(rows)), result.student.act(rows[:, [3, 0]]))  # fmt: skip  # noqa: E501


def test_a_student_that_sees_less_is_judged_from_its_file(linear, tmp_path):
    result = fdtasil.distill(linear, TOY, 3, student_obs=[0, 1, 2, 3], **QUICK)
    path = result.to_onnx(tmp_path / "student.onnx")
    found = fdtasil.evaluate(path, linear, TOY, episodes=2, horizon=20)
    assert found.normalized_return == pytest.approx(result.evaluation.normalized_return, abs=1e-3)
    judged = fdtasil.evaluate(
        result.student, linear, TOY, episodes=2, horizon=20, student_obs=[0, 1, 2, 3]
    )
    assert judged.normalized_return == pytest.approx(found.normalized_return, abs=1e-3)


def test_a_function_as_view_is_given_again_to_load(linear, tmp_path):
    result = fdtasil.distill(linear, TOY, 3, student_obs=seen, **QUICK)
    folder = result.save(tmp_path)
    again = fdtasil.Distilled.load(folder, student_obs=seen)
    assert again.export_bytes("student.onnx") == result.export_bytes("student.onnx")
    with pytest.raises(SettingError, match="the function seen"):
        fdtasil.Distilled.load(folder).export_bytes("student.onnx")


@pytest.mark.fault(323)
def test_a_view_that_is_given_to_load_is_the_one_of_the_run(linear, tmp_path):
    folder = fdtasil.distill(linear, TOY, 0, student_obs=seen, **QUICK).save(tmp_path / "seen")
    with pytest.raises(SettingError, match="3 numbers"):
        fdtasil.Distilled.load(folder, student_obs=lambda rows: rows[:, :3])
    folder = fdtasil.distill(linear, TOY, 0, student_obs=[0, 1], **QUICK).save(tmp_path / "some")
    assert fdtasil.Distilled.load(folder, student_obs=[0, 1]).view.columns == (0, 1)
    with pytest.raises(SettingError, match="as the student was trained"):
        fdtasil.Distilled.load(folder, student_obs=[2, 3])
    folder = fdtasil.distill(linear, TOY, 0, **QUICK).save(tmp_path / "whole")
    fdtasil.Distilled.load(folder, student_obs=range(5))
    with pytest.raises(SettingError, match="the whole observation"):
        fdtasil.Distilled.load(folder, student_obs=range(4))


@pytest.mark.fault(332)
def test_a_result_is_judged_through_what_it_sees_alone(linear, tmp_path):
    about = {"episodes": 2, "horizon": 20}
    result = fdtasil.distill(linear, TOY, 0, student_obs=[0, 1], **QUICK)
    for same in ([0, 1], lambda rows: rows[:, :2]):
        assert fdtasil.evaluate(result, linear, TOY, student_obs=same, **about) == (
            fdtasil.evaluate(result, linear, TOY, **about)
        )
    folder, file = result.save(tmp_path / "run"), result.export(tmp_path / "s.onnx")
    for policy in (result, folder, file):
        for other in ([2, 3], [1, 0], [0, 1, 2], lambda rows: rows[:, 2:4]):
            with pytest.raises(SettingError, match=r"as the (student was trained|file says)"):
                fdtasil.evaluate(policy, linear, TOY, student_obs=other, **about)
    whole = fdtasil.distill(linear, TOY, 0, **QUICK)
    with pytest.raises(SettingError, match="the whole observation: 5 numbers"):
        fdtasil.evaluate(whole, linear, TOY, student_obs=backwards, **about)


@pytest.mark.fault(332)
def test_views_of_large_numbers_that_differ_by_little_are_others():
    """Two barometers, which vary by half a pascal."""
    states = 101_325 + np.random.default_rng(0).normal(0, 0.5, (50, 3))
    first = View.of([0, 1], states)
    assert sees_as(first, View.of(lambda rows: rows[:, :2] * 1.0, states), states)
    assert not sees_as(first, View.of(lambda rows: rows[:, [1, 0]], states), states)
    assert not sees_as(first, View.of([1, 0], states), states)


@pytest.mark.fault(333)
def test_a_function_that_sees_as_a_run_does_is_taken_by_load(linear, tmp_path):
    folder = fdtasil.distill(linear, TOY, 0, student_obs=[0, 1], **QUICK).save(tmp_path / "some")
    again = fdtasil.Distilled.load(folder, student_obs=lambda rows: rows[:, :2])
    assert again.view.columns == (0, 1)
    with pytest.raises(SettingError) as refused:
        fdtasil.Distilled.load(folder, student_obs=lambda rows: rows[:, 1::-1])
    assert "the function of then" not in str(refused.value)
    folder = fdtasil.distill(linear, TOY, 0, **QUICK).save(tmp_path / "whole")
    assert fdtasil.Distilled.load(folder, student_obs=lambda rows: rows * 1.0).view.is_whole


@pytest.mark.fault(330)
def test_a_log_of_one_observation_is_warned_of():
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 1))
    log = fdtasil.from_arrays(np.zeros((50, 3)), actions, episode_ends=[50], low=-1, high=1)
    with pytest.warns(FdtasilWarning, match="all 50 observations are the same"):
        fdtasil.distill(dataset=log, probes=0, fit=fdtasil.Fit(steps=40))


def test_what_is_not_used_is_refused(run, quick):
    with pytest.raises(SettingError, match="trainer='dagger'"):
        fdtasil.distill(dataset=run, trainer="dagger")
    with pytest.raises(SettingError, match="stored answers"):
        fdtasil.distill(dataset=run, probes="basis,central")
    with pytest.raises(SettingError, match="episodes=3 with a dataset of 2 episodes"):
        fdtasil.distill(dataset=run, episodes=3)
    same = quick.report["probes"]
    for said in ({"probes": same}, {"probes": 3}, {"probes": None, "episodes": 2}):
        result = fdtasil.distill(dataset=run, **said, **SMALL)
        assert result.report["probes"] == same
        assert result.settings["episodes"] == 2


def test_probes_that_are_left_out_are_those_that_are_stored(linear):
    """Ten, where nothing is; but who says ten is not given five others."""
    stored = fdtasil.distill(linear, TOY, "sphere:5", **QUICK)
    result = fdtasil.distill(dataset=stored.dataset, **SMALL)
    assert result.report["probes"] == stored.report["probes"]
    assert result.report["probes"].startswith("sphere:5,")
    assert result.history[-1]["derivative_error"] > 0
    for ten in (10, "10", "sphere:10"):
        with pytest.raises(SettingError, match=r":10.* with stored answers to 'sphere:5,"):
            fdtasil.distill(dataset=stored.dataset, probes=ten, **SMALL)


@pytest.mark.fault(292)
def test_other_probes_than_the_stored_ones_are_asked_where_somebody_answers(linear):
    stored = fdtasil.distill(linear, TOY, "sphere:2", **QUICK).dataset
    with pytest.warns(FdtasilWarning, match=r"'sphere:2,.* are not used: .* anew, 'sphere:5"):
        more = fdtasil.distill(linear, TOY, "sphere:5", dataset=stored, **SMALL)
    assert any("are not used" in one for one in more.report["warnings"])
    alone = replace(stored, probes=None, answers=None)
    expected = fdtasil.distill(linear, TOY, "sphere:5", dataset=alone, **SMALL)
    assert more.answers.values.shape[1] == 5
    assert more.queries == expected.queries
    assert more.student.to_bytes() == expected.student.to_bytes()
    same = fdtasil.distill(linear, TOY, "sphere:2", dataset=stored, **SMALL)
    assert "probe" not in same.queries or same.queries["probe"] == 0


def test_a_result_says_why_it_was_not_evaluated(linear):
    judged = fdtasil.distill(linear, TOY, 0, **QUICK)
    log = judged.dataset
    unasked = fdtasil.distill(linear, TOY, 0, **QUICK | {"evaluation_episodes": 0})
    for found, why in (
        (fdtasil.distill(None, TOY, 0, dataset=log, **SMALL), "no expert to compare it with"),
        (fdtasil.distill(linear, None, 0, dataset=log, **SMALL), "no environment to act in"),
        (unasked, "no episodes were asked for"),
    ):
        for told in (repr(found), page_of(found), card_of(found)):
            assert why in told
    assert "not evaluated" not in repr(judged)


@pytest.mark.fault(294)
def test_a_log_whose_movement_float32_rounds_away_is_warned_of():
    random = np.random.default_rng(0)
    states = random.standard_normal((50, 3))
    actions = np.tanh(states[:, 1:2])
    clock = states + np.float64([1.7e9, 0, 0])
    with pytest.warns(FdtasilWarning, match="float32 rounds away how 1 of the 3 .*number 0 moves"):
        fdtasil.from_arrays(clock, actions)
    with pytest.raises(SettingError, match="rounds away how 1 of the 1 observations"):
        fdtasil.from_arrays(clock[:, :1], actions)
    assert fdtasil.from_arrays(states + 100, actions).sizes == (3, 1)


@pytest.mark.fault(294)
@pytest.mark.parametrize(("deviation", "told"), [(1.0, True), (0.02, False), (10.0, False)])
def test_movement_beside_an_offset_that_is_left_out_is_warned_of(deviation, told, recwarn):
    """Of 4e5, float32 has steps of 0.03: less than that is no movement, and more is normalised."""
    states = np.random.default_rng(0).standard_normal((200, 2))
    actions = np.tanh(states[:, 1:])
    states[:, 0] = 4e5 + deviation * states[:, 0]
    log = fdtasil.from_arrays(states.astype(np.float32), actions)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fdtasil.distill(dataset=log, probes=0, **SMALL)
    found = [
        str(one.message) for one in said if "float32 has beside their offset" in str(one.message)
    ]
    assert len(found) == told
    if told:
        assert re.search(r"1 coordinates .*\(0: (0\.9|1).*; number 0 beside 4000", found[0])


@pytest.mark.fault(302)
def test_whole_numbers_of_a_log_may_be_choices():
    states = np.random.default_rng(0).standard_normal((50, 3))
    for chosen in ((states[:, :1] > 0), (states[:, :1] > 0).astype(int)):
        with pytest.warns(FdtasilWarning, match=r"write scores: np\.eye\(2\)") as told:
            fdtasil.from_arrays(states, chosen)
        advice = str(told[0].message).partition("scores: ")[2]
        scores = eval(advice, {"np": np, "actions": chosen})
        assert fdtasil.from_arrays(states, scores).sizes == (3, 2)
    fdtasil.from_arrays(states, np.arange(50)[:, None])  # a position in steps of a motor
    fdtasil.from_arrays(states, np.arange(50)[:, None] % 3 - 1)  # no choice is -1
    fdtasil.from_arrays(states, np.full((50, 1), 1000))
    fdtasil.from_arrays(states, np.ones((50, 2), int))


def test_who_has_neither_answers_nor_an_expert_is_told_so(quick):
    log = fdtasil.from_arrays(quick.demonstrations.observations, quick.demonstrations.actions)
    with pytest.raises(SettingError, match="a dataset without answers to probes, and no expert"):
        fdtasil.distill(dataset=log, **SMALL)


@pytest.mark.fault(301)
def test_constraints_of_a_run_that_evaluates_nothing_are_refused(linear, quick):
    limits = {"constraints": {"a": lambda x, u: x[:, 0]}}
    with pytest.raises(SettingError, match="constraints= and no evaluation"):
        fdtasil.distill(linear, TOY, 0, **(QUICK | limits | {"evaluation_episodes": 0}))
    with pytest.raises(SettingError, match="constraints= without an expert"):
        fdtasil.distill(None, TOY, dataset=quick.dataset, **limits, **SMALL)


def test_a_twin_is_probed_too(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    result = fdtasil.distill(expert, TOY, "jacobian", student_obs=[0, 1], **QUICK)
    assert result.answers.values.shape[1] == 2


def test_a_folder_with_another_runs_demonstrations_is_refused(linear, tmp_path):
    for seed in (0, 1):
        fdtasil.distill(linear, TOY, 0, seed=seed, out=tmp_path / str(seed), **QUICK)
    other = (tmp_path / "1/demonstrations.npz").read_bytes()
    (tmp_path / "0/demonstrations.npz").write_bytes(other)
    with pytest.raises(StorageError, match=r"demonstrations\.npz changed after writing"):
        fdtasil.distill(dataset=tmp_path / "0", **SMALL)
    alone = tmp_path / "0/demonstrations.npz"
    fdtasil.distill(dataset=alone, probes=0, **SMALL)


def test_a_result_shows_itself_in_a_few_lines(linear):
    shown = repr(fdtasil.distill(linear, TOY, 2, **QUICK))
    assert "40 states, probes adaptive:2" in shown
    assert len(shown.splitlines()) < 10


@pytest.fixture
def arrays():
    states = np.random.default_rng(0).standard_normal((40, 5))
    return states, states @ GAIN.T.astype(np.float64)


def test_a_student_of_plain_arrays_and_an_expert_without_an_environment(arrays, linear):
    """Nothing is recorded, nothing is compared: only the probes around the states are asked."""
    states, actions = arrays
    data = fdtasil.from_arrays(states, actions, episode_ends=[15, 40], low=-5, high=5)
    assert data.demonstrations.episodes == 2
    assert data.high.tolist() == [5, 5]
    result = fdtasil.distill(linear, dataset=data, probes=4, fit=fdtasil.Fit(steps=20))
    assert result.queries["probe"] == 160
    assert result.queries["act"] == result.queries["label"] == 0
    assert result.evaluation is None
    cloned = fdtasil.distill(dataset=data, fit=fdtasil.Fit(steps=20), probes=0)
    assert sum(cloned.queries.values()) == 0


@pytest.mark.fault(278)
@pytest.mark.parametrize("change", ["reversed", "doubles"])
def test_arrays_of_anybody_are_learnt_from(change, linear):
    """Reversed twice they are what they were, but views of what lies backwards."""
    given = fdtasil.distill(linear, TOY, 3, **QUICK).dataset

    def changed(array):
        if change == "doubles":
            return array.astype(np.float64) if array.dtype == np.float32 else array
        return np.ascontiguousarray(array[::-1])[::-1]

    def every(part):
        return replace(part, **{name: changed(array) for name, array in vars(part).items()})

    other = replace(
        given, demonstrations=every(given.demonstrations), answers=every(given.answers)
    )
    run = {"fit": QUICK["fit"], "student": QUICK["student"]}
    ours, theirs = (fdtasil.distill(dataset=one, **run).student for one in (other, given))
    assert ours.to_bytes() == theirs.to_bytes()


@pytest.mark.fault(278)
def test_reversed_arrays_are_differentiated_too():
    with torch.random.fork_rng():
        law = torch.nn.Sequential(torch.nn.Linear(5, 2), torch.nn.Tanh())
    given = fdtasil.distill(law, TOY, 0, **QUICK).dataset
    states = given.demonstrations
    turned = {name: array[::-1] for name, array in vars(states).items()}
    other = replace(given, demonstrations=replace(states, **turned))
    found = fdtasil.distill(law, probes="jacobian", dataset=other, **SMALL)
    assert len(found.dataset.answers.values) == len(states)


@pytest.mark.fault(278)
def test_later_rounds_alone_are_learnt_from(linear):
    run = {**QUICK, "trainer": fdtasil.DAgger(updates=(1,))}
    given = fdtasil.distill(linear, TOY, 0, **run).dataset
    states = given.demonstrations
    later = replace(given, demonstrations=states.at(states.round == 1))
    assert len(later.demonstrations) < len(states)
    about = {"fit": QUICK["fit"], "student": QUICK["student"]}
    found = fdtasil.distill(probes=0, dataset=later, student_obs=lambda rows: rows[:, :3], **about)
    assert found.student.observation_size == 3


def test_ends_of_episodes_as_others_have_them(arrays):
    flags = np.zeros(40, bool)
    flags[[14, 39]] = True
    for ends in (flags, [15, 40], np.array([15, 40]), [15]):
        found = fdtasil.from_arrays(*arrays, episode_ends=ends).demonstrations.episode
        assert found.tolist() == [0] * 15 + [1] * 25
    assert fdtasil.from_arrays(*map(torch.from_numpy, arrays)).demonstrations.episodes == 1


@pytest.mark.parametrize(
    "change",
    [
        {"observations": np.zeros((3, 5))},
        {"actions": np.zeros(39)},
        {"actions": np.zeros((40, 2, 1))},
        {"observations": np.full((40, 5), np.nan)},
        {"observations": [["a"] * 5] * 40},
        {"episode_ends": [0, 40]},
        {"episode_ends": [20, 10]},
        {"episode_ends": [41]},
        {"episode_ends": "end"},
        {"low": [1, 2, 3]},
        {"low": 1, "high": 0},
    ],
)
def test_arrays_that_do_not_go_together(arrays, change):
    given = {"observations": arrays[0], "actions": arrays[1], **change}
    with pytest.raises(SettingError):
        fdtasil.from_arrays(given.pop("observations"), given.pop("actions"), **given)


def test_a_minari_dataset_of_dictionaries_and_choices_with_its_expert(tmp_path, monkeypatch):
    """Somebody's recordings and who made them, without an environment."""
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    buffer = importlib.import_module("minari.data_collector").EpisodeBuffer
    form = OBSERVATIONS["nested"]
    expert = in_form(lambda rows: np.asarray(rows, np.float32) @ GAIN.T, "nested", "choice")
    plain = np.random.default_rng(0).standard_normal((2, 13, 5))
    episodes = [
        buffer(
            id=number,
            observations=form.of(rows),
            actions=expert(form.of(rows[:12])),
            rewards=[0.0] * 12,
            terminations=[False] * 12,
            truncations=[False] * 11 + [True],
            infos={},
        )
        for number, rows in enumerate(plain)
    ]
    spaces = {
        "observation_space": form.space,
        "action_space": ACTIONS["choice"].space,
        "requirements": [],
    }
    minari.create_dataset_from_buffers("toy/nested-v0", episodes, **spaces)
    data = fdtasil.from_minari("toy/nested-v0")
    assert data.spaces.actions.choices == ((0, 4),)
    assert data.demonstrations.actions.sum(1) == pytest.approx(0, abs=1e-6)
    result = fdtasil.distill(expert, dataset=data, probes=3, fit=fdtasil.Fit(steps=20))
    assert result.queries["probe"] > 0
    seen = data.spaces.observations.value(data.demonstrations.observations[0])
    assert result.student.predict(seen)[0] in (1, 2, 3, 4)


def test_an_expert_beside_a_dataset_passes_a_gate_too(arrays):
    data = fdtasil.from_arrays(*arrays, low=-9, high=9)
    options = {"dataset": data, "probes": 2, "fit": Fit(steps=5)}
    random = np.random.default_rng(0)
    noisy = lambda rows: rows @ GAIN.T + random.standard_normal((len(rows), 2))  # noqa: E731
    with pytest.raises(ExpertError, match="asked twice differs"):
        fdtasil.distill(noisy, **options)
    with pytest.warns(FdtasilWarning, match="otherwise than the demonstrations at 16 of 16"):
        fdtasil.distill(lambda rows: -rows @ GAIN.T, **options)
    result = fdtasil.distill(lambda rows: rows @ GAIN.T, **options)
    assert result.queries == result.report["predicted_queries"]
    assert repr(data).startswith("Dataset(arrays: 40 states of 1 episodes")


def backwards(observations):
    return observations[:, ::-1]


@pytest.mark.fault(232)
def test_a_result_is_judged_through_its_own_function(linear, tmp_path):
    result = fdtasil.distill(linear, TOY, "3,forward", student_obs=backwards, **QUICK)
    found = fdtasil.evaluate(result, linear, TOY, episodes=2, horizon=20)
    assert found == result.evaluation
    read = fdtasil.Distilled.load(result.save(tmp_path))
    with pytest.raises(SettingError, match="no file can hold"):
        fdtasil.evaluate(read, linear, TOY, episodes=2, horizon=20)


@pytest.mark.fault(233)
def test_another_expert_than_the_datasets_is_warned_of_in_an_environment_too(run, linear):
    other = lambda rows: 0.5 * linear(rows)  # noqa: E731
    with pytest.warns(FdtasilWarning, match="otherwise than the demonstrations at 32 of 32"):
        result = fdtasil.distill(other, TOY, dataset=run, **QUICK)
    assert result.queries["check"] == result.report["predicted_queries"]["check"]


@pytest.mark.fault(335)
def test_another_expert_than_stored_probes_is_warned_of(run, linear):
    """As one that is at its bounds wherever the demonstrations went, and was changed within."""
    states = fdtasil.Distilled.load(run).demonstrations.observations
    visited = {row.tobytes() for row in states}

    def other(rows):
        there = [row.tobytes() in visited for row in np.asarray(rows, np.float32)]
        return np.where(np.array(there)[:, None], linear(rows), 0.5 * linear(rows))

    for env, about in ((TOY, QUICK), (None, SMALL)):
        with pytest.warns(FdtasilWarning, match=r"at \d+ of 32 states and states that a probe"):
            result = fdtasil.distill(other, env, dataset=run, **about)
        assert result.queries["check"] == result.report["predicted_queries"]["check"]
    fdtasil.distill(linear, TOY, dataset=run, **QUICK)


@pytest.mark.parametrize("asked", [{"horizon": 7}, {"constraints": {"a": lambda x, u: x[:, 0]}}])
def test_what_only_an_environment_has_a_use_for_is_refused_without_one(asked, run):
    with pytest.raises(SettingError, match="without an environment"):
        fdtasil.distill(dataset=run, **asked, **SMALL)


def test_what_is_no_dataset_is_not_written_for_minari(quick):
    pytest.importorskip("minari")
    with pytest.raises(SettingError, match=r"write result\.dataset"):
        fdtasil.to_minari(quick, "me/x-v0")


@pytest.mark.fault(279)
def test_recorded_actions_beyond_their_bounds_are_warned_of(arrays, linear):
    states, actions = arrays
    with pytest.warns(FdtasilWarning, match=r"\d+ of 40 actions lie beyond low and high, by up"):
        fdtasil.from_arrays(states, actions, low=-0.1, high=0.1)
    small = np.stack([actions[:, 0], np.full(40, 9e-3)], axis=1)  # beside one in large numbers
    with pytest.warns(FdtasilWarning, match="40 of 40 actions lie beyond"):
        fdtasil.from_arrays(states, small, low=[-1000, -1e-3], high=[1000, 1e-3])
    fdtasil.from_arrays(states, -abs(actions), low=-5, high=0)


@pytest.mark.fault(279)
def test_bounds_that_arrays_lack_are_the_environments(arrays, linear):
    states, actions = arrays
    run = {"probes": 0, "horizon": 5, "evaluation_episodes": 2, **SMALL}
    free = fdtasil.from_arrays(states, actions)
    with pytest.warns(FdtasilWarning, match=r"\d+ of 40 actions lie beyond low and high"):
        result = fdtasil.distill(None, TOY, dataset=free, **run)
    assert result.student.low.tolist() == [-1, -1]
    assert np.abs(result.student.act(100 * states.astype(np.float32))).max() <= 1
    other = fdtasil.from_arrays(states, actions, low=-9, high=9)
    with pytest.warns(FdtasilWarning, match="a dataset with the action bounds -9 to 9: the stud"):
        result = fdtasil.distill(linear, TOY, dataset=other, **run)
    assert result.student.high.tolist() == [9, 9]
    with pytest.warns(FdtasilWarning, match="actions lie beyond low and high"):
        wrong = fdtasil.from_arrays(states, actions, low=5)
    with pytest.raises(SettingError, match="the action bounds 5 to inf"):
        fdtasil.distill(linear, TOY, dataset=wrong, **run)


@pytest.mark.fault(363)
def test_actions_that_were_cut_off_at_bounds_that_nobody_says_are_warned_of():
    states = np.random.default_rng(0).standard_normal((200, 5))
    cut = np.stack([np.clip(3 * states[:, 0], -1, 1), np.tanh(states[:, 1])], axis=1)
    run = {"dataset": fdtasil.from_arrays(states, cut), "probes": 0, **SMALL}
    with pytest.warns(FdtasilWarning, match=r"1 of 2 actions .* \(action 0 at -1 and 1\)"):
        free = fdtasil.distill(**run)
    assert not np.isfinite(free.student.low).any()
    fdtasil.distill(None, TOY, horizon=5, evaluation_episodes=2, **run)  # its bounds are known
    repeated = np.tile(states[:20], (5, 1))  # each state of an episode is met in all of them
    for seen, quiet in (
        (states, 3 * states[:, :2]),
        (states, np.sign(states[:, :2])),  # a switch
        (repeated, repeated[:, :2]),
    ):
        fdtasil.distill(**run | {"dataset": fdtasil.from_arrays(seen, quiet)})


@pytest.mark.parametrize("listed", [False, True])
def test_observations_after_the_last_action_are_named(arrays, listed):
    states, actions = arrays
    pair = ([states], [actions[:-1]]) if listed else (states, actions[:-1])
    with pytest.raises(SettingError, match="leave out the observation after each episode's last"):
        fdtasil.from_arrays(*pair)


def test_numbers_of_one_action_need_no_axis(arrays):
    states, action = arrays[0], arrays[1][:, 0]
    whole = fdtasil.from_arrays(states, action[:, None], episode_ends=[15, 40])
    parts = [states[:15], states[15:]], [action[:15], action[15:]]
    assert (
        fdtasil.from_arrays(states, action, episode_ends=[15, 40]).to_bytes() == whole.to_bytes()
    )
    assert fdtasil.from_arrays(*parts).to_bytes() == whole.to_bytes()
    with pytest.warns(FdtasilWarning, match=r"np\.eye\(3\)\[np\.ravel\(actions\)"):
        fdtasil.from_arrays(states, np.arange(40) % 3)


def test_an_array_for_each_episode(arrays):
    states, actions = arrays
    parts = [states[:15], states[15:]], [actions[:15], actions[15:]]
    found = fdtasil.from_arrays(*parts)
    whole = fdtasil.from_arrays(states, actions, episode_ends=[15, 40])
    assert found.to_bytes() == whole.to_bytes()
    for wrong in (
        [actions[:10], actions[10:]],
        [actions[:15], actions[15:, :1]],
        [actions[:15], actions[15:, 0]],
        [actions[:15]],
        actions[:, 0],
        None,
    ):
        with pytest.raises(SettingError, match="episodes of observations of shapes"):
            fdtasil.from_arrays(parts[0], wrong)
    with pytest.raises(SettingError, match="episodes of observations of shapes"):
        fdtasil.from_arrays([*parts[0], states[:0]], [*parts[1], actions[:0]])
    with pytest.raises(SettingError, match="episode_ends= beside 2 episodes"):
        fdtasil.from_arrays(*parts, episode_ends=[15, 40])


@pytest.mark.fault(279)
def test_indices_in_the_place_of_ends_are_warned_of(arrays):
    with pytest.warns(FdtasilWarning, match="the last episode is a single state"):
        fdtasil.from_arrays(*arrays, episode_ends=[14, 39])
    with pytest.raises(SettingError, match=r"episode_ends=\[False False"):
        fdtasil.from_arrays(*arrays, episode_ends=np.zeros(40, bool))


def test_arrays_of_somebody_else_in_a_file(arrays, tmp_path):
    np.savez(tmp_path / "mine.npz", observations=arrays[0], actions=arrays[1])
    with pytest.raises(StorageError, match="did not write, with observations, actions") as caught:
        load_dataset(tmp_path / "mine.npz")
    assert "from_arrays" in caught.value.next_step


@pytest.mark.fault(308)
def test_recorded_scores_beside_an_environment_are_its_choices(tmp_path):
    random = np.random.default_rng(0)
    states = random.standard_normal((60, 4))
    chosen = (states[:, 2] > 0).astype(int)
    log = fdtasil.from_arrays(states, np.eye(2)[chosen] - 1 / 2)
    run = {"probes": 0, "fit": Fit(steps=30), "evaluation_episodes": 0, "progress": False}
    result = fdtasil.distill(None, "CartPole-v1", dataset=log, **run)
    assert result.student.predict(states[0].astype(np.float32))[0] in (0, 1)
    file = onnx.load(result.export(tmp_path / "s.onnx"))
    assert [output.name for output in file.graph.output] == ["scores", "actions"]


@pytest.mark.fault(310)
@pytest.mark.parametrize("history", [1, 3])
def test_a_minari_dataset_says_what_its_rows_are(history, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    expert = in_form(lambda x: np.asarray(x, np.float32) @ GAIN.T, "nested", "choice")
    made = lambda: InForm("nested", "choice")  # noqa: E731
    run = {"episodes": 2, "horizon": 9, "evaluation_episodes": 0, "fit": Fit(steps=3)}
    wrote = fdtasil.distill(expert, made, 0, history=history, progress=False, **run).dataset
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of Minari, of what it is not told
        kept = fdtasil.to_minari(wrote, "toy/choices-v0")
    read = fdtasil.from_minari("toy/choices-v0")
    assert (read.spaces, read.history, read.own_size) == (wrote.spaces, history, wrote.own_size)
    assert np.array_equal(read.demonstrations.observations, wrote.demonstrations.observations)
    spoilt = json.loads((kept.storage.data_path / "metadata.json").read_text())
    spoilt["fdtasil"] = {"history": 7}
    (kept.storage.data_path / "metadata.json").write_text(json.dumps(spoilt))
    with pytest.raises(StorageError, match="history 7"):
        fdtasil.from_minari("toy/choices-v0")


@pytest.mark.fault(315)
def test_a_setpoint_of_a_log_is_warned_of_without_an_evaluation(linear):
    states = np.random.default_rng(0).standard_normal((80, 5))
    states[:, 3] = np.repeat([0.1, 0.4, -0.2, 0.6], 20)
    log = fdtasil.from_arrays(states, linear(states), episode_ends=[20, 40, 60, 80])
    with pytest.warns(FdtasilWarning, match=r"stand still within an episode.*spread=\{3: 0\.3"):
        fdtasil.distill(linear, None, 3, dataset=log, fit=Fit(steps=3), progress=False)


def test_episodes_of_one_state_say_nothing_of_what_stands_still(linear):
    states = np.random.default_rng(0).standard_normal((6, 5))
    log = fdtasil.from_arrays(states, linear(states), episode_ends=[1, 2, 3, 4, 5, 6])
    fdtasil.distill(linear, None, 2, dataset=log, fit=Fit(steps=3), progress=False)


@pytest.mark.fault(316)
def test_modes_and_flags_of_a_log_are_warned_of_where_they_are_probed(linear):
    random = np.random.default_rng(0)
    states = random.standard_normal((80, 5))
    states[:, 2], states[:, 4] = random.integers(0, 3, 80), random.integers(0, 2, 80)
    log = fdtasil.from_arrays(states, linear(states))
    run = {"dataset": log, "fit": Fit(steps=3), "progress": False}
    with pytest.warns(FdtasilWarning, match=r"whole numbers in every state \(2, 4\)"):
        fdtasil.distill(linear, None, 3, **run)
    fdtasil.distill(linear, None, 3, student_obs=[0, 1, 3], **run)
    fdtasil.distill(None, None, 0, **run)
    states[:, 2] = np.arange(80)  # steps of a motor
    states[:, 4] = np.arange(80) == 40  # a force that is cut, seldom at its end
    counted = fdtasil.from_arrays(states, linear(states))
    fdtasil.distill(linear, None, 3, **{**run, "dataset": counted})


def test_a_log_beside_an_environment_of_parts_takes_its_form(tmp_path):
    expert = in_form(lambda x: np.asarray(x, np.float32) @ GAIN.T, "dictionary")
    made = lambda: InForm("dictionary")  # noqa: E731
    run = {"fit": Fit(steps=3), "evaluation_episodes": 2, "horizon": 9, "progress": False}
    recorded = fdtasil.distill(expert, made, 0, episodes=1, **run).demonstrations
    log = fdtasil.from_arrays(recorded.observations, recorded.actions)
    result = fdtasil.distill(expert, made, 0, dataset=log, **run)
    seen = OBSERVATIONS["dictionary"].of(recorded.observations[0])
    assert result.student.predict(seen)[0].shape == (2,)
    assert result.export(tmp_path / "s.onnx", inputs="keys").exists()


@pytest.mark.fault(343)
@pytest.mark.parametrize("kind", [np.uint8, np.uint64, np.int64])
def test_ends_that_do_not_grow_are_refused_whatever_their_type(kind):
    states, actions = np.random.default_rng(0).standard_normal((2, 60, 2))
    with pytest.raises(SettingError, match="growing numbers up to 60"):
        fdtasil.from_arrays(states, actions, episode_ends=np.array([50, 30, 60], kind))
    good = fdtasil.from_arrays(states, actions, episode_ends=np.array([30, 50, 60], kind))
    assert np.bincount(good.demonstrations.episode).tolist() == [30, 20, 10]


@pytest.mark.fault(343)
def test_lists_of_several_lengths_are_refused():
    states = np.zeros((3, 2))
    with pytest.raises(SettingError, match="plain numbers"):
        fdtasil.from_arrays([[1.0], [2.0, 3.0]], states[:2])
    with pytest.raises(SettingError, match="episode_ends"):
        fdtasil.from_arrays(states, states, episode_ends=[[1], [2, 3]])


def test_no_path_is_refused_by_every_writer(quick):
    for write in (quick.export, quick.to_onnx, quick.save):
        with pytest.raises(SettingError, match="None"):
            write(None)


def test_a_constraint_may_know_nothing_of_actions_that_nobody_takes(linear):
    push = lambda rows: np.full((len(rows), 2), 0.5)  # noqa: E731
    limits = {"power": lambda x, u: np.where((u > 0).all(axis=1), -1.0, np.nan)}
    fdtasil.evaluate(push, push, TOY, episodes=2, horizon=5, constraints=limits)
    run = QUICK | {"fit": Fit(steps=300, learning_rate=0.01)}
    found = fdtasil.distill(push, TOY, 0, constraints=limits, **run)
    assert found.evaluation.violations[0][1] == 0


@pytest.mark.fault(350)
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"constraints": {"rail": lambda x, u: x["place"]}}, r"is 0:2 place, 2:4 rest|0:\d \w+, "),
        ({"constraints": {"rail": lambda x, u: 1.0}}, r"\(2,\) numbers"),
        ({"student_obs": lambda rows: rows["place"]}, r"raised IndexError on \(2, 5\)"),
        ({"student_obs": lambda rows: rows.sum(axis=1)}, r"maps \(2, 5\)"),
    ],
)
def test_functions_are_tried_before_the_expert_is_asked(changes, said):
    asked = []

    def law(parts):
        asked.append(len(parts["place"]))
        return np.zeros((len(parts["place"]), 2), np.float32)

    with pytest.raises(SettingError, match=said):
        fdtasil.distill(law, lambda: InForm("dictionary"), 2, **QUICK, **changes)
    assert sum(asked) == 0


@pytest.mark.fault(362)
@pytest.mark.parametrize(("probes", "order"), [("3,central", 1), (3, 2)])
def test_a_curved_view_is_refused_before_anybody_is_asked(probes, order, linear):
    asked = []

    def counted(rows):
        asked.append(len(rows))
        return linear(rows)

    run = {**QUICK, "fit": fdtasil.Fit(steps=5, order=order)}
    with pytest.raises(SettingError, match="a curved function"):
        fdtasil.distill(counted, TOY, probes, student_obs=lambda rows: rows**2, **run)
    refused = sum(asked)
    asked.clear()
    whole = fdtasil.distill(counted, TOY, probes, **run)
    assert refused <= sum(asked) - whole.queries["probe"]
