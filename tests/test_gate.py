"""What an expert must show before the first training step."""

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning
from fdtasil.experts.gate import admit_expert
from fdtasil.experts.load import load_expert
from fdtasil.rollouts.environments import Boxes

pytestmark = pytest.mark.usefixtures("no_pictures")

BOXES = Boxes(5, -np.ones(2, np.float32), np.ones(2, np.float32))
NOISE = np.random.default_rng(0)

FAULTS = {
    "stochastic": (
        lambda rows: rows @ GAIN.T + 0.1 * NOISE.standard_normal((len(rows), 2)),
        "asked twice differs",
    ),
    "batch dependent": (
        lambda rows: (rows - rows.mean(axis=0)) @ GAIN.T,
        "asked alone and in a batch differs",
    ),
    "out of bounds": (lambda rows: 30 * rows @ GAIN.T, "leaves the action bounds"),
    "not finite": (lambda rows: np.log(-np.abs(rows[:, :2])), "not finite"),
    "wrong size": (lambda rows: rows[:, :1], r"answered .* with shape \(16, 1\)"),
    "one row only": (lambda rows: GAIN @ rows[0], "shape"),
}


@pytest.mark.fault(38, 40, 41, 52, 59)
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_every_fault_is_found_before_training(fault, nothing_is_trained):
    expert, found = FAULTS[fault]
    with pytest.raises(ExpertError, match=found) as error:
        fdtasil.distill(expert, TOY, 3, **QUICK)
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.filterwarnings("default::fdtasil.errors.FdtasilWarning")
def test_force_turns_what_can_be_lived_with_into_a_warning():
    expert, _ = FAULTS["out of bounds"]
    with pytest.warns(FdtasilWarning, match="leaves the action bounds"):
        result = fdtasil.distill(expert, TOY, 1, force=True, **QUICK)
    assert any("leaves the action bounds" in note for note in result.report["warnings"])
    with pytest.raises(ExpertError):
        fdtasil.distill(FAULTS["wrong size"][0], TOY, 1, force=True, **QUICK)


def test_a_good_expert_passes(linear):
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (16, 5)).astype(np.float32)
    admit_expert(load_expert(linear), rows, BOXES)


@pytest.mark.fault(39)
def test_a_missing_action_scale_is_suspected():
    wide = Boxes(5, -2 * np.ones(2, np.float32), 2 * np.ones(2, np.float32))
    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    with pytest.warns(FdtasilWarning, match="action scale missing"):
        admit_expert(load_expert(lambda x: np.tanh(9 * x[:, :2])), rows, wide)


@pytest.mark.fault(33)
def test_an_expert_of_another_environment_is_refused_by_its_sizes(tmp_path):
    path = mlp_onnx(tmp_path / "e.onnx", sizes=(7, 8, 2))
    with pytest.raises(ExpertError, match="wants 7 observations, the environment gives 5"):
        fdtasil.distill(path, TOY, **QUICK)


# --- what a review found, and must not come back


def test_another_width_than_the_environments_is_refused(tmp_path, linear):
    path = mlp_onnx(tmp_path / "e.onnx", extra_outputs={"value": 1})
    with pytest.raises(ExpertError, match="has 1 actions, the environment has 2"):
        fdtasil.distill(fdtasil.load_expert(path, output="value"), TOY, 0, **QUICK)
    with pytest.raises(ExpertError, match="has 1 actions, the environment has 2"):
        fdtasil.load_expert(path, 5, 2, output="value")
    narrow = fdtasil.Expert(lambda rows: rows[:, :1], "narrow", action_size=1)
    with pytest.raises(ExpertError, match="has 1 actions, the environment has 2"):
        fdtasil.distill(narrow, TOY, 0, **QUICK)


def test_a_factory_that_hands_out_one_environment_is_used_one_episode_at_a_time(linear):
    one = Integrator()
    shared = fdtasil.distill(linear, lambda: one, 2, **QUICK)
    fresh = fdtasil.distill(linear, Integrator, 2, **QUICK)
    found, expected = (run.demonstrations.observations for run in (shared, fresh))
    assert np.allclose(found, expected, atol=1e-5)


@pytest.mark.fault(274)
@pytest.mark.parametrize("unit", [1.0, 1e5])
def test_an_action_in_large_numbers_does_not_hide_the_noise_of_another(unit):
    boxes = Boxes(5, np.full(2, -np.inf, np.float32), np.full(2, np.inf, np.float32))
    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    random = np.random.default_rng(1)

    def noisy(given):
        noise = 0.05 * random.standard_normal(len(given))
        return np.stack([unit * given[:, 0], given[:, 1] + noise], axis=1)

    with pytest.raises(ExpertError, match="asked twice differs"):
        admit_expert(load_expert(noisy), rows, boxes)


@pytest.mark.fault(307)
@pytest.mark.parametrize("bound", [3.0, 1e4])
def test_bounds_far_beyond_what_is_done_hide_neither_noise_nor_a_batch(bound):
    boxes = Boxes(5, np.full(2, -bound, np.float32), np.full(2, bound, np.float32))
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (16, 5)).astype(np.float32)
    random = np.random.default_rng(1)
    noisy = lambda x: x[:, :2] + 0.3 * random.standard_normal((len(x), 2))  # noqa: E731
    mean = lambda x: x[:, :2] + x.mean()  # noqa: E731
    for expert, what in ((noisy, "asked twice"), (mean, "asked alone")):
        with pytest.raises(ExpertError, match=what):
            admit_expert(load_expert(expert), rows, boxes)
    # A last layer that scales to the bounds rounds by more than the actions' own digits.
    first, last = (
        random.standard_normal(shape).astype(np.float32) for shape in ((5, 64), (64, 2))
    )
    law = lambda x: bound * np.tanh(np.tanh(x @ first) @ last / bound)  # noqa: E731
    admit_expert(load_expert(law), rows, boxes, largest=1024)


@pytest.mark.fault(281)
def test_chance_that_few_rows_did_not_show_is_not_taken_for_the_size_of_a_batch():
    """With `batch=16` as advice, the check that found it would be gone."""
    random = np.random.default_rng(0)

    def rare(rows):
        answers = rows @ GAIN.T
        if len(rows) > 100:  # so seldom that few rows are spared
            answers[random.random(len(rows)) < 0.02] = 0
        return answers

    with pytest.raises(ExpertError, match=r"asked the same [\d,]+ observations twice") as caught:
        fdtasil.distill(rare, TOY, 50, **QUICK)
    assert "batch=" not in caught.value.next_step


def test_a_half_bounded_action_does_not_switch_the_checks_off():
    boxes = Boxes(5, np.full(2, -np.inf, np.float32), np.ones(2, np.float32))
    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    with pytest.raises(ExpertError, match="asked twice differs"):
        admit_expert(load_expert(FAULTS["stochastic"][0]), rows, boxes)


def test_a_failed_gate_leaves_the_folder_free(tmp_path, linear):
    with pytest.raises(ExpertError):
        fdtasil.distill(FAULTS["stochastic"][0], TOY, 1, out=tmp_path / "run", **QUICK)
    assert fdtasil.distill(linear, TOY, 1, out=tmp_path / "run", **QUICK).evaluation


def test_a_stable_baselines3_policy_is_asked_through_predict():
    class Scaled(torch.nn.Module):
        def forward(self, observations):
            """In [-1, 1], before scaling."""
            return torch.tanh(observations[:, :2])

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return 2 * np.tanh(observation[:, :2]), None

    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    answers = load_expert(Scaled(), 5, 2).ask(rows, "act")
    assert np.allclose(answers, 2 * np.tanh(rows[:, :2]))


def test_a_predict_without_options_is_a_predict():
    class Regressor:
        def predict(self, rows):
            return rows @ GAIN.T

    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    assert load_expert(Regressor(), 5, 2).ask(rows, "act").shape == (16, 2)


@pytest.mark.fault(62)
def test_an_expert_worse_than_chance_has_no_share():
    def idle(observations):
        return np.zeros((len(observations), 1))

    def spin(observations):
        return 2 * np.sign(observations[:, 2:3]) + 0.0

    with pytest.warns(FdtasilWarning, match="not above"):
        found = fdtasil.evaluate(idle, spin, "Pendulum-v1", episodes=3, horizon=100)
    assert found.normalized_return is None
    assert found.ci95 is None
    assert "n/a" in str(found)


@pytest.mark.fault(329)
def test_a_counter_in_the_expert_is_not_taken_for_the_batch():
    """It moves on by a call: rows that are asked alone differ, and do so once more."""
    calls = iter(range(10**6))

    def drifting(rows):
        next(calls)
        return rows @ GAIN.T * (1 + 3e-4 * (next(calls) > 8) * np.sin(next(calls)))

    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (16, 5)).astype(np.float32)
    with pytest.raises(ExpertError, match="the same single observations twice") as caught:
        admit_expert(load_expert(drifting), rows, BOXES)
    assert "batch=1" not in caught.value.next_step
