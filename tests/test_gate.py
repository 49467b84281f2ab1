"""What an expert must show before the first training step."""

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY, mlp_onnx

import fdtasil
from fdtasil.environments import Boxes
from fdtasil.errors import ExpertError, FdtasilWarning
from fdtasil.experts import check_expert, load_expert

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


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_every_fault_is_found_before_training(fault, monkeypatch):
    def never(*arguments, **named):
        raise AssertionError("training began")

    monkeypatch.setattr("fdtasil.rounds.fit", never)
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
    check_expert(load_expert(linear), rows, BOXES)


def test_a_missing_action_scale_is_suspected():
    wide = Boxes(5, -2 * np.ones(2, np.float32), 2 * np.ones(2, np.float32))
    rows = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
    with pytest.warns(FdtasilWarning, match="action scale missing"):
        check_expert(load_expert(lambda x: np.tanh(9 * x[:, :2])), rows, wide)


def test_an_expert_of_another_environment_is_refused_by_its_sizes(tmp_path):
    path = mlp_onnx(tmp_path / "e.onnx", sizes=(7, 8, 2))
    with pytest.raises(ExpertError, match="wants 7 observations, the environment gives 5"):
        fdtasil.distill(path, TOY, **QUICK)
