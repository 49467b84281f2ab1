"""distill(): the whole way, through the public face."""

import json
import shutil

import numpy as np
import onnx
import onnxruntime
import pytest
from conftest import GAIN, QUICK, TOY, mlp_onnx
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import SettingError, StorageError
from fdtasil.run.presets import preset_of

SPECS = [
    "none",
    "1",
    "sphere:3",
    "sphere:3,central",
    "sphere:2,resample",
    "orthogonal:3",
    "basis",
    "basis,central",
    "jacobian",
]


@pytest.mark.parametrize("spec", SPECS)
def test_every_source_gives_a_student_at_the_predicted_cost(spec, tmp_path):
    result = fdtasil.distill(mlp_onnx(tmp_path / "e.onnx"), TOY, spec, **QUICK)
    live, horizon = 4, QUICK["horizon"]  # one of the five coordinates never moves
    assert result.report["frozen_coordinates"] == 1
    predicted = dict(result.report["predicted_queries"])
    if "basis" in spec:
        predicted["probe"] = predicted["probe"] * live // 5
    assert result.queries == predicted
    assert result.queries["act"] == QUICK["episodes"] * horizon
    assert result.queries["label"] == 0
    assert np.isfinite([entry["loss"] for entry in result.history]).all()
    assert result.student.predict(result.demonstrations.observations)[0].shape == (40, 2)


def test_the_student_becomes_the_expert(linear):
    longer = {"fit": fdtasil.Fit(steps=800), "student": fdtasil.Mlp(64), "episodes": 6}
    result = fdtasil.distill(linear, TOY, 4, **{**QUICK, **longer})
    assert result.evaluation.normalized_return == pytest.approx(1, abs=0.02)
    assert result.evaluation.action_error < 0.05
    assert result.evaluation.survival == 1


@pytest.mark.parametrize("kind", ["id", "instance", "factory"])
def test_every_way_to_name_an_environment(kind, linear, toy_environment):
    environment = {"id": TOY, "instance": toy_environment, "factory": Integrator}[kind]
    result = fdtasil.distill(linear, environment, 2, **QUICK)
    assert result.evaluation.episodes == 2


def test_same_seed_same_bytes(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    results = [fdtasil.distill(expert, TOY, 3, **QUICK, seed=s) for s in (5, 5, 6)]
    first, second, other = (r.student.to_bytes() for r in results)
    assert first == second != other
    assert results[0].export_bytes("student.onnx") == results[1].export_bytes("student.onnx")
    assert results[0].evaluation == results[1].evaluation
    assert results[0].history == results[1].history


def test_a_run_folder_holds_everything_and_reads_back(quick, tmp_path):
    folder = quick.save(tmp_path / "run")
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert names == {
        "README.md",
        "config.json",
        "report.json",
        "progress.csv",
        "figures/calibration.png",
        "demonstrations.npz",
        "student.safetensors",
        "student.onnx",
        "figures/training.png",
        "figures/returns.png",
        "manifest.json",
    }
    again = fdtasil.Distilled.load(folder)
    rows = quick.demonstrations.observations
    assert np.array_equal(again.student.act(rows), quick.student.act(rows))
    for name in ("evaluation", "history", "queries", "settings", "report"):
        assert getattr(again, name) == getattr(quick, name), name
    assert np.array_equal(again.answers.values, quick.answers.values)
    assert again.export_bytes("student.onnx") == (folder / "student.onnx").read_bytes()


def test_the_report_has_what_it_promises(quick_folder):
    report = json.loads((quick_folder / "report.json").read_text())
    assert {"path", "sha256", "return_mean"} <= set(report["expert"])
    promised = {"env", "trainer", "probes", "radius", "seed", "versions", "queries"}
    assert promised | {"train_seconds", "steps", "warnings"} <= set(report)
    promised = {"episodes", "horizon", "expert_return", "student_return", "normalized_return"}
    promised |= {"ci95", "survival", "action_error", "imitation_gap"}
    assert promised <= set(report["evaluation"])
    assert {"act", "label", "probe"} <= set(report["queries"])
    student, expert = (report["size"][name] for name in ("student", "expert"))
    assert student["bytes"] == 4 * student["parameters"] < student["c_constants"]
    assert all(student[f"{kind}microseconds"] > 0 for kind in ("", "onnx_"))
    assert student["c_memory"] > 0
    assert expert["onnx_microseconds"] is expert["c_memory"] is None


def test_the_onnx_file_stands_alone(quick, tmp_path):
    path = quick.to_onnx(tmp_path / "student.onnx")
    assert [p.name for p in tmp_path.iterdir()] == ["student.onnx"]
    metadata = {p.key: p.value for p in onnx.load(path).metadata_props}
    assert metadata["fdtasil.observation_size"] == "5"
    assert metadata["fdtasil.action_low"] == "-1,-1"
    assert {"fdtasil.expert_sha256", "fdtasil.normalized_return"} <= set(metadata)
    rows = quick.demonstrations.observations
    (answers,) = onnxruntime.InferenceSession(path).run(None, {"obs": rows})
    assert np.abs(answers - quick.student.act(rows)).max() <= 1e-5


def test_a_changed_file_is_named(quick_folder, tmp_path):
    folder = shutil.copytree(quick_folder, tmp_path / "run")
    weights = folder / "student.safetensors"
    data = bytearray(weights.read_bytes())
    data[-5] ^= 1
    weights.write_bytes(data)
    with pytest.raises(StorageError, match=r"student\.safetensors changed after writing"):
        fdtasil.Distilled.load(folder)


def test_the_budget_is_checked_before_anything_is_asked():
    def expensive(observations):
        raise AssertionError("asked")

    with pytest.raises(SettingError, match=r"may ask the expert .* probe 800"):
        fdtasil.distill(expensive, TOY, 10, max_queries=500, **QUICK)


def test_the_papers_preset(linear):
    quick = {**QUICK, "fit": preset_of("paper").fit_with(epochs=2)}
    result = fdtasil.distill(linear, TOY, 3, preset="paper", **quick)
    assert result.report["probes"] == "sphere:3,forward,raw,radius=0.01,per_step=all"
    lengths = np.linalg.norm(result.answers.displacements, axis=1)
    assert np.allclose(lengths, 0.01)
    assert result.settings["fit"]["weight"] == 0.01
    assert result.settings["fit"]["epochs"] == 2


def test_a_fit_that_is_left_out_is_the_presets(linear, monkeypatch):
    given = []

    def told(student, states, probes, answers, settings, *rest, **named):
        given.append(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr("fdtasil.run.training.fit", told)
    for preset in ("standard", "paper"):
        run = {**QUICK, "fit": None, "preset": preset}
        with pytest.raises(KeyboardInterrupt):
            fdtasil.distill(linear, TOY, 2, **run)
    assert given == [fdtasil.Fit(), preset_of("paper").fit]
    assert preset_of("paper").fit.epochs == 4500


def test_the_same_weight_means_the_same_for_every_number_of_probes(linear):
    once = {**QUICK, "fit": fdtasil.Fit(steps=1)}
    errors = [
        fdtasil.distill(linear, TOY, n, **once).history[0]["derivative_error"]
        for n in (1, 10, "basis")
    ]
    assert max(errors) / min(errors) < 1.3


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"trainer": "gail"}, "trainer='gail'"),
        ({"preset": "fast"}, "preset='fast'"),
        ({"seed": -1}, "seed=-1"),
        ({"episodes": 0}, "episodes=0"),
        ({"horizon": 0}, "horizon=0"),
        ({"evaluation_episodes": -1}, "evaluation_episodes=-1"),
        ({"device": "tpu"}, "device='tpu'"),
        ({"probes": "spere:3"}, "spere:3"),
        ({"max_queries": -1}, "max_queries=-1"),
    ],
)
def test_a_wrong_argument_is_named_at_once(wrong, found):
    def never(observations):
        raise AssertionError("asked")

    with pytest.raises(SettingError, match=found) as error:
        fdtasil.distill(never, TOY, **{"probes": 1, **QUICK, **wrong})
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda: fdtasil.Mlp(activation="step"), "activation='step'"),
        (lambda: fdtasil.Mlp((8, 0)), "hidden=0"),
        (lambda: fdtasil.Mlp("16"), "hidden='16'"),
        (lambda: fdtasil.Fit(steps=0), "steps=0"),
        (lambda: fdtasil.Fit(weight=-1), "weight=-1"),
    ],
)
def test_a_wrong_setting_of_an_object_is_named_where_it_is_made(make, found):
    with pytest.raises(SettingError, match=found) as error:
        make()
    assert len(str(error.value).splitlines()) <= 6


def test_evaluate_takes_students_and_files(quick, linear, tmp_path):
    from_torch = fdtasil.evaluate(quick.student, linear, TOY, episodes=3)
    from_file = fdtasil.evaluate(quick.to_onnx(tmp_path / "s.onnx"), linear, TOY, episodes=3)
    assert from_torch.normalized_return == pytest.approx(from_file.normalized_return, abs=1e-3)
    assert from_torch.horizon == 40
    perfect = fdtasil.evaluate(linear, linear, TOY, episodes=3)
    assert perfect.normalized_return == 1
    assert perfect.action_error == perfect.imitation_gap == 0
    assert perfect.ci95 == (1, 1)


def test_a_task_of_costs_is_normalised_against_random_actions():
    """Pendulum's returns are negative; their plain ratio would call a worse student better."""

    def swing(observations):
        cosine, sine, speed = observations.T
        return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]

    def idle(observations):
        return np.zeros((len(observations), 1))

    good = fdtasil.evaluate(swing, swing, "Pendulum-v1", episodes=4, horizon=100)
    bad = fdtasil.evaluate(idle, swing, "Pendulum-v1", episodes=4, horizon=100)
    assert good.reference_return < good.expert_return < 0
    assert good.normalized_return == 1
    assert bad.normalized_return < 0.5


def test_the_interval_holds_the_score_and_the_gap_is_in_deviations(linear):
    worse = fdtasil.evaluate(lambda x: 0.5 * x @ GAIN.T, linear, TOY, episodes=10)
    low, high = worse.ci95
    assert low < worse.normalized_return < high < 1
    assert 0.1 < worse.imitation_gap < 10


@pytest.mark.torture
@pytest.mark.parametrize(("name", "bar", "apart"), [("Walker2d", 0.90, 0.0), ("HalfCheetah", 0.93, 0.3)])  # fmt: skip  # noqa: E501
def test_the_papers_experts_are_copied_from_five_episodes(name, bar, apart, shared):
    """Three seeds each, default settings: the figures of the first issue."""
    expert, scores = shared / "experts" / f"{name}-v3.onnx", {10: [], 0: []}
    for seed in range(3):
        for probes, found in scores.items():
            result = fdtasil.distill(
                expert, f"{name}-v5", probes, episodes=5, horizon=300, seed=seed
            )
            found.append(result.evaluation.normalized_return)
    assert np.mean(scores[10]) >= bar
    assert np.mean(scores[10]) > np.mean(scores[0]) + apart


def test_a_resampling_source_stops_at_the_budget(linear, monkeypatch):
    """Falls can make it ask more than predicted, so it is held to the budget as it goes."""
    monkeypatch.setattr("fdtasil.run.configuration.Configuration.check_budget", lambda self: None)
    asked = []

    def counted(observations):
        asked.append(len(observations))
        return linear(observations)

    with pytest.raises(SettingError, match="more are due"):
        fdtasil.distill(counted, TOY, "sphere:2,resample", max_queries=2000, **QUICK)
    assert sum(asked) <= 2000


def test_no_evaluation_is_asked_for_and_none_is_made(linear):
    result = fdtasil.distill(linear, TOY, 2, **{**QUICK, "evaluation_episodes": 0})
    assert result.evaluation is None
    assert result.queries["evaluate"] == 0
    assert 0 < result.queries["check"] == result.report["predicted_queries"]["check"]


def test_the_prediction_keeps_the_ladder_that_was_asked(linear):
    """A central stencil was left open, and would have asked for a longer ladder than a forward."""
    shape = {**QUICK, "episodes": 15, "horizon": 40}
    report = fdtasil.distill(linear, TOY, 10, **shape).report
    assert report["calibration"]["stencil"] == "forward"
    assert report["queries"]["calibrate"] == report["predicted_queries"]["calibrate"] > 0


def test_numbers_of_numpy_are_as_good_as_python_s(linear):
    given = {
        "student": fdtasil.Mlp(np.int64(8)),
        "fit": fdtasil.Fit(steps=np.int64(5), weight=np.float32(0.5)),
        "episodes": np.int64(2),
    }
    plain = {"student": fdtasil.Mlp(8), "fit": fdtasil.Fit(steps=5, weight=0.5), "episodes": 2}
    ours, theirs = (
        fdtasil.distill(linear, TOY, 2, **{**QUICK, **numbers}).settings
        for numbers in (given, plain)
    )
    assert json.dumps(ours) == json.dumps(theirs)  # as config.json has them


def test_violations_of_constraints_are_counted(linear, tmp_path):
    limits = {
        "never": lambda states, actions: np.full(len(states), -1.0),
        "position": lambda states, actions: np.abs(states[:, 0]) - 0.5,
        "force": lambda states, actions: np.abs(actions).max(axis=1) > 0.2,
    }
    result = fdtasil.distill(linear, TOY, 3, **QUICK, constraints=limits)
    found = {name: (theirs, ours) for name, theirs, ours in result.evaluation.violations}
    assert found["never"] == (0, 0)
    assert 0 < found["position"][0] < 1
    assert 0 < found["force"][0] < 1
    same = fdtasil.evaluate(linear, linear, TOY, episodes=2, horizon=20, constraints=limits)
    for name, theirs, ours in same.violations:
        assert theirs == ours == found[name][0]
    assert "position          violated at" in str(same)
    loaded = fdtasil.Distilled.load(result.save(tmp_path / "run"))
    assert loaded.evaluation == result.evaluation


@pytest.mark.parametrize(
    ("limits", "found"),
    [
        ([1], "functions? of"),
        ({"a": 3}, "function of"),
        ({"a": lambda states, actions: states}, r"'a' returned shape \(\d+, 5\)"),
        ({"a": lambda states: states[:, 0]}, "'a' raised TypeError"),
        ({"a": lambda states, actions: states[:, 0] * np.nan}, "'a' returned NaN in"),
    ],
    ids=["list", "number", "shape", "raises", "nan"],
)
def test_what_is_no_constraint_is_refused(limits, found, linear):
    with pytest.raises(SettingError, match=found):
        fdtasil.evaluate(linear, linear, TOY, episodes=1, horizon=5, constraints=limits)
