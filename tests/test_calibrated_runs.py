"""Radius and stencil that a call leaves open are found by asking, and reported."""

import warnings

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil.errors import FdtasilWarning, SettingError

pytestmark = pytest.mark.usefixtures("no_pictures")

EXPERTS = {
    "smooth": lambda x: np.tanh(x @ GAIN.T),
    "steps": lambda x: np.floor(8 * (20 * (x @ GAIN.T) % 1)) / 16,
}


def pseudonoise(observations):
    """A smooth law and a noise that is the same for equal observations."""
    clean = np.tanh(observations @ GAIN.T)
    chaos = 1e6 * np.sin(
        1e6 * observations.astype(np.float64) @ np.cos(np.arange(10.0)).reshape(5, 2)
    )
    return clean + 0.02 * (chaos % 1 - 0.5)


@pytest.mark.parametrize(
    ("regime", "stencil", "radius"), [("smooth", "forward", 0.3), ("steps", "central,both", 0.5)]
)
def test_an_open_source_is_completed(regime, stencil, radius):
    result = fdtasil.distill(EXPERTS[regime], TOY, 3, **QUICK)
    found = result.report["calibration"]
    assert found["regime"] == regime
    assert result.report["radius"] == found["radius"] == radius
    assert f"adaptive:3,{stencil},whitened,radius={radius}" in result.report["probes"]
    assert result.queries["calibrate"] == found["queries"] == 208
    rows = (1 if stencil == "forward" else 2) * 3 * len(result.demonstrations)
    assert result.queries["probe"] == rows
    assert result.report["predicted_queries"]["probe"] == rows


@pytest.mark.fault(220)
@pytest.mark.parametrize("dead_zone", [0.0, 0.1])
def test_a_law_that_switches_is_asked_far_and_wide(dead_zone):
    """Near a state nothing changes: what is learnt there is nothing."""

    def relay(x):
        force = x @ GAIN.T
        return np.sign(force) * (np.abs(force) > dead_zone)

    result = fdtasil.distill(relay, TOY, 3, **QUICK)
    assert result.report["calibration"]["switches"]
    assert result.report["radius"] == [0.2, 2.0]
    assert ",both," in result.report["probes"]
    assert "radius=0.4," in fdtasil.distill(relay, TOY, "3,radius=0.4", **QUICK).report["probes"]


def test_what_the_caller_says_stays():
    spec = "sphere:3,forward,radius=0.4"
    result = fdtasil.distill(EXPERTS["smooth"], TOY, spec, **QUICK)
    assert result.report["probes"] == "sphere:3,forward,whitened,radius=0.4,per_step=1"


@pytest.mark.parametrize("probes", ["jacobian", "sphere:3,raw,radius=0.1", 0])
def test_nothing_is_asked_where_nothing_is_to_be_found(probes):
    module = torch.nn.Linear(5, 2, bias=False, device="meta").to_empty(device="cpu")
    module.load_state_dict({"weight": torch.from_numpy(GAIN)})
    result = fdtasil.distill(module, TOY, probes, **QUICK)
    assert result.queries["calibrate"] == 0
    assert result.report["calibration"] is None


@pytest.mark.fault(87)
def test_a_radius_in_the_noise_is_warned_of_with_the_reason():
    with pytest.warns(
        FdtasilWarning, match=r"radius=0.005: .* is noise; the calibration suggests"
    ):
        result = fdtasil.distill(pseudonoise, TOY, "sphere:3,radius=0.005", **QUICK)
    assert result.report["calibration"]["regime"] == "noisy"
    assert any("radius=0.005" in text for text in result.report["warnings"])


@pytest.mark.fault(88)
def test_a_radius_across_the_kinks_is_warned_of():
    def kinked(x):
        return np.abs(np.sin(4 * x @ GAIN.T)) / 2

    with pytest.warns(FdtasilWarning, match=r"radius=8: differences there .* agree to"):
        fdtasil.distill(kinked, TOY, "sphere:3,radius=8", **QUICK)


def test_a_good_radius_is_not_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error", FdtasilWarning)
        fdtasil.distill(EXPERTS["smooth"], TOY, "sphere:3,radius=0.2", **QUICK)


def test_a_resumed_run_takes_the_calibration_up(tmp_path):
    class Stop(Exception):
        pass

    def stop(event):
        if event.kind == "entry":
            raise Stop

    with pytest.raises(Stop):
        fdtasil.distill(EXPERTS["steps"], TOY, 3, **QUICK, out=tmp_path / "a", callback=stop)
    whole = fdtasil.distill(EXPERTS["steps"], TOY, 3, **QUICK, out=tmp_path / "b")
    resumed = fdtasil.distill(EXPERTS["steps"], TOY, 3, **QUICK, resume=tmp_path / "a")
    assert resumed.report["calibration"] == whole.report["calibration"]
    assert resumed.queries["calibrate"] == whole.queries["calibrate"]
    assert resumed.student.to_bytes() == whole.student.to_bytes()


def test_a_student_that_sees_nothing_move_is_told_so(linear):
    with pytest.raises(SettingError, match="sees no coordinate that can be probed"):
        fdtasil.distill(linear, TOY, 3, student_obs=[4], **QUICK)
