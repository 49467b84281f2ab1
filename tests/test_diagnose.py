"""Diagnostics on systems whose answers are known."""

import json
from dataclasses import replace

import gymnasium
import numpy as np
import onnx
import pytest
from conftest import GAIN, TOY, mlp_onnx
from scipy.stats import spearmanr
from toy_environments import Integrator
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.probes.scales import action_units, measure_scales
from fdtasil.results.fidelity import fidelity_of
from fdtasil.results.stability import Law, Stability, _interval, distances, stability_of
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.shell.gains import command as gains_command

STIFFNESS = 0.2
SIZES = (1e-3, 3e-3, 1e-2, 3e-2)
SIDES = np.array([[-1.0], [1.0]])  # states of deviation 1


class PowerLaw(gymnasium.Env):
    """x' = x - 0.2 sign(x) |x|^(1/nu) + u: under a lasting u it rests at (u / 0.2)^nu."""

    def __init__(self, nu):
        self.nu = nu
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 1)
        return self.x.copy(), {}

    def step(self, action):
        self.x = self.x - STIFFNESS * np.sign(self.x) * np.abs(self.x) ** (1 / self.nu) + action
        return self.x.copy(), 1.0, False, False, {}


def rest(rows):
    return np.zeros((len(rows), 1), np.float32)


def measured(nu, sizes, horizon, system=PowerLaw, episodes=6, unit=1.0):
    """In units of the state itself."""
    with EnvironmentPool(lambda: system(nu)) as pool:
        expert = load_expert(rest, 1, 1)
        own = rollout(follow(expert.policy("act")), pool, range(episodes), horizon)
        scales, seeds = measure_scales(SIDES), range(episodes)
        units = np.full(1, unit)
        return stability_of(expert, own, pool, horizon, units, scales, seeds, sizes)


def test_a_loop_that_forgives_in_proportion():
    """Linear: gamma(e) = e / 0.2 exactly, whatever the path."""
    found = measured(1.0, SIZES, 100)
    law = found.law
    assert law.settled
    assert law.exponent == pytest.approx(1.0, rel=0.01)
    assert law.constant == pytest.approx(1 / STIFFNESS, rel=0.01)
    assert law.constants == pytest.approx((law.constant,) * 2, rel=0.01)
    assert law.order == 1  # theorem 3.1, of order 0, is for exponents above 1
    assert law.gamma(0.01) == pytest.approx(0.05, rel=0.02)
    assert law.gamma(1e-9) == law.gamma(1e-3)
    assert found.rate == pytest.approx(1 - STIFFNESS, rel=1e-3)
    assert found.rate_interval == pytest.approx((found.rate,) * 2, rel=1e-3)
    assert law.reach == pytest.approx((1e-3, 3e-2), rel=1e-4)


def test_a_law_is_of_four_sizes_between_rounding_and_a_third_of_a_deviation():
    """The first leads to half of what float32 leaves of a path, and the last to a half."""
    sizes = (1e-6, 3e-6, 1e-5, 1e-4, 1e-3, 3e-2, 0.1)
    assert measured(1.0, sizes, 60).law.reach == pytest.approx((3e-6, 3e-2), rel=0.01)
    assert measured(1.0, SIZES[:3], 60).law is None


def test_a_disturbance_is_measured_in_units_of_the_actions():
    found = measured(1.0, SIZES, 60, unit=0.1)
    assert found.sizes == pytest.approx(SIZES, rel=1e-3)
    assert found.law.constant == pytest.approx(0.1 / STIFFNESS, rel=0.01)


def test_two_paths_are_apart_while_both_last():
    with EnvironmentPool(lambda: PowerLaw(1.0)) as pool:
        own = rollout(follow(rest), pool, range(3), 20)
    valid = np.arange(20) < np.array([[5], [12], [20]])
    beside = np.where(valid[..., None], own.observations + 0.1, 0)
    other, scales = replace(own, valid=valid, observations=beside), measure_scales(SIDES)
    for pair in ((own, other), (other, own)):
        assert distances(*pair, scales) == pytest.approx(0.1 / scales.deviation[0], rel=1e-4)


def test_fewer_than_five_episodes_have_no_interval():
    four, five = (measured(1.0, SIZES, 40, episodes=count) for count in (4, 5))
    assert four.law.interval is four.rate_interval is None
    assert four.rate == pytest.approx(five.rate, rel=1e-3)
    assert None not in (five.law.interval, five.rate_interval)


def test_an_interval_over_episodes_holds_the_mean_95_times_of_100():
    random = np.random.default_rng(0)
    found = np.array([_interval(random.normal(1, 2, 6)) for _ in range(2000)])
    assert ((found[:, 0] < 1) & (found[:, 1] > 1)).mean() == pytest.approx(0.95, abs=0.012)


@pytest.mark.fault(226)
def test_an_episode_that_ends_does_not_look_like_recovery():
    """All deviations stay as they are: x' = x + u. Half of the episodes end after ten steps."""

    class Ending(PowerLaw):
        def step(self, action):
            self.x, self.done = self.x + action, self.done + 1
            return self.x.copy(), 1.0, bool(self.start > 0 and self.done == 10), False, {}

        def reset(self, *, seed=None, options=None):
            seen, info = super().reset(seed=seed)
            self.start, self.done = seen[0], 0
            return seen, info

    assert measured(1.0, SIZES, 40, Ending).rate == pytest.approx(1, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("nu", "order"), [(0.8, 1), (0.4, 2)])
def test_one_that_forgives_less_asks_for_a_higher_order(nu, order):
    """Two paths rest (e / 0.2) ** nu apart, and pass at 2 ** (1 - nu) times that at most.

    That is where a path that comes to rest from one side meets one that is pushed to the other.
    """
    sizes = (6e-4, 1e-3, 2e-3, 3e-3)
    law = measured(nu, sizes, 700).law
    assert law.settled
    assert law.exponent == pytest.approx(nu, rel=0.1)
    for size in sizes:
        assert 1 < law.gamma(size) / (size / STIFFNESS) ** nu < 2 ** (1 - nu)
    assert law.order == order


@pytest.mark.fault(247)
def test_while_deviations_grow_no_order_is_asked_for():
    """Every smooth loop forgives in proportion at first, and so does this one, whose nu is 1/2."""
    law = measured(0.5, (1e-4, 3e-4, 1e-3, 3e-3), 25).law
    assert not law.settled
    assert law.order is None
    assert "a law of these steps" in str(law)


@pytest.mark.fault(247)
def test_half_of_an_episode_that_ends_is_half_of_its_own_steps():
    """x' = 1.3 x + u, which ends after ten steps of forty."""

    class Growing(PowerLaw):
        def step(self, action):
            self.x, self.done = 1.3 * self.x + action, self.done + 1
            return self.x.copy(), 1.0, self.done == 10, False, {}

        def reset(self, *, seed=None, options=None):
            self.done = 0
            return super().reset(seed=seed)

    assert not measured(1.0, (1e-5, 3e-5, 1e-4, 3e-4), 40, Growing).law.settled


@pytest.mark.parametrize(
    ("interval", "said"),
    [((0.9, 1.0), "1"), ((0.3, 0.7), "1 to 3"), ((-0.1, 0.7), "1 to above 9"), ((1.2, 1.3), "0")],
)
def test_orders_of_an_interval(interval, said):
    law = Law(2.0, sum(interval) / 2, (1e-3, 0.1), (1.0, 2.0), interval, settled=True)
    assert str(law).endswith(f"order that the theorems ask for: {said}")


@pytest.mark.parametrize(
    ("exponent", "order"),
    [(1.06, 0), (1.04, 1), (0.51, 1), (0.5, 2), (0.34, 2), (0.26, 3), (0.101, 9), (0.1, None)],
)
def test_the_order_is_the_least_that_has_a_theorem(exponent, order):
    """Theorem 3.2 holds for p >= 1 and nu > 1 / (p + 1), 3.1 for nu > 1, measured surely."""
    law = Law(2.0, exponent, (1e-3, 0.1), (1.0, 2.0), None, settled=True)
    assert law.order == order
    assert replace(law, settled=False).order is None


def test_what_is_reached_is_of_all_sizes_up_to_the_next_larger_one():
    found = Stability((1e-3, 1e-2, 1e-1), (0.2, 0.1, 0.4), (0, 0, 0), None)
    assert [found.reached(size) for size in (1e-4, 5e-3, 1e-2, 2e-2)] == [0.2, 0.2, 0.2, 0.4]
    assert found.reached(0.2) is None


UNITS = np.ones(2)


def linear(gain):
    return lambda rows: np.asarray(rows, np.float32) @ gain.T


def test_fidelity_of_known_laws():
    """Linear laws: the error of a difference is that of the gain, at every radius."""
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    expert, scales = linear(GAIN), measure_scales(states)
    random = np.random.default_rng(0)
    for factor in (1.0, 0.9, 0.0, 2.0):
        found = fidelity_of(linear(factor * GAIN), expert, states, UNITS, scales, random)
        assert found.errors == pytest.approx([abs(factor - 1)] * 4, abs=1e-3)
        assert found.action_error == pytest.approx(abs(factor - 1), rel=0.1, abs=1e-3)
    assert max(found.roughness) < 0.01
    noisy = lambda rows: linear(GAIN)(rows) + 0.01 * np.sin(1e5 * rows[:, :2])  # noqa: E731
    rough = fidelity_of(linear(GAIN), noisy, states, UNITS, scales, random).roughness
    assert rough[0] > 10 * max(found.roughness)


def test_a_radius_of_fidelity_is_in_deviations_of_each_coordinate():
    """A student that adds a parabola of four coordinates is off by sqrt(1 + radius^2)."""
    deviations = np.array([1.0, 20.0, 0.3, 5.0])
    states = np.random.default_rng(0).standard_normal((2000, 4)) * deviations
    plane = lambda rows: (rows / deviations).sum(axis=1, keepdims=True)  # noqa: E731
    bent = lambda rows: plane(rows) + ((rows / deviations) ** 2).sum(axis=1)[:, None] / 2  # noqa: E731
    scales, random = measure_scales(states), np.random.default_rng(1)
    found = fidelity_of(bent, plane, states.astype(np.float32), np.ones(1), scales, random)
    assert found.errors == pytest.approx(np.sqrt(1 + np.square(found.radii)), rel=0.03)


def test_the_error_of_a_student_without_an_experts_noise_is_the_experts_roughness():
    states = np.random.default_rng(0).standard_normal((1000, 5)).astype(np.float32)
    random, scales = np.random.default_rng(1), measure_scales(states)
    noisy = lambda rows: linear(GAIN)(rows) + random.normal(0, 0.05, (len(rows), 2))  # noqa: E731
    found = fidelity_of(linear(GAIN), noisy, states, UNITS, scales, np.random.default_rng(0))
    assert found.errors == pytest.approx(found.roughness, rel=0.05)
    assert found.errors[0] > 0.9 > 0.3 > found.errors[-1]


def test_an_action_that_hardly_varies_is_measured_by_its_range():
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    scales, random = measure_scales(states), np.random.default_rng(0)
    still, nearly = GAIN * np.float32([[1], [1e-8]]), GAIN * np.float32([[1], [1e-3]])
    found = fidelity_of(linear(nearly), linear(still), states, UNITS, scales, random)
    assert 0 < found.error < 0.01
    nothing = fidelity_of(linear(GAIN), linear(1e-8 * GAIN), states, UNITS, scales, random)
    assert np.isnan(nothing.errors).all()


@pytest.mark.fault(318)
@pytest.mark.parametrize(("size", "half"), [(1e-8, 1.0), (1.0, 1e6)])
def test_fidelity_is_the_same_in_every_unit(size, half):
    """Of actions without bounds the unit is what they vary by; bounds may be far beyond."""
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    low = np.full(2, -np.inf if half == 1 else -half)
    units = action_units(low, -low, linear(size * GAIN)(states))
    scales, random = measure_scales(states), np.random.default_rng(0)
    pair = linear(0.9 * size * GAIN), linear(size * GAIN)
    found = fidelity_of(*pair, states, units, scales, random)
    assert found.errors == pytest.approx([0.1] * 4, abs=1e-3)


class _Unbounded(Integrator):
    def __init__(self):
        super().__init__()
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def step(self, action):
        return super().step(np.clip(np.asarray(action) / 1e-6, -1, 1))


@pytest.mark.fault(318)
def test_disturbances_of_actions_without_bounds_are_in_their_own_unit():
    expert = lambda rows: np.clip(linear(1e-6 * GAIN)(rows), -1e-6, 1e-6)  # noqa: E731
    student = lambda rows: 0.9 * expert(rows)  # noqa: E731
    found = fdtasil.diagnose(student, expert, _Unbounded, episodes=2, horizon=20)
    assert found.fidelity.error == pytest.approx(0.1, abs=0.01)
    assert 0.01 < found.largest_error < 1


def test_coordinates_that_are_held_are_no_part_of_fidelity():
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    scales, other = measure_scales(states), GAIN.copy()
    other[:, 1] += 1
    for held in ((), (1,)):
        random = np.random.default_rng(0)
        found = fidelity_of(linear(other), linear(GAIN), states, UNITS, scales, random, held)
        assert (found.error < 1e-3) == (held == (1,))


@pytest.mark.parametrize("factor", [0.97, 1.02])
def test_a_gap_is_what_the_law_says(factor):
    student = lambda rows: linear(factor * GAIN)(rows)  # noqa: E731
    found = fdtasil.diagnose(student, linear(GAIN), TOY, episodes=6, horizon=30, progress=False)
    assert 0 < found.gap <= found.by_law < 2 * found.disturbed
    assert found.gap <= found.disturbed
    assert found.largest_error < found.stability.law.reach[1]
    assert "theorem 3.2" in str(found)
    same = fdtasil.diagnose(
        linear(GAIN), linear(GAIN), TOY, episodes=2, horizon=30, progress=False
    )
    assert same.gap == same.largest_error == same.fidelity.error == 0


def test_a_student_of_another_environment_is_told_so():
    run = {"episodes": 2, "horizon": 20, "evaluation_episodes": 0, "fit": fdtasil.Fit(steps=5)}
    result = fdtasil.distill(linear(GAIN), TOY, 0, **run)
    for judge in (fdtasil.diagnose, fdtasil.evaluate):
        with pytest.raises(ExpertError, match="has 5 observations, the environment has 4"):
            judge(result, lqr, "InvertedPendulum-v5", horizon=20)


def never(rows):
    raise AssertionError("asked")


@pytest.mark.slow
def test_better_students_have_better_derivatives(tmp_path):
    expert = linear(GAIN)
    returns, errors = [], []
    for steps in (5, 60, 1500):
        result = fdtasil.distill(
            expert, TOY, 5, episodes=2, horizon=30, evaluation_episodes=5,
            student=fdtasil.Mlp(32), fit=fdtasil.Fit(steps=steps),
        )  # fmt: skip
        returns.append(result.evaluation.action_error)
        found = fdtasil.diagnose(
            result.student, expert, TOY, episodes=3, horizon=30, progress=False
        )
        errors.append(found.fidelity.error)
    assert spearmanr(returns, errors).statistic == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "student_obs",
    [None, [3, 2, 1, 0], lambda rows: rows[:, ::-1]],
    ids=["whole", "some", "function"],
)
def test_a_result_and_its_folder_are_students(student_obs, tmp_path):
    expert, run = linear(GAIN), {"episodes": 2, "horizon": 30, "evaluation_episodes": 2}
    result = fdtasil.distill(
        expert, TOY, "3,forward", student_obs=student_obs, student=fdtasil.Mlp(8),
        fit=fdtasil.Fit(steps=30), **run,
    )  # fmt: skip
    look = {"episodes": 2, "horizon": 20, "progress": False}
    found = fdtasil.diagnose(result, expert, TOY, **look)
    own = fdtasil.diagnose(result.view.policy(result.student.act), expert, TOY, **look)
    assert found.fidelity == own.fidelity
    folder = result.save(tmp_path)
    if callable(student_obs):  # which is said before anybody plays
        for judge in (fdtasil.diagnose, fdtasil.evaluate):
            with pytest.raises(SettingError, match="no file can hold"):
                judge(folder, never, TOY, **look)
        return
    assert fdtasil.diagnose(str(folder), expert, TOY, **look).fidelity == found.fidelity
    judged = fdtasil.evaluate(folder, expert, TOY, episodes=2, horizon=30)
    assert judged == result.evaluation


def test_what_can_not_be_diagnosed():
    chosen = in_form(linear(GAIN), "box", "choice")
    with pytest.raises(SettingError, match="choices"):
        fdtasil.diagnose(chosen, chosen, lambda: InForm("box", "choice"), horizon=10)


def test_a_student_that_sees_the_past_is_moved_in_the_present(tmp_path):
    expert, look = linear(GAIN), {"episodes": 2, "horizon": 20, "progress": False}
    run = {"student": fdtasil.Mlp(32), "evaluation_episodes": 0, **look, "episodes": 8}
    few, many = (
        fdtasil.distill(expert, TOY, 10, history=2, fit=fdtasil.Fit(steps=steps), **run)
        for steps in (5, 400)
    )
    poor, found = (fdtasil.diagnose(result, expert, TOY, **look) for result in (few, many))
    plain = fdtasil.diagnose(expert, expert, TOY, **look)
    assert 2 * found.fidelity.error < poor.fidelity.error
    assert found.stability == plain.stability  # of the expert, in its own observations
    assert plain.conditions
    assert not found.conditions and found.errors is None and found.linearisation is None  # noqa: PT018
    file = many.export(tmp_path / "s.onnx")
    alike = fdtasil.diagnose(file, expert, TOY, **look).fidelity.errors
    assert alike == pytest.approx(found.fidelity.errors, rel=1e-3)


def test_the_command(tmp_path, inside):
    expert = mlp_onnx(tmp_path / "e.onnx")
    done = inside(
        "diagnose", expert, TOY, "--expert", expert, "--episodes", "2", "--horizon", "20"
    )
    assert done.returncode == 0, done.stderr
    assert "closed loop" in done.stdout


def clipped(rows):
    return np.clip(linear(30 * GAIN)(rows), -1, 1)


@pytest.mark.fault(248)
def test_an_expert_at_its_bound_is_disturbed_as_far_as_any():
    full = lambda rows: np.ones((len(rows), 2), np.float32)  # noqa: E731
    with EnvironmentPool(TOY) as pool:
        expert = load_expert(full, 5, 2)
        own = rollout(follow(expert.policy("act")), pool, [0], 10)
        scales = measure_scales(np.stack([-np.ones(5), np.ones(5)]))
        seed = next(s for s in range(99) if np.random.default_rng(s).standard_normal(2).min() > 0)
        for sizes in ((1e-2,), (0.5,)):
            found = stability_of(expert, own, pool, 10, UNITS, scales, [seed], sizes)
            assert found.sizes == pytest.approx(sizes, rel=1e-3)
            assert found.deviations[0] > 0.1 * sizes[0]


@pytest.mark.fault(248, 249)
def test_a_disturbance_that_is_clipped_goes_to_the_other_side():
    """Such an expert is at its bounds nearly everywhere, where half of them would do nothing."""
    found = fdtasil.diagnose(
        lambda rows: 0.97 * clipped(rows), clipped, TOY, episodes=5, horizon=30
    )
    assert 0 < found.gap <= found.by_law
    assert max(found.stability.sizes) <= 8**0.5 + 1e-6  # from one bound to the other, both actions
    assert found.largest_error > found.stability.law.reach[1]
    assert f"it was measured up to {found.stability.law.reach[1]:.1g}" in str(found)


@pytest.mark.fault(250)
def test_where_deviations_jump_the_law_ends():
    """Of a law that switches: below some size it never switches at another time."""
    switching = lambda rows: np.sign(linear(GAIN)(rows))  # noqa: E731
    loop = fdtasil.diagnose(switching, switching, TOY, episodes=5, horizon=30).stability
    steps = np.array(loop.deviations[1:]) / np.array(loop.deviations[:-1])
    assert steps.max() > 50
    sizes, reached = np.array(loop.sizes), np.array(loop.deviations)
    covered = (loop.law.reach[0] <= sizes) & (sizes <= loop.law.reach[1])
    law = np.array([loop.law.gamma(size) for size in sizes[covered]])
    assert (law >= reached[covered] * 0.9999).all()
    assert (law <= 2 * reached[covered]).all()
    assert loop.law.reach[1] < sizes[1:][steps.argmax()]


class Falling(gymnasium.Env):
    """x' = 1.6 x + u / 2; beyond 0.12 it has fallen."""

    observation_space = gymnasium.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-0.1, 0.1, 1)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = 1.6 * self.x + 0.5 * np.asarray(action, np.float64)
        return self.x.astype(np.float32), 1.0, bool(abs(self.x[0]) > 0.12), False, {}


@pytest.mark.fault(251)
def test_a_student_that_falls_at_once_is_not_near():
    expert = lambda rows: np.clip(-1.2 * np.asarray(rows, np.float32), -1, 1)  # noqa: E731
    found = fdtasil.diagnose(np.ones_like, expert, Falling, episodes=4, horizon=30)
    assert found.ended == 4
    assert "at least: 4 ended before the expert's" in str(found)
    assert found.stability.ended[-1] == 8  # both of each episode
    assert "(8 ended early, of two from each start)" in str(found)
    assert 0 < found.stability.reached(1e-3) < found.stability.reached(0.1)
    assert found.stability.reached(3) is None  # from one bound to the other is 2


@pytest.mark.fault(252)
def test_an_expert_without_an_answer_here_and_there():
    def silent(rows):
        answers = linear(GAIN)(rows)
        answers[np.abs(np.asarray(rows)[:, 0]) < 0.05] = np.nan
        return answers

    found = fdtasil.diagnose(linear(-0.9 * GAIN), silent, TOY, episodes=3, horizon=30)
    assert 0 < found.unanswered < 0.5
    assert found.fidelity.answered < 1
    assert found.fidelity.error == pytest.approx(1.9, rel=1e-3)
    mute = lambda rows: linear(GAIN)(rows) * np.where(rows[:, :1] > 0.5, np.nan, 1)  # noqa: E731
    states = np.random.default_rng(0).uniform(-0.4, 0.4, (99, 5)).astype(np.float32)
    scales, random = measure_scales(states), np.random.default_rng(0)
    found = fidelity_of(mute, linear(GAIN), states, UNITS, scales, random)
    assert found.errors[0] == pytest.approx(0, abs=1e-6)
    assert found.errors[-1] == np.inf
    whole = np.arange(20, dtype=np.float32).reshape(4, 5)
    only = lambda rows: linear(GAIN)(rows) + np.where(rows % 1, np.nan, 0)[:, :2]  # noqa: E731
    found = fidelity_of(linear(GAIN), only, whole, UNITS, measure_scales(whole), random)
    assert np.isnan(found.errors).all()
    assert found.answered == 0


@pytest.mark.fault(253)
def test_errors_are_those_of_actions_as_the_environment_takes_them():
    loud = linear(30 * GAIN)
    assert fdtasil.diagnose(loud, clipped, TOY, episodes=2, horizon=30).fidelity.error == 0
    still = lambda rows: np.full((len(rows), 2), 0.3, np.float32)  # noqa: E731
    found = fdtasil.diagnose(linear(0.1 * GAIN), still, TOY, episodes=2, horizon=30)
    assert np.isnan(found.fidelity.error)
    assert "does not react" in str(found)
    assert json.loads(json.dumps(found.to_json()))["fidelity"]["errors"] == [None] * 4
    assert "nan" not in str(found)
    # An action counts by how much it varies, not by its unit.
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    mixed = GAIN * np.array([[100.0], [1.0]], np.float32)
    half = mixed * np.array([[1.0], [0.0]], np.float32)
    scales, random = measure_scales(states), np.random.default_rng(0)
    found = fidelity_of(linear(half), linear(mixed), states, UNITS, scales, random)
    assert found.error == pytest.approx(0.5**0.5, rel=0.1)


@pytest.mark.fault(254)
def test_actions_that_are_no_controls_have_no_linearised_loop():
    scaled = gymnasium.wrappers.RescaleAction(
        gymnasium.make("InvertedPendulum-v5"), np.float32(-1), np.float32(1)
    )
    third = lambda rows: lqr(rows) / 3  # noqa: E731
    found = fdtasil.diagnose(third, third, scaled, episodes=2, horizon=20)
    assert found.linearisation is None


class Cells(gymnasium.Env):
    """Five places in a row; an action of enough size steps to the next."""

    observation_space = gymnasium.spaces.Discrete(5)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = int(self.np_random.integers(5))
        return self.x, {}

    def step(self, action):
        self.x = int(np.clip(self.x + np.trunc(2 * action[0]), 0, 4))
        return self.x, 1.0, False, False, {}


@pytest.mark.fault(255)
def test_observations_that_are_choices_are_refused():
    back = lambda cells: (1.0 * (cells == 0) - (cells == 4))[:, None]  # noqa: E731
    with pytest.raises(SettingError, match="nothing can be moved"):
        fdtasil.diagnose(back, back, Cells, horizon=10)


@pytest.mark.fault(256)
def test_rounding_beside_an_offset_is_no_deviation():
    """x' = 0.9 x + u / 10, seen as 400 + 0.3 x too, in steps of 0.00003."""

    class Offset(PowerLaw):
        def __init__(self):
            super().__init__(1.0)
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.seen(), {}

        def step(self, action):
            self.x = 0.9 * self.x + 0.1 * action
            return self.seen(), 1.0, False, False, {}

        def seen(self):
            return np.concatenate([400 + 0.3 * self.x, self.x]).astype(np.float32)

    expert = lambda rows: np.clip(-0.5 * np.asarray(rows, np.float32)[:, 1:], -1, 1)  # noqa: E731
    law = fdtasil.diagnose(expert, expert, Offset, episodes=3, horizon=60, steps=60).stability.law
    assert law.reach[0] >= 1e-3
    assert law.exponent == pytest.approx(1, abs=0.05)


def lqr(rows):
    """Balances the pendulum, by its place, angle and their speeds."""
    return np.asarray(rows) @ np.array([[0.25, 4.25, 0.39, 0.68]]).T


def test_the_linearised_loop_is_the_simulators_own():
    """A small deviation is followed in the environment itself, one step of it."""
    found = fdtasil.diagnose(
        lambda rows: 0.5 * lqr(rows), lqr, "InvertedPendulum-v5", episodes=2, horizon=20
    )
    env, columns = gymnasium.make("InvertedPendulum-v5").unwrapped, []
    env.reset(seed=0)
    for along in 1e-4 * np.eye(4):
        ends = []
        for sign in (1, -1):
            state = sign * along
            env.set_state(state[:2], state[2:])
            ends.append(env.step(lqr(env._get_obs()[None])[0])[0])
        columns.append((ends[0] - ends[1]) / 2e-4)
    expected = np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max()
    assert expected < 1
    assert found.linearisation.expert == pytest.approx([expected] * 6, rel=0.01)
    assert min(found.linearisation.student) > expected + 0.001
    assert "linearised loops" in str(found)


def test_a_policy_that_feels_contacts_has_a_linearised_loop_with_them():
    """Contact forces are observed on the moved state, as after a step, not as they last were."""

    def feels(rows):
        return 1e-3 * np.asarray(rows)[:, 27:].sum(axis=1, keepdims=True) * np.ones(8, np.float32)

    still = lambda rows: np.zeros((len(rows), 8), np.float32)  # noqa: E731
    unclipped = fdtasil.Environment("Ant-v5", kwargs={"contact_force_range": (-1e6, 1e6)})
    found = fdtasil.diagnose(feels, still, unclipped, episodes=2, horizon=40).linearisation
    assert np.max(np.abs(np.subtract(found.student, found.expert))) > 0.1


def test_what_is_no_such_simulator_has_no_linearised_loop():
    found = fdtasil.diagnose(rest, rest, lambda: PowerLaw(1.0), episodes=2, horizon=20)
    assert found.linearisation is None
    scaled = gymnasium.wrappers.TransformObservation(
        gymnasium.make("InvertedPendulum-v5"), lambda seen: 2 * seen, None
    )
    found = fdtasil.diagnose(lqr, lqr, scaled, episodes=2, horizon=20)
    assert found.linearisation is None
    timed = gymnasium.wrappers.TimeAwareObservation(gymnasium.make("InvertedPendulum-v5"))
    found = fdtasil.diagnose(early, early, timed, episodes=2, horizon=20)
    assert found.linearisation is None


def early(rows):
    return lqr(rows[:, :4])


@pytest.mark.fault(280)
def test_a_law_of_steps_is_said_to_be_one():
    """Near its states nothing changes: it would look smoother than any network."""
    stairs = lambda rows: np.round(4 * lqr(rows)) / 4  # noqa: E731
    found = fdtasil.diagnose(stairs, stairs, "InvertedPendulum-v5", episodes=2, horizon=30)
    assert found.regime == "steps"
    assert found.conditions == ()
    assert found.errors is None
    assert "the expert answers in steps" in str(found)
    smooth = fdtasil.diagnose(lqr, lqr, "InvertedPendulum-v5", episodes=2, horizon=30)
    assert smooth.regime == "smooth"
    constant = fdtasil.diagnose(rest, rest, "InvertedPendulum-v5", episodes=2, horizon=30)
    assert constant.regime is None
    assert "in steps" not in str(smooth) + str(constant)


@pytest.mark.fault(280)
def test_gains_of_steps_are_said_to_be_none(tmp_path, capsys):
    text = """<ir_version: 8, opset_import: ["" : 17]> law (float[N, 4] x) => (float[N, 1] y) {
        w = Constant <value = float[4, 1] {40.0, 680.0, 80.0, 120.0}> ()
        quarter = Constant <value = float[1] {0.01}> ()
        sums = MatMul (x, w)
        steps = Round (sums)
        y = Mul (steps, quarter)
    }"""
    onnx.save(onnx.parser.parse_model(text), tmp_path / "steps.onnx")
    gains_command(str(tmp_path / "steps.onnx"), "InvertedPendulum-v5", states=3, horizon=20)
    assert "these are no derivatives" in capsys.readouterr().out
