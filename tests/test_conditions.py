"""TaSIL's conditions: constants that are known, and inequalities that they must keep."""

import json
import math

import numpy as np
import pytest
from conftest import GAIN, TOY

import fdtasil
from fdtasil.probes.scales import measure_scales
from fdtasil.results.conditions import Errors, conditions_of, errors_of, sphere_factor
from fdtasil.results.stability import Law

STATES = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
SCALES = measure_scales(STATES)
# How far an action goes per unit of the root mean square deviation.
PER_DEVIATION = 5**0.5 * np.linalg.norm(GAIN * SCALES.deviation, 2)


def linear(factor):
    return lambda rows: factor * np.asarray(rows, np.float32) @ GAIN.T


def errors(student, expert, **more):
    random = np.random.default_rng(1)
    return errors_of(student, expert, STATES, np.ones(2), SCALES, random, **more)


@pytest.mark.parametrize("factor", [0.9, 1.0, 0.0])
def test_of_linear_laws_every_constant_is_known(factor):
    found = errors(linear(factor), linear(1.0))
    off = abs(1 - factor)
    most = np.linalg.norm(STATES @ GAIN.T, axis=1).max()
    assert found.action == pytest.approx(off * most, rel=1e-4, abs=1e-5)
    assert found.derivative == pytest.approx(off * PER_DEVIATION, rel=1e-3, abs=1e-3)
    assert found.lipschitz == pytest.approx(PER_DEVIATION, rel=1e-3)
    assert found.uncertainty < 1e-3
    assert found.curvature < 0.01
    assert found.derivative <= found.sphere < 8 * found.derivative + 0.1
    assert found.bend <= 2 * found.curvature
    assert found.states == 16


def test_held_coordinates_are_not_moved_and_count_in_the_norm():
    found = errors(linear(0.9), linear(1.0), held=(0, 3))
    moved = GAIN * SCALES.deviation * np.array([0, 1, 1, 0, 1])
    assert found.derivative == pytest.approx(0.1 * 5**0.5 * np.linalg.norm(moved, 2), rel=1e-3)


def test_a_kink_makes_the_differences_disagree():
    """Of |x|, a step that crosses the kink and one that does not say otherwise."""

    def kinked(rows):
        kink = STATES[0, 0] + 0.015 * SCALES.deviation[0]
        first = np.abs(np.asarray(rows, np.float32)[:, :1] - kink)
        return np.hstack([first, 0 * first])

    steep = 5**0.5 * SCALES.deviation[0]
    found = errors(linear(0.0), kinked)
    assert found.derivative == pytest.approx(steep, rel=1e-3)
    assert 0.05 * steep < found.uncertainty < steep


@pytest.mark.fault(229)
def test_states_without_an_answer_are_left_out_and_a_student_without_one_is_infinitely_far():
    def silent(rows):
        answers = linear(1.0)(rows)
        answers[np.asarray(rows)[:, 0] > 0] = np.nan
        return answers

    found = errors(linear(0.9), silent)
    assert 0 < found.states < 16
    assert found.derivative == pytest.approx(0.1 * PER_DEVIATION, rel=1e-3)
    assert errors(linear(0.9), lambda rows: np.nan * linear(1.0)(rows)) is None
    lost = errors(silent, linear(1.0))
    assert lost.action == lost.derivative == np.inf
    assert not any(one.met for one in conditions_of(lost, law(2.0, 1.0)))


def test_more_than_a_thousand_coordinates_are_not_gone_along():
    wide = np.random.default_rng(0).standard_normal((4, 1001))
    nobody = lambda rows: 1 / 0  # noqa: E731
    scales, random = measure_scales(wide), np.random.default_rng(0)
    assert errors_of(nobody, nobody, wide, np.ones(1), scales, random) is None


def test_of_a_quadratic_law_the_curvature_is_known():
    """c x^2 of one coordinate: its second difference is 2 c, in squared units of a deviation."""

    def square(rows):
        first = 0.3 * np.asarray(rows, np.float32)[:, :1] ** 2
        return np.hstack([first, 0 * first])

    found = errors(linear(0.0), square)
    assert found.curvature == pytest.approx(0.6 * 5 * SCALES.deviation[0] ** 2, rel=1e-2)


@pytest.mark.fault(227)
def test_curvature_between_two_coordinates_is_seen():
    """x y bends along no coordinate."""

    def product(rows):
        rows = np.asarray(rows, np.float32)
        first = rows[:, :1] * rows[:, 1:2]
        return np.hstack([first, 0 * first])

    most = 5 * SCALES.deviation[0] * SCALES.deviation[1]
    assert 0.3 * most < errors(linear(0.0), product).curvature < 1.01 * most


@pytest.mark.parametrize(("size", "directions"), [(1, 20), (5, 1), (17, 4), (17, 10), (100, 8)])
def test_the_sphere_bound_fails_seldom_enough(size, directions):
    random, trials, failed = np.random.default_rng(0), 2000, 0
    for _ in range(trials):
        matrix = random.standard_normal((3, size)) * np.array([[10.0], [1.0], [0.1]])
        drawn = random.standard_normal((directions, size))
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        seen = np.linalg.norm(drawn @ matrix.T, axis=1).max()
        failed += seen * sphere_factor(size, directions, 0.1) < 0.999999 * np.linalg.norm(
            matrix, 2
        )
    assert failed <= 0.1 * trials + 3 * (0.09 * trials) ** 0.5


def law(constant, nu, reach=(1e-9, np.inf)):
    return Law(constant, nu, reach, (constant, constant), (nu, nu), settled=True)


def made(**changed):
    known = {"action": 1e-4, "derivative": 1e-3, "uncertainty": 0.0, "sphere": 1.0, "states": 8}
    return Errors(**{**known, "lipschitz": 2.0, "curvature": 1.0, "bend": 2.0, **changed})


def allowed(condition, name="distance"):
    return next(most for asked, _, most in condition.asked if asked == name)


@pytest.mark.parametrize("nu", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("curvature", [0.1, 10.0])
@pytest.mark.parametrize("constant", [0.5, 5.0])
def test_theorem_3_2_keeps_its_premise(constant, curvature, nu):
    """L x^2 + (x / mu)^r <= gamma^-1(x) up to the distance that is allowed, and not far beyond."""
    found = conditions_of(made(curvature=curvature), law(constant, nu))[0]
    assert found.source == "theorem 3.2, p = 1"
    alpha, mu = allowed(found), 2**nu * constant

    def room(x):
        return (x / constant) ** (1 / nu) - (x / mu) ** (1 / nu) - curvature * x**2

    assert (room(np.linspace(1e-9, alpha, 1000)) >= -1e-12).all()
    if alpha < min(0.5, constant):  # not one of the caps
        assert room(1.01 * alpha) < 0
    small = 2 * 1e-3  # of both terms the larger
    assert found.asked[0][1] == pytest.approx(mu * small**nu)


@pytest.mark.parametrize("nu", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("constant", [0.5, 5.0])
def test_theorem_3_1_keeps_its_premise(constant, nu):
    """2 L x + (x / mu)^(1 / (1 + r)) <= gamma^-1(x) up to the distance that is allowed."""
    found = conditions_of(made(lipschitz=0.7, action=0.01), law(constant, nu))[0]
    assert found.source == "theorem 3.1, p = 0"
    assert found.asked[0][1] == pytest.approx(2**nu * constant * 0.01**nu)
    alpha, mu = allowed(found), 2**nu * constant

    def room(x):
        """A share of gamma^-1, which gets as small as 1e-10 here."""
        whole = (x / constant) ** (1 / nu)
        return (whole - (x / mu) ** (1 / nu) - 2 * 0.7 * x) / whole

    assert (room(np.linspace(1e-3, 1, 1000) * alpha) >= -1e-12).all()
    if alpha < constant:
        assert room(1.01 * alpha) < 0


def test_the_bounds_of_a_student_that_is_good_enough():
    """Of gamma(e) = 2 e with L = 1: what the theorems promise, and the smallest fixed point."""
    by = {one.source: one for one in conditions_of(made(), law(2.0, 1.0))}
    assert all(one.met for one in by.values())
    assert by["corollary, r = 1"].promised == pytest.approx(8 * 2 * 1e-4)
    assert by["theorem 3.2, p = 1"].promised == pytest.approx(4 * 2e-3)
    assert by["theorem A, p = r = 1"].promised == pytest.approx(4 * 4e-4)
    exact = ((0.5 - 1e-3) - math.sqrt((0.5 - 1e-3) ** 2 - 4e-4)) / 2
    assert by["proposition 3.1, solved"].promised == pytest.approx(exact, rel=0.07)
    assert by["proposition 3.1, solved"].promised < by["corollary, r = 1"].promised


def test_an_exponent_just_below_one_is_no_linear_law():
    """2 e^0.955 is above 2 e: with 2, the corollary would promise what no distance forgives."""
    nu, edge = 0.955, {"action": 1e-6, "derivative": 0.999 / 8, "curvature": 0.999e6 / 64}
    edge["bend"] = 2 * edge["curvature"]
    by = {one.source: one for one in conditions_of(made(**edge), law(2.0, nu, (1e-6, 0.1)))}
    assert not by["proposition 3.1, solved"].met
    assert not by["corollary, r = 1"].met
    assert not by["theorem A, p = r = 1"].met


def test_nothing_is_promised_below_what_was_measured():
    perfect = made(action=0.0, derivative=0.0)
    for one in conditions_of(perfect, law(2.0, 1.0, (1e-3, 0.1))):
        assert one.met
        assert one.promised >= 2e-3


@pytest.mark.parametrize(
    ("changed", "source", "name"),
    [
        ({"derivative": 0.2}, "corollary, r = 1", "|dDelta|"),
        ({"derivative": 0.1, "uncertainty": 0.1}, "corollary, r = 1", "|dDelta|"),
        ({"action": 0.1}, "corollary, r = 1", "|Delta|"),
        ({"derivative": 0.2}, "theorem A, p = r = 1", "|dDelta|"),
        ({"derivative": 0.6}, "theorem 3.2, p = 1", "distance"),
    ],
)
def test_what_is_asked_and_not_there_is_named(changed, source, name):
    by = {one.source: one for one in conditions_of(made(**changed), law(2.0, 1.0))}
    found = by[source]
    assert not found.met
    assert name in [asked for asked, here, most in found.asked if here > most]
    assert "not met" in str(found)


def test_a_disturbance_beyond_what_was_measured_is_not_allowed():
    for one in conditions_of(made(), law(2.0, 1.0, reach=(1e-7, 1e-6))):
        assert not one.met


def test_orders_without_a_statement():
    """nu = 0.4 asks for second derivatives, which are not measured."""
    (only,) = conditions_of(made(), law(2.0, 0.4))
    assert only.source == "proposition 3.1, solved"


@pytest.mark.parametrize("factor", [0.999, 0.5])
def test_a_run_of_its_own(factor):
    """A nearly equal student meets conditions whose bounds hold, and a poor one meets none."""
    found = fdtasil.diagnose(
        linear(factor), linear(1.0), TOY, episodes=4, horizon=30, progress=False
    )
    met = [one for one in found.conditions if one.met]
    assert bool(met) == (factor > 0.9)
    assert all(one.promised >= found.gap for one in met)
    assert "TaSIL's conditions" in str(found)
    plain = json.loads(json.dumps(found.to_json()))
    assert plain["conditions"][0]["source"] in str(found)
    assert plain["fidelity"]["radii"] == list(found.fidelity.radii)


@pytest.mark.fault(228)
def test_actions_are_compared_as_the_environment_takes_them():
    """A student that is its expert, but for a clip that the environment does anyway."""
    loud = lambda rows: 30 * linear(1.0)(rows)  # noqa: E731
    clipped = lambda rows: np.clip(loud(rows), -1, 1)  # noqa: E731
    found = fdtasil.diagnose(loud, clipped, TOY, episodes=2, horizon=30, progress=False)
    assert found.gap == found.largest_error == 0
    assert found.errors.action == found.errors.derivative == 0
