"""Experts without an answer here and there: what has none is left out, and counted."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil.errors import ExpertError
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.rollouts.behaviours import follow_answers
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.recording import HOLD
from fdtasil.rollouts.rollout import rollout

pytestmark = [
    pytest.mark.usefixtures("no_pictures"),
    pytest.mark.filterwarnings("ignore:the expert had no answer"),
    pytest.mark.filterwarnings("ignore:.* episodes of the .* were ended, for it had no answer"),
]


def beyond(rows, limit):
    """Where the toy planner has no solution: a seventh of the states, or those beyond a limit."""
    return np.sin(20 * rows[:, 0]) > 0.9 if limit is None else rows[:, 0] > limit


def nan_planner(rows, limit=1.0):
    answers = rows @ GAIN.T
    answers[beyond(rows, limit)] = np.nan
    return answers


def raising_planner(rows, limit=1.0):
    if beyond(rows, limit).any():
        raise RuntimeError("Infeasible_Problem_Detected")
    return rows @ GAIN.T


PLANNERS = {"nan": nan_planner, "raises": raising_planner}
ROWS = np.random.default_rng(0).standard_normal((40, 5)).astype(np.float32)


@pytest.mark.parametrize("planner", PLANNERS.values(), ids=PLANNERS)
def test_a_row_without_an_answer_is_nan_and_counted(planner):
    expert = load_expert(planner)
    answers = expert.ask(ROWS, "probe")
    none = beyond(ROWS, 1.0)
    assert 3 < none.sum() < 20
    assert np.array_equal(np.isnan(answers).all(axis=1), none)
    assert answers[~none] == pytest.approx(ROWS[~none] @ GAIN.T, abs=1e-6)
    assert expert.silence.rows == {"probe": none.sum()}
    assert expert.queries["probe"] == 40


def test_a_batch_of_states_without_an_answer_is_none_as_long_as_others_have_one():
    expert = load_expert(raising_planner)
    expert.ask(ROWS, "probe")
    far = np.full((3, 5), 9, np.float32)
    assert np.isnan(expert.ask(far, "act")).all()
    assert expert.silence.rows["act"] == 3
    assert "Infeasible" in expert.silence.reason


@pytest.mark.fault(207)
def test_what_belongs_to_no_row_is_an_error():
    undefined = load_expert(lambda rows: rows[:, :2] * np.nan)
    undefined.ask(ROWS[:0], "probe")  # an empty batch is no answer that others are held against
    with pytest.raises(ExpertError, match="not finite on 40 of 40"):
        undefined.ask(ROWS, "probe")
    asked = []

    def broken(rows):
        asked.append(len(rows))
        if sum(asked) > 100:
            raise RuntimeError("out of licences")
        return rows @ GAIN.T

    expert = load_expert(broken)
    expert.ask(ROWS, "probe")
    with pytest.raises(ExpertError, match="out of licences"):
        expert.ask(np.concatenate([ROWS, ROWS]), "probe")

    def small(rows):
        if len(rows) > 10:
            raise ValueError("too many")
        return rows @ GAIN.T

    with pytest.raises(ExpertError, match="too many"):
        load_expert(small).ask(ROWS, "probe")
    with pytest.raises(ExpertError, match="not finite on 40 of 40"):
        load_expert(lambda rows: rows[:, :2] * np.nan).ask(ROWS, "probe")
    with pytest.raises(ExpertError, match="not finite on 1 of 40"):
        load_expert(lambda rows: np.where(np.arange(len(rows))[:, None] == 7, np.inf, 1.0)).ask(
            ROWS, "probe"
        )


SETTINGS = {
    "probes": {},
    "fresh": {"probes": "fresh:3"},
    "central, order 2": {
        "probes": "basis,central",
        "fit": fdtasil.Fit(steps=40, order=2),
    },
    "dagger": {"trainer": fdtasil.DAgger((2, 3)), "probes": 3},
    "labels by a student": {"trainer": fdtasil.DAgger((2, 3), beta=0.0), "probes": 3},
    "dart": {"trainer": fdtasil.Dart((2, 3), extra=1), "probes": 3},
    "noise": {"trainer": "noise", "probes": 3},
    "cloning": {"probes": 0},
}


@pytest.mark.slow
@pytest.mark.fault(206)
@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("planner", PLANNERS.values(), ids=PLANNERS)
def test_a_run_leaves_out_what_has_no_answer_and_says_so(planner, setting):
    def near(rows):
        return planner(rows, limit=None)

    run = {**QUICK, "episodes": 4, "progress": False, **setting}
    with pytest.warns(fdtasil.FdtasilWarning, match="the expert had no answer to some rows"):
        result = fdtasil.distill(near, TOY, **run)
    states = result.dataset.demonstrations
    assert not beyond(states.observations, None).any()
    assert states.actions == pytest.approx(states.observations @ GAIN.T, abs=1e-5)
    shares = result.report["no_answer"]
    assert shares
    assert all(0 < share < 0.5 for share in shares.values())
    answers = result.dataset.answers
    if answers is not None:
        assert shares["probe"] > 0
        assert not np.isnan(answers.values).any()
        moved = states.observations[:, None] + answers.displacements[answers.numbers]
        offsets = result.dataset.probes.stencil.offsets
        if offsets == (1.0,):
            assert answers.values[:, :, 0] == pytest.approx(moved @ GAIN.T, abs=1e-5)


def test_the_share_without_an_answer_grows_with_the_radius_and_is_reported():
    def near(rows):
        return nan_planner(rows, limit=0.8)

    result = fdtasil.distill(near, TOY, **{**QUICK, "episodes": 4}, probes=3, progress=False)
    shares = dict(json.loads(json.dumps(result.report["calibration"]))["no_answer"])
    radii = sorted(shares)
    assert shares[radii[-1]] > shares[radii[0]]
    assert 0 < shares[radii[-1]] < 0.5


@pytest.mark.fault(207)
def test_an_expert_with_too_few_answers_is_an_error():
    with pytest.raises(ExpertError, match=r"no answer at \d+ of 16 visited states"):
        fdtasil.distill(
            lambda rows: nan_planner(rows, limit=-0.01), TOY, **QUICK, probes=3, progress=False
        )


def test_episodes_that_were_cut_short_are_said_beside_the_returns():
    """Where all of the expert's are, their returns are no measure."""

    def lost(rows):
        answers = rows @ GAIN.T
        answers[rows[:, 0] > 0.5] = np.nan
        return answers

    always = lambda rows: rows @ GAIN.T  # noqa: E731
    with pytest.warns(fdtasil.FdtasilWarning, match="episodes of the expert were ended"):
        found = fdtasil.evaluate(always, lost, TOY, episodes=6, horizon=40, force=True)
    assert found.given_up == 0 < found.expert_given_up < 6
    assert found.action_error == pytest.approx(0, abs=1e-6)  # where the expert has an answer
    assert found.expert_survival <= 1 - found.expert_given_up / 6 < found.survival
    assert f"cut short         {found.expert_given_up:10}   episodes, for the expert" in str(found)
    assert "cut short" in found._repr_html_()


def test_demonstrations_that_were_cut_short_are_counted():
    def lost(rows):
        answers = rows @ GAIN.T
        answers[rows[:, 0] > 0.5] = np.nan
        return answers

    run = {**QUICK, "episodes": 6, "horizon": 40, "probes": 0, "force": True}
    assert 0 < fdtasil.distill(lost, TOY, **run).report["given_up_episodes"] <= 6


def test_the_last_action_is_held_for_a_while_and_then_the_episode_ends():
    steps = []

    def silent_from_five_on(rows):
        steps.append(len(steps))
        answers = rows @ GAIN.T
        if len(rows) == 2 and (5 <= steps[-1] < 8 or steps[-1] >= 12):
            answers[0] = np.nan
        return answers

    with EnvironmentPool(TOY) as pool:
        episodes = rollout(follow_answers(silent_from_five_on), pool, [3, 4], 40)
    assert episodes.lengths[0] == 12 + HOLD < episodes.lengths[1]
    assert episodes.given_up.tolist() == [True, False]
    first = episodes.actions[0]
    assert (first[5:8] == first[4]).all()
    assert (first[8] != first[4]).any()
    assert (first[12 : 12 + HOLD] == first[11]).all()


def test_a_state_without_any_answered_probe_is_asked_about_itself():
    def island(rows):
        answers = rows @ GAIN.T
        on_a_state = (np.abs(rows[:, None] - ROWS).max(axis=2) < 1e-6).any(axis=1)
        answers[~on_a_state & (np.arange(len(rows)) % 3 == 0)] = np.nan
        return answers

    source = Probes.parse("sphere:1,forward,whitened,radius=0.3,labels")
    around = Surroundings.of(ROWS, source, measure_scales(ROWS))
    answers = ask_probes(load_expert(island), around, np.random.default_rng(0))
    moved = ROWS[:, None] + answers.displacements[answers.numbers]
    assert answers.values[:, :, 0] == pytest.approx(moved @ GAIN.T, abs=1e-5)
    assert (moved[:, 0] == ROWS).all(axis=1).sum() == 14
    labelled, expert = replace(around, actions=ROWS @ GAIN.T), load_expert(island)
    again = ask_probes(expert, labelled, np.random.default_rng(0))
    assert expert.queries["probe"] == 40  # and none about a state whose label is known
    assert again.values == pytest.approx(answers.values, abs=1e-6)


class Stop(Exception):
    """Stands for a kill."""


@pytest.mark.slow
@pytest.mark.usefixtures("many_checkpoints")
@pytest.mark.parametrize("count", [1, 3, 5])
def test_it_resumes_to_the_byte_and_counts_each_silence_once(count, tmp_path):
    def planner(rows):
        return nan_planner(rows, limit=None)

    run = {**QUICK, "episodes": 6, "trainer": "dagger", "probes": "sphere:2,resample"}
    run |= {"fit": fdtasil.Fit(steps=105), "progress": False}
    whole = fdtasil.distill(planner, TOY, out=tmp_path / "whole", **run)
    events = []

    def stop(event):
        events.append(event)
        if len(events) == count:
            raise Stop

    with pytest.raises(Stop):
        fdtasil.distill(planner, TOY, out=tmp_path / "run", callback=stop, **run)
    resumed = fdtasil.distill(planner, TOY, resume=tmp_path / "run", **run)
    for name in ("student.safetensors", "demonstrations.npz", "progress.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert resumed.report["no_answer"] == whole.report["no_answer"]
    assert resumed.report["rows_asked_again_after_resuming"] > 0


@pytest.mark.slow
def test_workers_and_servers_have_no_answer_too():
    expert = load_expert(raising_planner, 5, 2, workers=2, batch=8)
    answers = expert.ask(ROWS, "probe")
    assert np.array_equal(np.isnan(answers).all(axis=1), beyond(ROWS, 1.0))


def test_a_copy_has_a_silence_of_its_own(tmp_path):
    opened = load_expert(nan_planner, 5, 2)
    opened.ask(ROWS, "probe")
    result = fdtasil.distill(opened, TOY, 0, **QUICK, progress=False)
    assert "probe" not in result.report["no_answer"]


def test_batches_without_any_answer_are_as_wide_as_others():
    expert = load_expert(raising_planner, batch=1)
    answers = expert.ask(ROWS, "probe")
    assert answers.shape == (40, 2)
    assert np.array_equal(np.isnan(answers).all(axis=1), beyond(ROWS, 1.0))
    assert expert.queries == {"probe": 40, "check": beyond(ROWS, 1.0).sum()}


def test_the_radius_stays_where_there_are_answers():
    def on_the_circle(rows):
        cosine, sine, speed = rows.T
        answers = np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]
        answers[np.abs(np.linalg.norm(rows[:, :2], axis=1) - 1) > 0.1] = np.nan
        return answers

    run = {"episodes": 3, "horizon": 60, "evaluation_episodes": 0, "fit": fdtasil.Fit(steps=40)}
    result = fdtasil.distill(on_the_circle, "Pendulum-v1", 4, **run, progress=False)
    assert result.report["radius"] < 0.3
    assert result.report["no_answer"]["probe"] < 0.5


def test_an_end_without_an_answer_moves_to_the_state_before():
    def last_is_silent(rows):
        return nan_planner(rows, limit=None)

    states = fdtasil.distill(
        last_is_silent, TOY, 0, **{**QUICK, "episodes": 8, "horizon": 40}, progress=False
    ).dataset.demonstrations
    for number in np.unique(states.episode[states.terminated]):
        mine = np.flatnonzero(states.episode == number)
        assert states.terminated[mine].tolist() == [False] * (len(mine) - 1) + [True]
