"""The Jacobian of any expert by differences, beside the analytic one, and its own error."""

import numpy as np
import pytest
from conftest import QUICK, TOY
from toy_forms import InForm

import fdtasil
from fdtasil import gains
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.probes.derivatives import check_derivatives, comparison_rows
from fdtasil.rollouts.environments import EnvironmentPool

N, M, HIDDEN = 6, 3, 64
WEIGHTS = [
    np.random.default_rng(1).standard_normal(shape) / shape[0] ** 0.5
    for shape in ((N, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, M))
]
SCALE = np.array([1, 0.1, 5, 1, 2, 0.01])
STATES = np.random.default_rng(0).standard_normal((40, N)) * SCALE + [0, 3, 0, 0, 10, 0]


def network(rows):
    first, second, last = (weights.astype(np.float32) for weights in WEIGHTS)
    return np.tanh(np.tanh(rows @ first) @ second) @ last


def analytic(rows):
    first, second, last = WEIGHTS
    inner = np.tanh(rows @ first)
    outer = np.tanh(inner @ second)
    left = np.einsum("ni,bi,ij->bnj", first, 1 - inner**2, second)
    return np.einsum("bnj,bj,jm->bmn", left, 1 - outer**2, last)


def noisy(sigma):
    random = np.random.default_rng(5)
    return lambda rows: network(rows) + sigma * random.standard_normal((len(rows), M))


EXPERTS = {
    "float32": (lambda: network, 1e-3),
    "noise of 0.001": (lambda: noisy(1e-3), 0.12),
    "noise of 0.01": (lambda: noisy(1e-2), 0.4),
    "steps of 1/64": (lambda: lambda rows: np.round(64 * network(rows)) / 64, 0.25),
}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("make", "bound"), EXPERTS.values(), ids=EXPERTS)
def test_the_error_is_small_and_known_within_a_factor_of_two(make, bound, seed):
    found = gains(make(), STATES, seed=seed)
    exact = analytic(STATES.astype(np.float32).astype(float))
    error = np.linalg.norm((found.jacobian - exact) * found.scale)
    error /= np.linalg.norm(exact * found.scale)
    assert error < bound
    assert 0.5 < found.relative_error / error < 2
    assert found.queries == 2 * 10 * 64 + 4 * N * len(STATES)


def test_the_noise_floor_is_the_noise():
    found = gains(noisy(1e-2), STATES)
    assert found.noise_floor == pytest.approx(np.full(M, 1e-2), rel=0.4)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_error_of_a_law_that_bends_nowhere_is_that_of_its_noise(seed):
    gain = np.random.default_rng(2).standard_normal((M, N)).astype(np.float32)
    random = np.random.default_rng(seed)
    law = lambda rows: rows @ gain.T + 0.01 * random.standard_normal((len(rows), M))  # noqa: E731
    found = gains(law, STATES / SCALE, seed=seed)
    apart = np.linalg.norm(np.sqrt(((found.jacobian - gain) ** 2).mean(axis=0)) * found.scale)
    assert 0.75 < np.linalg.norm(found.error * found.scale) / apart < 1.35


@pytest.mark.fault(361)
def test_one_state_of_one_coordinate_has_its_derivative_and_an_honest_error():
    """All rays are the same two points there, and some answers agree to the bit by luck."""
    for place in np.random.default_rng(0).uniform(-1, 1, 40):
        found = gains(np.sin, np.array([[place]]))
        apart = abs(found.jacobian.item() / np.cos(np.float32(place)) - 1)
        assert apart < 1e-4
        assert 0 < found.relative_error < 1e-3
        assert apart < 5 * found.relative_error


def test_a_linear_expert_is_exact_and_a_single_state_is_enough():
    gain = np.random.default_rng(2).standard_normal((2, 4)).astype(np.float32)
    found = gains(lambda rows: rows @ gain.T, np.zeros((1, 4)))
    assert found.jacobian[0] == pytest.approx(gain, abs=1e-5)
    constant = gains(lambda rows: rows[:, :1] * 0 + 1, np.zeros((1, 4)))
    assert (constant.jacobian == 0).all()


def test_a_state_without_an_answer_beside_it_has_none():
    def limited(rows):
        answers = rows[:, :2].copy()
        answers[rows[:, 0] > 1] = np.nan
        return answers

    found = gains(limited, np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0.1, 1]]))
    assert np.isfinite(found.jacobian[[0, 2]]).all()
    assert np.isnan(found.jacobian[1, :, 0]).all()
    assert found.jacobian[1, :, 1:] == pytest.approx(np.array([[0, 0], [1, 0]]), abs=1e-4)
    assert np.isfinite(found.relative_error)


@pytest.mark.parametrize(
    "states", [[], [[np.nan]], np.zeros(3), "states", None, [[1, 2], [3]]], ids=str
)
def test_states_that_can_not_be_used_are_refused(states):
    with pytest.raises(SettingError, match="finite observations"):
        gains(network, states)
    with pytest.raises(SettingError, match="6,\\) positive numbers"):
        gains(network, STATES, scale=[1, 2])
    with pytest.raises(ExpertError, match="raised"):
        gains(lambda rows: rows @ np.zeros((3, 1)), STATES)


LINEAR = np.random.default_rng(3).standard_normal((2, 5)).astype(np.float32) / 4


def sensitive(rows, sign=1.0):
    """Return actions and, as a solver with exact sensitivities would, their derivatives."""
    angles = rows @ LINEAR.T
    slopes = np.cos(angles)[:, :, None] * LINEAR
    return np.sin(angles), sign * slopes


class Solver:
    def predict(self, observation):
        return sensitive(observation)[0], None

    def jacobian(self, observations):
        return sensitive(observations)[1]


class WritesIntoItsRows(Solver):
    def jacobian(self, observations):
        slopes = super().jacobian(observations)
        observations[:] = 0
        return slopes


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(
    "expert", [sensitive, Solver(), WritesIntoItsRows()], ids=["function", "object", "careless"]
)
def test_derivatives_that_an_expert_gives_are_the_analytic_reference(expert):
    result = fdtasil.distill(expert, TOY, probes="jacobian", progress=False, **QUICK)
    answers, states = result.dataset.answers, result.dataset.demonstrations.observations
    along = answers.displacements[answers.numbers]
    exact = np.einsum("bmn,bkn->bkm", sensitive(states)[1], along)
    assert answers.values[:, :, 0] == pytest.approx(exact, abs=1e-5)
    assert np.isfinite(result.evaluation.normalized_return)
    report = result.report
    assert report["queries"]["probe"] == report["predicted_queries"]["probe"] > len(states)
    with pytest.raises(SettingError, match="at most max_queries"):
        fdtasil.distill(expert, TOY, probes="jacobian", max_queries=1500, **QUICK)


@pytest.mark.fault(210)
@pytest.mark.usefixtures("nothing_is_trained")
def test_derivatives_of_something_else_are_named():
    run = {**QUICK, "probes": "jacobian", "progress": False}
    with pytest.raises(ExpertError, match="not those of its actions: of action"):
        fdtasil.distill(lambda rows: sensitive(rows, sign=-1), TOY, **run)
    with pytest.raises(ExpertError, match="can't be differentiated: it returns its actions alone"):
        fdtasil.distill(lambda rows: sensitive(rows)[0], TOY, **run)
    with pytest.raises(ExpertError, match=r"derivatives of shape \(\d+, 5, 2\)"):
        fdtasil.distill(
            lambda rows: (sensitive(rows)[0], sensitive(rows)[1].transpose(0, 2, 1)), TOY, **run
        )
    with pytest.raises(ExpertError, match=r"derivatives of shape \(\d+, 4, 5\)"):
        fdtasil.distill(
            lambda rows: (sensitive(rows)[0], np.tile(sensitive(rows)[1], (1, 2, 1))), TOY, **run
        )
    with pytest.raises(ExpertError, match="gives derivatives that are not finite"):
        fdtasil.distill(lambda rows: sensitive(rows, sign=np.nan), TOY, **run)
    with pytest.raises(SettingError, match="gives itself"):
        fdtasil.distill(sensitive, TOY, **{**run, "fit": fdtasil.Fit(steps=40, order=2)})


def test_derivatives_that_are_nearly_those_of_the_actions_are_good_enough():
    """Of a solver that ends early; a tenth too much is another law."""
    rows = np.random.default_rng(0).standard_normal((50, 5)).astype(np.float32)
    nearly, other = (
        load_expert(lambda rows, s=s: sensitive(rows, sign=s), 5) for s in (1.01, 1.1)
    )
    check_derivatives(nearly, rows)
    assert nearly.queries["probe"] == comparison_rows(5)
    with pytest.raises(ExpertError, match="not those of its actions"):
        check_derivatives(other, rows)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_wrong_derivative_is_found_whatever_the_unit_of_its_coordinate(unit):
    units = np.array([unit, 1, 1, 1, 1])

    def twice_the_first(rows):
        answers, slopes = sensitive(rows / units.astype(np.float32))
        return answers, slopes / units * [2, 1, 1, 1, 1]

    rows = np.random.default_rng(0).standard_normal((50, 5)) * units
    with pytest.raises(ExpertError, match=r"of action \d by coordinate 0 "):
        check_derivatives(load_expert(twice_the_first, 5), rows.astype(np.float32))


@pytest.mark.fault(235)
@pytest.mark.parametrize("spread", [0.3, 0.1])
@pytest.mark.parametrize("law", [np.tanh, np.sin, lambda x: np.clip(x, -1, 1)])
def test_an_offset_that_float32_rounds_beside_is_no_failure(law, spread):
    """A thermostat: 300 kelvins, and a few tenths of them around."""
    rows = 300 + spread * np.random.default_rng(0).standard_normal((50, 2))
    rows = rows.astype(np.float32)

    def thermostat(observations):
        return law(20 * (observations[:, :1].astype(np.float64) - 300))

    found = gains(thermostat, rows)
    inner = 20 * (rows[:, 0].astype(np.float64) - 300)
    near = 1e-6 * (law(inner + 1e6**-1) - law(inner - 1e6**-1)) / 2e-12
    smooth = np.abs(law(inner + 0.2) - law(inner - 0.2) - 0.4 * near) < 0.02  # no kink nearby
    assert found.jacobian[smooth, 0, 0] == pytest.approx(20 * near[smooth], abs=0.2)


def test_a_large_constant_is_differenced_in_steps_that_float32_has():
    rows = np.random.default_rng(0).standard_normal((20, 3))
    rows[:, 2] = 1.7e9  # a time stamp
    found = gains(lambda seen: np.tanh(seen[:, :1]), rows)
    exact = 1 - np.tanh(rows[:, 0].astype(np.float32)) ** 2
    assert found.jacobian[:, 0, 0] == pytest.approx(exact, abs=1e-3)
    assert (found.jacobian[:, 0, 1:] == 0).all()


def test_a_scale_that_is_rounded_away_is_refused():
    with pytest.raises(SettingError, match="scale 1e-12 of coordinate 0"):
        gains(lambda rows: rows[:, :1], np.full((3, 2), 1e4), scale=np.full(2, 1e-12))


def test_a_coordinate_that_stands_still_does_not_hide_the_error_of_others():
    """A setpoint of millimetres, whose scale of 1 m is no measured one."""
    random = np.random.default_rng(0)
    place, speed = 4e-3 + 1e-4 * random.normal(size=20), 1e-3 * random.normal(size=20)
    rows = np.column_stack([np.full(20, 4e-3), place, speed])

    def law(seen):
        return 500 * np.tanh((4e4 * (seen[:, :1] - seen[:, 1:2]) - 1500 * seen[:, 2:]) / 500)

    found = gains(law, rows)
    assert found.still == (0,)
    assert "still      0: moved by parts of 1" in str(found)
    assert 1e-4 < found.relative_error < 0.1
    told = gains(law, rows, scale=np.array([1e-4, 1e-4, 1e-3]))
    assert told.still == ()
    assert told.relative_error < 1e-3

    alone = gains(lambda seen: seen[:, :1] - 4, rows)  # of what stands still
    assert alone.relative_error < 0.05


@pytest.mark.fault(327)
@pytest.mark.parametrize("count", [1, 5, 8])
def test_a_law_at_its_bounds_has_no_derivative_but_0(count):
    law = lambda rows: np.clip(rows @ np.array([[3.0], [1.0]]), -1, 1)  # noqa: E731
    states = np.random.default_rng(count).standard_normal((200, 2))
    states = states[np.abs(states @ [3.0, 1.0]) > 1.5][:count]
    with pytest.warns(fdtasil.FdtasilWarning, match="does not change its actions"):
        found = gains(law, states)
    wrong = np.abs(found.jacobian).max() > 0
    assert found.unmoved[0] >= 0.01
    assert found.relative_error == (1.0 if wrong else 0.0)
    assert ("these are no derivatives" in str(found)) == wrong


@pytest.mark.parametrize("seed", range(3))
def test_a_law_of_few_coordinates_is_not_taken_for_one_at_its_bounds(seed):
    """Few rays meet the two coordinates that each action depends on, and most of those are cut."""
    law = lambda rows: np.clip(-2 * rows[:, :17] - rows[:, 17:], -1, 1)  # noqa: E731
    states = np.random.default_rng(seed).standard_normal((50, 34))
    assert not gains(law, states, seed=seed).unmoved.any()


@pytest.mark.parametrize("seed", range(5))
def test_answers_in_steps_are_differenced_across_them(seed):
    gain, step = np.array([[0.3], [0.1]]), 1 / 31
    law = lambda rows: np.rint(rows @ gain / step) * step  # noqa: E731
    found = gains(law, np.random.default_rng(seed).standard_normal((1, 2)))
    assert not found.unmoved.any()
    assert found.jacobian[0, 0] == pytest.approx(gain[:, 0], abs=0.1)


def test_one_law_at_its_bounds_takes_nothing_from_the_others():
    law = lambda rows: np.stack([0.5 * rows[:, 0], np.clip(rows[:, 0] + 3, -1, 1)], 1)  # noqa: E731
    states = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 2))
    with pytest.warns(fdtasil.FdtasilWarning, match=r"its actions \(1\)"):
        found = gains(law, states)
    assert found.jacobian[:, 0, 0] == pytest.approx(0.5, abs=1e-3)
    assert found.error[0].max() < 1e-3


@pytest.mark.fault(353)
def test_an_expert_of_dictionaries_is_asked_in_its_own_form():
    def law(parts):
        return np.tanh(parts["place"]) - 0.5 * parts["speed"]

    made = lambda: InForm("dictionary")  # noqa: E731
    result = fdtasil.distill(law, made, 0, **QUICK)
    states = result.demonstrations.observations[:3]
    with EnvironmentPool(made) as pool:
        place, speed = (list(pool.spaces.observations.columns(one)) for one in ("place", "speed"))
    found = gains(law, states, env=made)
    assert np.allclose(found.jacobian[:, [0, 1], speed], -0.5, atol=1e-3)
    expected = 1 - np.tanh(states[:, place]) ** 2
    assert np.allclose(found.jacobian[:, [0, 1], place], expected, atol=1e-3)
