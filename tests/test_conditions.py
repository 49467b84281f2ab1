"""TaSIL's conditions: constants that are known, and inequalities that they must keep."""

import json
import math

import numpy as np
import pytest
from conftest import GAIN, TOY

import fdtasil
from fdtasil.experts.load import load_expert
from fdtasil.probes.scales import measure_scales
from fdtasil.results.conditions import Errors, conditions_of, errors_of, sphere_factor
from fdtasil.results.stability import Stability

STATES = np.random.default_rng(0).standard_normal((16, 5)).astype(np.float32)
SCALES = measure_scales(STATES)
# How far an action goes per unit of the root mean square deviation.
PER_DEVIATION = 5**0.5 * np.linalg.norm(GAIN * SCALES.deviation, 2)


def linear(factor):
    return lambda rows: factor * np.asarray(rows, np.float32) @ GAIN.T


def errors(student, expert):
    expert = load_expert(expert, 5, 2)
    return errors_of(student, expert, STATES, np.ones(2), SCALES, np.random.default_rng(1))


@pytest.mark.parametrize("factor", [0.9, 1.0, 0.0])
def test_of_linear_laws_every_constant_is_known(factor):
    found = errors(linear(factor), linear(1.0))
    off = abs(1 - factor)
    most = np.linalg.norm(STATES @ GAIN.T, axis=1).max()
    assert found.action == pytest.approx(off * most, rel=1e-4, abs=1e-5)
    assert found.derivative == pytest.approx(off * PER_DEVIATION, rel=1e-3, abs=1e-3)
    assert found.lipschitz == pytest.approx(PER_DEVIATION, rel=1e-3)
    assert found.difference < 1e-3
    assert found.curvature < 0.01
    assert found.derivative < found.sphere < 8 * found.derivative + 0.1


def test_of_a_quadratic_law_the_curvature_is_known():
    """c x^2 of one coordinate: its second difference is 2 c, in squared units of a deviation."""

    def square(rows):
        first = 0.3 * np.asarray(rows, np.float32)[:, :1] ** 2
        return np.hstack([first, 0 * first])

    found = errors(linear(0.0), square)
    assert found.curvature == pytest.approx(0.6 * 5 * SCALES.deviation[0] ** 2, rel=1e-3)


@pytest.mark.parametrize(("size", "directions"), [(5, 1), (17, 4), (17, 10), (100, 8)])
def test_the_sphere_bound_fails_seldom_enough(size, directions):
    random, trials, failed = np.random.default_rng(0), 2000, 0
    for _ in range(trials):
        matrix = random.standard_normal((3, size)) * np.array([[10.0], [1.0], [0.1]])
        drawn = random.standard_normal((directions, size))
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        seen = np.linalg.norm(drawn @ matrix.T, axis=1).max()
        failed += seen * sphere_factor(size, directions, 0.1) < np.linalg.norm(matrix, 2)
    assert failed <= 0.1 * trials + 3 * (0.09 * trials) ** 0.5


def stability(constant, nu, reach=np.inf):
    return Stability((), (), constant, nu, (nu, nu), reach)


def made(**changed):
    known = {"action": 1e-4, "derivative": 1e-3, "difference": 0.0, "sphere": 1.0}
    return Errors(**{**known, "lipschitz": 2.0, "curvature": 1.0, **changed})


def allowed(condition, name="distance"):
    return next(most for asked, _, most in condition.asked if asked == name)


@pytest.mark.parametrize("nu", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("curvature", [0.1, 10.0])
@pytest.mark.parametrize("constant", [0.5, 5.0])
def test_theorem_3_2_keeps_its_premise(constant, curvature, nu):
    """L x^2 + (x / mu)^r <= gamma^-1(x) up to the distance that is allowed, and not far beyond."""
    found = conditions_of(made(curvature=curvature), stability(constant, nu))[0]
    assert found.source == "theorem 3.2, p = 1"
    alpha, mu = allowed(found), 2**nu * constant
    x = np.linspace(1e-9, alpha, 1000)
    room = (x / constant) ** (1 / nu) - (x / mu) ** (1 / nu) - curvature * x**2
    assert (room >= -1e-12).all()
    beyond = 1.01 * (0.5 / (curvature * constant ** (1 / nu))) ** (1 / (2 - 1 / nu))
    assert curvature * beyond**2 + (beyond / mu) ** (1 / nu) > (beyond / constant) ** (1 / nu)


@pytest.mark.parametrize("nu", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("constant", [0.5, 5.0])
def test_theorem_3_1_keeps_its_premise(constant, nu):
    """2 L x + (x / mu)^(1 / (1 + r)) <= gamma^-1(x) up to the distance that is allowed."""
    found = conditions_of(made(lipschitz=0.7), stability(constant, nu))[0]
    assert found.source == "theorem 3.1, p = 0"
    alpha, mu = allowed(found), 2**nu * constant
    x = np.linspace(1e-3, 1, 1000) * alpha
    room = (x / constant) ** (1 / nu) - (x / mu) ** (1 / nu) - 2 * 0.7 * x
    assert (room >= -1e-12 * (x / constant) ** (1 / nu)).all()


def test_the_bounds_of_a_student_that_is_good_enough():
    """Of gamma(e) = 2 e with L = 1: what the theorems promise, and the smallest fixed point."""
    by = {one.source: one for one in conditions_of(made(), stability(2.0, 1.0))}
    assert all(one.met for one in by.values())
    assert by["corollary, r = 1"].bound == pytest.approx(8 * 2 * 1e-4)
    assert by["theorem 3.2, p = 1"].bound == pytest.approx(4 * 2e-3)
    assert by["theorem A, p = r = 1"].bound == pytest.approx(4 * 4e-4)
    exact = ((0.5 - 1e-3) - math.sqrt((0.5 - 1e-3) ** 2 - 4e-4)) / 2
    assert by["proposition 3.1, solved"].bound == pytest.approx(exact, rel=0.07)
    assert by["proposition 3.1, solved"].bound < by["corollary, r = 1"].bound


@pytest.mark.parametrize(
    ("changed", "source", "name"),
    [
        ({"derivative": 0.2}, "corollary, r = 1", "|dDelta|"),
        ({"derivative": 0.1, "difference": 0.1}, "corollary, r = 1", "|dDelta|"),
        ({"action": 0.1}, "corollary, r = 1", "|Delta|"),
        ({"derivative": 0.2}, "theorem A, p = r = 1", "|dDelta|"),
        ({"derivative": 0.6}, "theorem 3.2, p = 1", "distance"),
    ],
)
def test_what_is_asked_and_not_there_is_named(changed, source, name):
    by = {one.source: one for one in conditions_of(made(**changed), stability(2.0, 1.0))}
    found = by[source]
    assert found.bound is None
    assert name in [asked for asked, here, most in found.asked if here > most]
    assert "not met" in str(found)


def test_a_disturbance_beyond_what_was_measured_is_not_allowed():
    for one in conditions_of(made(), stability(2.0, 1.0, reach=1e-6)):
        assert one.bound is None
    assert conditions_of(made(), Stability((), (), None, None, None)) == ()


def test_orders_without_a_statement():
    """nu = 0.4 asks for second derivatives, which are not measured."""
    (only,) = conditions_of(made(), stability(2.0, 0.4))
    assert only.source == "proposition 3.1, solved"


@pytest.mark.parametrize("factor", [0.999, 0.5])
def test_a_run_of_its_own(factor):
    """A nearly equal student meets conditions whose bounds hold, and a poor one meets none."""
    found = fdtasil.diagnose(
        linear(factor), linear(1.0), TOY, episodes=4, horizon=30, progress=False
    )
    met = [one for one in found.conditions if one.met]
    assert bool(met) == (factor > 0.9)
    assert all(one.bound >= found.gap for one in met)
    assert "TaSIL's conditions" in str(found)
    plain = json.loads(json.dumps(found.to_json()))
    assert plain["conditions"][0]["source"] in str(found)
    assert plain["fidelity"]["radii"] == list(found.fidelity.radii)
