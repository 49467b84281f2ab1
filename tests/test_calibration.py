"""The ladder of radii tells smooth, noisy and step-like experts apart."""

import numpy as np
import pytest
from conftest import mlp_onnx

from fdtasil.experts.load import load_expert
from fdtasil.probes.calibration import calibrate
from fdtasil.probes.scales import measure_scales

STATES = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
NOISE = np.random.default_rng(1)
EXPERTS = {
    "smooth": lambda clean: clean,
    "noisy": lambda clean: lambda x: clean(x) + 1e-3 * NOISE.standard_normal((len(x), 2)),
    "steps": lambda clean: lambda x: np.sign(clean(x)),
}


@pytest.mark.fault(44)
@pytest.mark.parametrize("regime", EXPERTS)
def test_regimes_are_told_apart(regime, tmp_path):
    clean = load_expert(mlp_onnx(tmp_path / "e.onnx", sizes=(5, 16, 16, 2))).answer
    expert = load_expert(EXPERTS[regime](clean))
    found = calibrate(expert, STATES, measure_scales(STATES), np.random.default_rng(0), 0.3)
    assert found.regime == regime
    assert found.stencil == ("forward" if regime == "smooth" else "central")
    assert found.radius == (0.5 if regime == "steps" else 0.3)
    assert found.queries == expert.queries["calibrate"] == 48 * 21
    if regime == "noisy":
        assert found.noise_floor == pytest.approx(1e-3, rel=0.3)
    if regime == "smooth":
        assert found.noise_floor < 1e-6


@pytest.mark.fault(243)
@pytest.mark.parametrize("offset", [0, 300, 3e3, 3e4])
def test_rounding_beside_an_offset_is_no_noise(offset):
    """What float32 rounds away of a step is nothing of the expert's."""
    rows = (offset + STATES).astype(np.float32)
    expert = load_expert(lambda x: np.tanh(x[:, :2].astype(np.float64) - offset))
    found = calibrate(expert, rows, measure_scales(rows), np.random.default_rng(0), 0.3)
    assert (found.regime, found.radius, found.stencil) == ("smooth", 0.3, "forward")
    assert len(found.radii) == len(found.similarity) == len(found.change) >= 2
