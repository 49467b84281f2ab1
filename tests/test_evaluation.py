"""What an evaluation says of a few numbers that are known."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY, mlp_onnx
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import FdtasilWarning
from fdtasil.results.pair import _interval

pytestmark = pytest.mark.usefixtures("no_pictures")


class Given(gymnasium.Env):
    """Each episode is a step, which gives what stands in a table: rows by starts, by action."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, theirs, ours):
        self.table, self.turn, self.seeds = np.stack([theirs, ours]), 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed not in self.seeds:
            self.seeds.append(seed)
        self.turn = self.seeds.index(seed) % self.table.shape[1]
        return np.float32([self.np_random.uniform(-1, 1)]), {}

    def step(self, action):
        gives = float(self.table[int(action[0] > 0), self.turn])
        return np.zeros(1, np.float32), gives, False, False, {}


def judged(theirs, ours):
    """Return the evaluation of a policy with these returns beside an expert with those."""
    environment = Given(theirs, ours)
    up, down = (lambda rows, a=a: np.full((len(rows), 1), a, np.float32) for a in (0.5, -0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return fdtasil.evaluate(up, down, environment, episodes=len(theirs), horizon=1)


@pytest.mark.fault(272)
def test_a_first_pair_of_zeros_does_not_hide_how_others_differ():
    theirs, ours = np.array([0.0, *[1] * 9]), np.array([0.0, 1, 0, 1, 1, 0, 1, 1, 0, 1])
    first, last = judged(theirs, ours), judged(theirs[::-1], ours[::-1])
    assert first.expert_returns == tuple(theirs)
    assert first.normalized_return == pytest.approx(6 / 9)
    for found in (first, last):
        low, high = found.ci95
        assert low < 0.5 < 0.8 < high
    same = judged(theirs, theirs)
    assert same.ci95 == (1.0, 1.0)
    twice = judged(theirs, 2 * theirs)
    assert twice.ci95 == (2.0, 2.0)


@pytest.mark.fault(273)
@pytest.mark.parametrize("ours", [[1, 0, 0], [1, 0, 1]])
def test_few_pairs_some_without_a_return_have_no_interval(ours):
    found = judged(np.array([1.0, 1.0, 0.0]), np.array(ours, float))
    assert found.normalized_return == pytest.approx(sum(ours) / 2)
    assert found.ci95 is None
    assert "95 % n/a: the expert is not surely better than a return of 0" in str(found)


def test_a_single_pair_has_no_interval():
    found = judged(np.array([2.0]), np.array([1.0]))
    assert (found.normalized_return, found.ci95) == (0.5, None)
    assert "95 % n/a: of a single pair" in str(found)
    assert "0.500 n/a: of a single pair" in found._repr_html_()


def test_what_went_wrong_is_said_of_whom():
    found = judged(np.array([2.0, 1.0]), np.array([1.0, 1.0]))
    found = replace(found, violations=(("fast", 0.25, 0.5),), given_up=1, expert_given_up=2)
    assert "fast              violated at 25.00% of the expert's steps, 50.00% of" in str(found)
    assert "         2   episodes, for the expert had" in str(found)
    assert "         1   episodes, for the student had" in str(found)
    html = found._repr_html_()
    assert "50.00% of the steps, the expert 25.00%" in html
    assert "1 episodes, for the student had" in html


def test_zero_is_random_actions_unless_most_of_the_experts_returns_are_positive():
    """Random actions earn what the expert and the policy do, half of the time each."""
    theirs, ours = np.array([0.0, 0.0, 0.0, 9.0]), np.full(4, -1.0)
    found = judged(theirs, ours)
    assert found.reference_return != 0
    assert -1 < found.reference_return < 2.25
    assert judged(np.array([0.0, 1.0, 1.0, 9.0]), ours).reference_return == 0
    with pytest.warns(FdtasilWarning, match="return 0 is not above 0, that of random actions"):
        nothing = judged(np.zeros(4), np.zeros(4))
    assert nothing.normalized_return is nothing.ci95 is None
    assert "n/a: the expert is no better than a return of 0" in str(nothing)
    assert "the simulator put itself back" in str(replace(nothing, physics_resets=3))


def test_the_interval_of_a_task_of_costs_is_that_of_the_gain_over_random_actions():
    """Which cost 2 about, where the expert's cost 1 and the policy's 3."""
    apart = 0.1 * np.cos(np.arange(20))
    found = judged(apart - 1, apart[::-1] - 3)
    low, high = found.ci95
    assert low < found.normalized_return < high < 0
    assert found.normalized_return == pytest.approx(
        (-3 - found.reference_return) / (-1 - found.reference_return), rel=0.1
    )


@pytest.mark.fault(273)
def test_the_lower_end_is_seldom_above_the_truth_near_the_reference():
    """The expert is 0.6 deviations above it: some draws have none left to be a share of."""
    random, above, known = np.random.default_rng(0), 0, 0
    for seed in range(200):
        theirs = random.normal(0.6, 1, 20)
        ours = 0.5 * theirs + random.normal(0, 0.3, 20)
        found = _interval(ours, theirs, seed) if theirs.mean() > 0 else None
        if found is not None:
            known += 1
            above += found[0] > 0.5
    assert known > 100
    assert above < 0.08 * known


def test_steps_after_the_end_count_for_nothing():
    class Short(Integrator):
        def reset(self, **named):
            self.left = 10
            return super().reset(**named)

        def step(self, action):
            self.left -= 1
            observation, reward, _, cut, about = super().step(action)
            return observation, reward, self.left == 0, cut, about

    expert, policy = (lambda rows, k=k: (-k * rows[:, :2]).astype(np.float32) for k in (0.5, 0.3))
    short, long = (
        fdtasil.evaluate(policy, expert, Short, episodes=4, horizon=horizon)
        for horizon in (10, 30)
    )
    numbers = ("student_returns", "expert_returns", "action_error", "imitation_gap", "roughness")
    for name in numbers:
        assert getattr(long, name) == pytest.approx(getattr(short, name)), name
    assert long.survival == 0
    assert long.imitation_gap > 0


@pytest.mark.fault(314)
def test_another_expert_than_the_runs_is_told_of(tmp_path):
    own, other = mlp_onnx(tmp_path / "own.onnx"), mlp_onnx(tmp_path / "other.onnx", scale=0.5)
    result = fdtasil.distill(own, TOY, 0, **QUICK)
    look = {"episodes": 2, "horizon": 10, "progress": False}
    for judge in (fdtasil.evaluate, fdtasil.diagnose):
        judge(result, own, TOY, **look)
        with pytest.warns(FdtasilWarning, match="own.onnx .* judged by other.onnx .*: another"):
            judge(result, other, TOY, **look)


@pytest.mark.fault(320)
@pytest.mark.filterwarnings("ignore::fdtasil.errors.FdtasilWarning")
def test_what_the_environment_clips_is_no_error():
    beyond = lambda rows: 30 * np.asarray(rows, np.float32) @ GAIN.T  # noqa: E731
    inside = lambda rows: np.clip(beyond(rows), -1, 1)  # noqa: E731
    found = fdtasil.evaluate(inside, beyond, TOY, episodes=2, horizon=20, force=True)
    assert found.action_error == 0
