"""A run on one page, as a model card, and in a notebook: nothing of it can become code."""

import pickle
import re
import shutil
from html.parser import HTMLParser

import gymnasium
import numpy as np
import pytest
from conftest import QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil.errors import FdtasilWarning, StorageError
from fdtasil.results.card import card_of
from fdtasil.results.page import page_of
from fdtasil.results.summary import call_of

pytestmark = pytest.mark.usefixtures("no_pictures")


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found, self.links = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append(tag)
        self.links += [value for name, value in attributes if name in ("src", "href")]


@pytest.fixture
def spoilt(quick):
    """A run whose texts come from somebody who means harm."""
    bad = "<script>alert(1)</script>|[x](http://evil)\n# head"
    report = {**quick.report, "env": bad, "warnings": [bad]}
    report["expert"] = {**report["expert"], "path": bad}
    return fdtasil.Distilled(**{**vars(quick), "report": report})


def test_the_page_has_everything_and_asks_nobody(quick):
    text = page_of(quick)
    tags = Tags(text)
    assert "script" not in tags.found
    assert all(link.startswith("data:image/png") for link in tags.links)
    for told in (quick.report["env"], "normalised return", "queries", "fdtasil.distill("):
        assert told in text


@pytest.mark.fault(221)
def test_texts_of_a_file_stay_texts(spoilt):
    assert "script" not in Tags(page_of(spoilt)).found
    assert "script" not in Tags(spoilt._repr_html_()).found
    card = card_of(spoilt)
    assert "<script" not in card
    assert "\n# head" not in card
    assert not re.search(r"(?<!\\)\[x\]\(http", card)


def test_the_command_and_the_card_of_a_folder(quick_folder, inside, tmp_path):
    done = inside("report", quick_folder, "--out", tmp_path / "r.html")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
    card = (quick_folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: fdtasil")
    assert "## How good" in card


@pytest.mark.fault(266)
@pytest.mark.parametrize(
    "further",
    [
        {},
        {"history": 2},
        {"spread": {4: 0.5}},
        {"trainer": fdtasil.DAgger(beta=0.25), "episodes": 3},
        {"student_obs": np.sin},
    ],
    ids=str,
)
def test_the_call_of_the_card_repeats_the_run(further, linear):
    """With an expert of its own: a function has no path."""
    result = fdtasil.distill(linear, TOY, 3, **(QUICK | further))
    block = re.search(r"```python\n(.*?)```", card_of(result), re.S)[1]
    assert "expert = ...  # the function <lambda>\n" in block
    code = re.sub(r"(?m)^(expert|student_obs) = .*$", "", block)
    code = code.replace(repr(result.settings["env"]), "env")
    session = {"expert": linear, "env": TOY} | further
    exec(code, session)
    assert session["result"].student.to_bytes() == result.student.to_bytes()


def test_the_call_of_a_run_on_a_dataset_names_it(quick):
    result = fdtasil.distill(None, None, 0, dataset=quick.dataset, fit=fdtasil.Fit(steps=5))
    block = re.search(r"```python\n(.*?)```", card_of(result), re.S)[1]
    assert re.search(r"(?m)^dataset = \.\.\.  # sha256 \w{64}$", block)
    session = {"dataset": quick.dataset}
    exec(re.sub(r"(?m)^dataset = .*$", "", block), session)
    assert session["result"].student.to_bytes() == result.student.to_bytes()


def test_notebooks_and_pickles(quick):
    assert "<table>" in quick._repr_html_()
    assert "<table>" in quick.evaluation._repr_html_()
    again = pickle.loads(pickle.dumps(quick))
    assert again.student.to_bytes() == quick.student.to_bytes()
    assert again.evaluation == quick.evaluation


@pytest.mark.fault(269)
def test_a_run_that_has_not_ended_says_how_it_goes_on(linear, tmp_path, inside):
    def stop(event):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fdtasil.distill(linear, TOY, 2, **QUICK, out=tmp_path / "run", callback=stop)
    for line in (
        ["report", tmp_path / "run"],
        ["evaluate", tmp_path / "run", TOY, "--expert", tmp_path / "run"],
        ["diagnose", tmp_path / "run", TOY, "--expert", tmp_path / "run"],
    ):
        done = inside(*line)
        assert done.returncode == 1
        assert "has not ended" in done.stderr
        assert "--resume" in done.stderr


def test_files_whose_names_say_something_else_are_not_written(quick_folder, inside, tmp_path):
    done = inside("report", quick_folder, "--out", tmp_path / "r.pdf")
    assert done.returncode == 2
    assert "write r.html" in done.stderr
    assert not (tmp_path / "r.pdf").exists()
    done = inside("report", quick_folder, "--out", ".")
    assert done.returncode == 2
    assert "write file.html" in done.stderr


def test_the_time_of_an_expert_is_that_of_its_file(tmp_path):
    result = fdtasil.distill(str(mlp_onnx(tmp_path / "e.onnx")), TOY, 2, **QUICK)
    size = result.report["size"]["expert"]
    assert 0 < size["onnx_microseconds"] < size["microseconds"]


@pytest.mark.fault(271)
def test_a_student_that_is_judged_elsewhere_is_noticed(tmp_path):
    def swing(rows):
        return np.clip(-8 * np.arctan2(rows[:, 1:2], rows[:, :1]) - 2 * rows[:, 2:], -2, 2)

    gymnasium.register(
        "Other/Pendulum-v0",
        entry_point="gymnasium.envs.classic_control:PendulumEnv",
        max_episode_steps=200,
    )
    run = fdtasil.distill(swing, "Pendulum-v1", 2, **QUICK, out=tmp_path / "run")
    for student in (run, tmp_path / "run"):
        for judge in (fdtasil.evaluate, fdtasil.diagnose):
            with pytest.warns(FdtasilWarning, match="distilled in Pendulum-v1, and is judged in"):
                judge(student, swing, "Other/Pendulum-v0", episodes=2, horizon=20)
    assert "<pre>" in fdtasil.diagnose(run, swing, "Pendulum-v1", episodes=2)._repr_html_()


@pytest.mark.fault(271)
def test_an_environment_that_is_more_than_its_id_is_left_to_the_reader():
    def swing(rows):
        return np.clip(-8 * np.arctan2(rows[:, 1:2], rows[:, :1]) - 2 * rows[:, 2:], -2, 2)

    moon = fdtasil.Environment("Pendulum-v1", kwargs={"g": 1.6})
    made = {
        "fdtasil.Environment('Pendulum-v1', kwargs={'g': 1.6}),": moon,
        "env = ...  # Pendulum-v1, made by make_pendulum\n": make_pendulum,
    }
    for said, env in made.items():
        run = fdtasil.distill(swing, env, 2, **QUICK)
        assert said in call_of(run.settings, 1)
        fdtasil.evaluate(run, swing, env, episodes=2, horizon=20)  # says nothing
    with pytest.warns(FdtasilWarning, match="in another Pendulum-v1 than it is judged in: its ob"):
        fdtasil.evaluate(run, swing, moon, episodes=2, horizon=20)


def make_pendulum():
    return gymnasium.make("Pendulum-v1", g=3.0)


@pytest.mark.fault(296)
def test_a_card_that_was_completed_by_hand_is_no_damage(quick_folder, tmp_path):
    shutil.copytree(quick_folder, tmp_path / "run")
    card = tmp_path / "run" / "README.md"
    card.write_text(card.read_text() + "license: mit")
    assert fdtasil.Distilled.load(tmp_path / "run").evaluation is not None
    (tmp_path / "run" / "report.json").write_text("{}")
    with pytest.raises(StorageError, match=r"report\.json changed after writing"):
        fdtasil.Distilled.load(tmp_path / "run")


def test_a_card_says_no_more_than_what_was_done(linear, quick):
    cloned = fdtasil.distill(linear, TOY, 0, **(QUICK | {"evaluation_episodes": 0, "history": 2}))
    card = card_of(cloned)
    assert "Nobody has judged it" in card
    assert "It was judged" not in card
    assert "plain behaviour cloning" in card
    assert "around them" not in card
    assert "`obs`, (rows, 12) float32 (0:5 now, then for each of 1 steps before" in card
    assert "It was judged in this environment" in card_of(quick)
    assert "and its reactions around them" in card_of(quick)


@pytest.mark.fault(266)
def test_the_call_of_the_card_says_what_an_expert_was_opened_with(tmp_path):
    file = mlp_onnx(tmp_path / "e.onnx")
    opened = fdtasil.load_expert(file, output="actions")
    card = card_of(fdtasil.distill(opened, TOY, 0, **QUICK))
    assert re.search(r"expert = \.\.\.  # .*e\.onnx, opened with output='actions'", card)


@pytest.mark.slow
@pytest.mark.fault(266)
def test_the_call_of_the_card_leaves_a_length_that_grew_to_grow_again(linear):
    run = {"episodes": 50, "horizon": 40, "evaluation_episodes": 0, "student": fdtasil.Mlp(4)}
    result = fdtasil.distill(linear, TOY, 0, **run, progress=False)
    assert result.report["steps"] > 4000
    assert "Fit(batch_size" in call_of(result.settings, 1)


@pytest.mark.parametrize(
    ("made", "code"),
    [
        ({"kwargs": {"g": 9.0}}, "fdtasil.Environment('Pendulum-v1', kwargs={'g': 9.0})"),
        ({"kwargs": {"g": 9.0}, "reset_options": {"x_init": 1.0}}, "reset_options={'x_init': "),
    ],
)
def test_an_environment_with_options_is_made_again_by_its_card(made, code):
    swing = lambda x: np.clip(-8 * x[:, 1:2] - 2 * x[:, 2:], -2, 2)  # noqa: E731
    run = {"episodes": 1, "horizon": 9, "evaluation_episodes": 0, "fit": fdtasil.Fit(steps=3)}
    place = fdtasil.Environment("Pendulum-v1", **made)
    result = fdtasil.distill(swing, place, 0, progress=False, **run)
    call = call_of(result.settings, 1)
    assert code in call
    made_again = call_of({**result.settings, "made": "kwargs={}, **print(1)"}, 1)
    assert "fdtasil.Environment" not in made_again
    again = {}
    exec(call.replace("expert = ...", "expert = swing"), {"swing": swing}, again)
    assert again["result"].student.to_bytes() == result.student.to_bytes()


@pytest.mark.fault(351)
def test_the_call_of_the_card_imports_the_module_of_an_environment(linear):
    result = fdtasil.distill(linear, TOY, 0, **QUICK)
    assert f"    {TOY!r},\n" in call_of(result.settings, 1)
    walled = "toy_environments:toy/Walled-v0"
    made = fdtasil.Environment(walled, reset_options={"a": 1})
    result = fdtasil.distill(linear, made, 0, **QUICK)
    told = f"fdtasil.Environment({walled!r}, reset_options={{'a': 1}})"
    assert told in call_of(result.settings, 1)


def test_the_call_of_the_card_forces_what_was_forced(linear):
    def wild(rows):
        return 9 * linear(rows)

    with pytest.warns(FdtasilWarning, match="forced"):
        result = fdtasil.distill(wild, TOY, 0, force=True, **QUICK)
    assert "force=True" in call_of(result.settings, 1)
