"""The ladder of radii tells smooth, noisy and step-like experts apart."""

import numpy as np
import pytest
from conftest import mlp_onnx

from fdtasil.experts.load import load_expert
from fdtasil.probes.calibration import calibrate, ladder_for
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.stencils import CENTRAL, FORWARD

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


def found_of(law, rows=STATES):
    """Return the calibration of a law of the first two coordinates."""
    scales = measure_scales(rows)
    return calibrate(load_expert(law), rows, scales, np.random.default_rng(0), 0.3)


def tanh(steepness, sigma=0.0, seed=5):
    """A law that is steep around zero, and maybe noisy."""
    random = np.random.default_rng(seed)
    return lambda x: np.tanh(steepness * x[:, :2]) + sigma * random.standard_normal((len(x), 2))


def stairs(x):
    return np.floor(8 * (20 * x[:, :2] % 1)) / 16


def answered_near(law, reach):
    """Of a law: answers around the states alone."""

    def near(x):
        answers = law(x).astype(float)
        answers[np.abs(x[:, None] - STATES).max(axis=2).min(axis=1) > reach] = np.nan
        return answers

    return near


def test_noise_of_a_thousandth_is_noise():
    """It rules at a hundredth of a deviation, and far above what float32 rounds."""
    found = found_of(tanh(1, 1e-3))
    assert (found.regime, found.stencil) == ("noisy", "central")
    assert found.noise_floor == pytest.approx(1e-3, rel=0.2)
    assert found_of(tanh(1)).regime == "smooth"


def test_a_law_that_bends_within_the_radius_is_asked_on_both_sides():
    """Both are smooth; the steep one is bent from one bound to the other."""
    gentle, steep = found_of(tanh(3)), found_of(tanh(8))
    assert gentle.regime == steep.regime == "smooth"
    assert (gentle.stencil, steep.stencil) == ("forward", "central")


def test_a_law_that_is_steep_beside_its_own_actions_is_held_to_labels_too():
    """As a swing-up that ends in a balance: actions vary little there, and much beside it."""

    def balance(x):
        return np.tanh(3 * (x[:, :1] - x[:, 1:2]))

    balanced = STATES.copy()
    balanced[:, 1] = balanced[:, 0] + 0.03 * balanced[:, 1]
    assert found_of(balance, balanced).match == "both"
    assert found_of(balance).match is None
    assert found_of(tanh(8)).match is None


@pytest.mark.parametrize(
    ("law", "nearest"), [(tanh(1), 0.2), (tanh(1, 0.01), 0.2), (tanh(1, 0.05), 1.0), (stairs, 0.5)]
)
def test_many_distances_begin_where_a_difference_is_more_than_noise(law, nearest):
    """From 0.2, or as near as the expert allows, to 2; the ladder's rungs are factors of four."""
    assert found_of(law).complete(Probes.parse("fresh")).radius == (nearest, 2.0)


def test_what_the_caller_says_of_stencil_and_match_stays():
    for spec, stencil in {"3,forward,labels": FORWARD, "3,central,differences": CENTRAL}.items():
        asked = Probes.parse(spec)
        for law in (tanh(1), tanh(1, 0.01), lambda x: np.sign(x[:, :2])):
            told = found_of(law).complete(asked)
            assert (told.stencil, told.match) == (stencil, asked.match)


def test_a_radius_stays_where_most_states_have_answers():
    near, whole = found_of(answered_near(tanh(1), 0.02)), found_of(tanh(1))
    assert near.radius == near.radii[-1] == 4.0**-4
    assert whole.radius == 0.3
    assert dict(near.no_answer)[1.0] == 1.0


@pytest.mark.fault(357)
def test_an_action_that_is_never_used_hides_no_switch():
    assert found_of(lambda x: np.stack([np.sign(x[:, 0]), 0 * x[:, 0]], axis=1)).switches
    assert not found_of(lambda x: 0 * x[:, :2]).switches


def test_a_switch_that_is_answered_nearby_alone_is_not_asked_far_and_wide():
    switch = lambda x: np.sign(x[:, :2])  # noqa: E731
    assert found_of(switch).switches
    near = found_of(answered_near(switch, 0.1))
    assert not near.switches
    assert near.complete(Probes.parse("3")).radius <= 0.0625


@pytest.mark.parametrize(
    "law",
    [
        lambda x: np.stack([np.sign(x[:, 0]), np.tanh(x[:, 1])], axis=1),
        lambda x: np.round(2 * np.tanh(x[:, :2])) / 2,
    ],
    ids=["one is smooth", "five values"],
)
def test_a_law_switches_where_each_action_has_two_or_three_values(law):
    assert not found_of(law).switches


@pytest.mark.parametrize("rows", [2_100, 9_000, 12_000, 1_000_000])
def test_a_calibration_takes_a_tenth_of_the_probes_at_most(rows):
    assert ladder_for(rows).queries <= 0.1 * rows


@pytest.mark.parametrize("gain", [1.5, 3, 6])
def test_a_law_that_is_mostly_at_its_bounds_has_its_derivative_between_them(gain):
    """At half of the states, at three quarters, at nearly nine of ten."""
    found = found_of(lambda x: np.clip(gain * x[:, :1], -1, 1))
    assert (found.regime, found.radius, found.stencil) == ("smooth", 0.3, "central")


@pytest.mark.parametrize("depth", [2, 8])
def test_a_tree_has_none_whatever_its_size(depth):
    ends = np.random.default_rng(0).standard_normal((depth, 5))
    found = found_of(lambda x: (x @ ends.T > 0).sum(axis=1, keepdims=True) / depth)
    assert found.regime == "steps"
