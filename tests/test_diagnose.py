"""Diagnostics on systems whose answers are known."""

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, TOY, mlp_onnx
from scipy.stats import spearmanr
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import SettingError
from fdtasil.experts.load import load_expert
from fdtasil.probes.scales import measure_scales
from fdtasil.results.fidelity import fidelity_of
from fdtasil.results.stability import stability_of
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout

STIFFNESS = 0.2


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


def measured(nu, sizes, horizon, system=PowerLaw):
    """In units of the state itself."""
    with EnvironmentPool(lambda: system(nu)) as pool:
        expert = load_expert(rest, 1, 1)
        own = rollout(follow(expert.policy("act")), pool, range(6), horizon)
        scales = measure_scales(np.array([[-1.0], [1.0]]))
        noise = [np.random.default_rng(k) for k in range(6)]
        return stability_of(expert, own, pool, horizon, np.ones(1), scales, noise, sizes)


def test_a_loop_that_forgives_in_proportion():
    """Linear: gamma(e) = e / 0.2 exactly, whatever the path."""
    found = measured(1.0, (1e-3, 3e-3, 1e-2), 100)
    assert found.exponent == pytest.approx(1.0, rel=0.01)
    assert found.constant == pytest.approx(1 / STIFFNESS, rel=0.01)
    assert found.order == 0
    assert found.gamma(0.01) == pytest.approx(0.05, rel=0.02)
    assert found.rate == pytest.approx(1 - STIFFNESS, rel=1e-3)
    assert found.reach == (1e-3, 1e-2)


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

    assert measured(1.0, (1e-3, 3e-3, 1e-2), 40, Ending).rate == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(("nu", "order"), [(0.5, 1), (1 / 3, 2)])
def test_one_that_forgives_less_asks_for_a_higher_order(nu, order):
    """Two paths rest (e / 0.2) ** nu apart, and pass at 2 ** (1 - nu) times that at most.

    That is where a path that comes to rest from one side meets one that is pushed to the other.
    """
    found = measured(nu, (1e-4, 3e-4, 1e-3), 4000)
    assert found.exponent == pytest.approx(nu, rel=0.1)
    assert STIFFNESS**-nu < found.constant < 2 ** (1 - nu) * STIFFNESS**-nu
    assert found.order == order


def linear(gain):
    return lambda rows: np.asarray(rows, np.float32) @ gain.T


def test_fidelity_of_known_laws():
    """Linear laws: the error of a difference is that of the gain, at every radius."""
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    expert, scales = load_expert(linear(GAIN), 5, 2), measure_scales(states)
    random = np.random.default_rng(0)
    for factor in (1.0, 0.9, 0.0, 2.0):
        found = fidelity_of(linear(factor * GAIN), expert, states, scales, random)
        assert found.errors == pytest.approx([abs(factor - 1)] * 4, abs=1e-3)
        assert found.action_error == pytest.approx(abs(factor - 1), rel=0.1, abs=1e-3)
    assert max(found.floors) < 0.01
    noisy = lambda rows: linear(GAIN)(rows) + 0.01 * np.sin(1e5 * rows[:, :2])  # noqa: E731
    floor = fidelity_of(linear(GAIN), load_expert(noisy, 5, 2), states, scales, random).floors
    assert floor[0] > 10 * max(found.floors)


def test_the_bound_holds_where_the_law_does():
    student = lambda rows: linear(0.97 * GAIN)(rows)  # noqa: E731
    found = fdtasil.diagnose(student, linear(GAIN), TOY, episodes=4, horizon=30, progress=False)
    assert found.gap > 0
    assert found.bound is not None
    assert found.gap <= 1.5 * found.bound
    assert "theorem 3.2" in str(found)
    same = fdtasil.diagnose(
        linear(GAIN), linear(GAIN), TOY, episodes=2, horizon=30, progress=False
    )
    assert same.gap == same.largest_error == same.fidelity.error == 0


def never(rows):
    raise AssertionError("asked")


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
    run = {"episodes": 2, "horizon": 20, "evaluation_episodes": 0, "fit": fdtasil.Fit(steps=5)}
    remembers = fdtasil.distill(linear(GAIN), TOY, 0, history=2, **run)
    with pytest.raises(SettingError, match="sees 2 observations"):
        fdtasil.diagnose(remembers, linear(GAIN), TOY, horizon=20)


def test_the_command(tmp_path, inside):
    expert = mlp_onnx(tmp_path / "e.onnx")
    done = inside(
        "diagnose", expert, TOY, "--expert", expert, "--episodes", "2", "--horizon", "20"
    )
    assert done.returncode == 0, done.stderr
    assert "closed loop" in done.stdout


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


def test_what_is_no_such_simulator_has_no_linearised_loop():
    found = fdtasil.diagnose(rest, rest, lambda: PowerLaw(1.0), episodes=2, horizon=20)
    assert found.linearisation is None
    scaled = gymnasium.wrappers.TransformObservation(
        gymnasium.make("InvertedPendulum-v5"), lambda seen: 2 * seen, None
    )
    found = fdtasil.diagnose(lqr, lqr, scaled, episodes=2, horizon=20)
    assert found.linearisation is None
