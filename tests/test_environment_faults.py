"""Environments that are odd, break, hang or lie: named with episode and step, or lived with."""

import os
import re
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Text, Tuple
from nursery import Nursery
from toy_environments import Integrator

import fdtasil
from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import EnvironmentFault, FdtasilWarning, SettingError
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds

pytestmark = pytest.mark.usefixtures("no_pictures")


class Odd(Integrator):
    """The toy, with other spaces, and with what `reset` and `step` return changed on the way.

    Args:
        space: Instead of the observation's or the action's, by its name.
        reset: (observation, information) -> what is returned.
        step: (number of the step from 0, the usual five) -> what is returned.
    """

    def __init__(self, reset=None, step=None, **spaces):
        super().__init__()
        for name, space in spaces.items():
            setattr(self, f"{name}_space", space)
        self.change_reset, self.change_step = reset, step

    def reset(self, *, seed=None, options=None):
        self.count = -1
        answer = super().reset(seed=seed)
        return self.change_reset(*answer) if self.change_reset else answer

    def step(self, action):
        self.count += 1
        answer = super().step(np.clip(action, -1, 1))
        return self.change_step(self.count, *answer) if self.change_step else answer


def at(number, change):
    """Change what is returned at one step of each episode."""

    def step(count, *answer):
        return change(*answer) if count == number else answer

    return step


def refused(environment, linear, kind=EnvironmentFault, **changes):
    """The error of a distillation, whose form is checked."""
    with pytest.raises(kind) as error:
        fdtasil.distill(linear, environment, 3, **{**QUICK, **changes})
    text = str(error.value)
    assert len(text.splitlines()) <= 6
    assert "expected: " in text
    assert "next step: " in text
    return error.value


# --- spaces


NO_ACTIONS = [
    pytest.param(space, marks=mark)
    for mark, spaces in (
        (pytest.mark.fault(60), [Discrete(1), MultiDiscrete([2, 1])]),
        (pytest.mark.fault(61), [Box(-1, 1, (0,)), Box(-1, 1, (2, 0)), Text(3)]),
        (pytest.mark.fault(63), [Dict(x=Text(3)), Tuple((Box(-1, 1, (2,)), Text(3)))]),
    )
    for space in spaces
]


@pytest.mark.parametrize("role", ["action", "observation"])
@pytest.mark.parametrize("space", NO_ACTIONS)
def test_spaces_without_a_flat_form_are_named(role, space, linear):
    error = refused(lambda: Odd(**{role: space}), linear)
    assert f"{role}s " in error.found
    assert "Text" in error.found or f"{role}s {space}" in error.found
    assert error.expected.startswith("a Box, Discrete, MultiDiscrete or MultiBinary space")


@pytest.mark.fault(61)
def test_whole_numbers_as_actions_are_named(linear):
    error = refused(lambda: Odd(action=Box(-1, 1, (2,), np.int32)), linear)
    assert "int32" in error.found


@pytest.mark.fault(63)
def test_a_flattened_dictionary_is_a_vector(linear):
    """The next step that the error names."""

    def made():
        space = Dict(x=Box(-np.inf, np.inf, (5,), np.float64))
        nested = gymnasium.wrappers.TransformObservation(Integrator(), lambda x: {"x": x}, space)
        return gymnasium.wrappers.FlattenObservation(nested)

    assert fdtasil.distill(linear, made, 1, **QUICK).evaluation.episodes == 2


@pytest.mark.fault(64)
@pytest.mark.parametrize(
    "bounds", [(-np.inf, np.inf), ([-1, -np.inf], [np.inf, 1]), (-3.4e38, 3.4e38)]
)
def test_actions_without_bounds_are_neither_scaled_nor_clipped(bounds, linear):
    low, high = (np.broadcast_to(np.float32(bound), 2) for bound in bounds)
    result = fdtasil.distill(linear, lambda: Odd(action=Box(low, high)), 1, **QUICK)
    assert np.isfinite(result.evaluation.student_returns).all()
    assert result.report["clipped_actions"] == 0
    rows = 100 * result.demonstrations.observations
    assert np.abs(result.student.act(rows)).max() > 1


@pytest.mark.fault(65)
def test_an_action_with_equal_bounds_is_named(linear):
    low, high = np.float32([-1, 0]), np.float32([1, 0])
    error = refused(lambda: Odd(action=Box(low, high)), linear)
    assert error.found == "Odd: action 1 has the bounds 0 to 0"


@pytest.mark.fault(66)
def test_observations_in_float64_are_rounded_once(linear):
    """Expert, student and probes all see the float32 states that are stored."""
    seen = []

    def expert(rows):
        seen.append(rows.copy())
        return linear(rows)

    result = fdtasil.distill(expert, Odd, 2, **QUICK)
    assert {rows.dtype for rows in seen} == {np.dtype(np.float32)}
    states = result.demonstrations
    assert np.array_equal(states.actions, linear(states.observations))
    # float64 physics, whose steps would be rounded away if they were taken in float32
    assert Odd().reset(seed=0)[0].dtype == np.float64


# --- experts in environments


@pytest.mark.fault(62)
@pytest.mark.filterwarnings("default::fdtasil.errors.FdtasilWarning")
def test_the_experts_measured_return_is_reported_beside_that_of_chance():
    def wrong_way(rows):
        speed = rows[:, 2:]
        return 2 * np.sign(speed)

    with pytest.warns(FdtasilWarning, match=r"expert's return .* is not above .* random actions"):
        found = fdtasil.evaluate(wrong_way, wrong_way, "Pendulum-v1", episodes=3, horizon=100)
    assert found.normalized_return is None
    assert found.expert_return == np.mean(found.expert_returns) < found.reference_return
    assert f"{found.expert_return:10.1f}" in str(found)


# --- ends


@pytest.mark.fault(67)
@pytest.mark.parametrize("ends", [(True, False), (False, True)])
def test_episodes_that_end_at_once_are_refused_before_training(ends, linear, nothing_is_trained):
    def short():
        return Odd(step=lambda count, x, reward, *_: (x, reward, *ends, {}))

    error = refused(short, linear)
    assert error.found == "Odd: all 2 episodes of the expert ended at their first step"
    with pytest.raises(EnvironmentFault, match="ended at their first step"):
        fdtasil.evaluate(linear, linear, short, episodes=2, horizon=20)
    assert fdtasil.evaluate(linear, linear, short, episodes=2, horizon=1).horizon == 1
    # A single episode may fall by chance: the demonstrations show that none lasts.
    assert "all 2 episodes" in refused(short, linear, evaluation_episodes=1).found


@pytest.mark.fault(68)
def test_an_environment_without_an_end_needs_a_horizon(linear):
    endless = "toy_environments:toy/Endless-v0"
    error = refused(endless, linear, SettingError, horizon=None)
    assert error.found == "no horizon for toy/Endless-v0, whose episodes no TimeLimit ends"
    assert fdtasil.distill(linear, endless, 1, **QUICK).report["states"] == 40


@pytest.mark.fault(69)
def test_a_fall_is_told_from_an_end_by_time(linear):
    def falls(count, x, reward, *_):
        return x, reward, count == 9, count == 14, {}

    def times_out(count, x, reward, *_):
        return x, reward, False, count == 9, {}

    ends = {}
    for how in (falls, times_out):
        run = fdtasil.distill(linear, lambda how=how: Odd(step=how), 1, **QUICK)
        states = Dataset.from_bytes(run.dataset.to_bytes()).demonstrations
        assert len(states) == 20
        ends[how] = np.flatnonzero(states.terminated).tolist()
        assert run.report["terminated_episodes"] == len(ends[how])
        assert run.evaluation.expert_survival == (how is times_out)
    assert ends == {falls: [9, 19], times_out: []}


@pytest.mark.fault(70)
def test_no_transition_is_bogus_in_an_environment_that_resets_itself():
    def by_itself():
        return gymnasium.wrappers.Autoreset(Integrator(0.9))

    with EnvironmentPool(by_itself) as pool, EnvironmentPool(lambda: Integrator(0.9)) as plain:
        idle = follow(lambda rows: np.zeros((len(rows), 2), np.float32))
        found, expected = (rollout(idle, one, range(8), 30) for one in (pool, plain))
    assert 0 < expected.terminated.sum() < 8
    assert np.array_equal(found.observations, expected.observations)
    assert np.array_equal(found.lengths, expected.lengths)
    assert found.valid.sum() == found.lengths.sum() < 8 * 30


@pytest.mark.fault(78)
def test_nothing_steps_before_a_reset_or_after_an_end(linear):
    class Strict(Integrator):
        running = False

        def reset(self, **named):
            self.running = True
            return super().reset(**named)

        def step(self, action):
            assert self.running
            answer = super().step(action)
            self.running = not answer[2]
            return answer

    strict = Strict(0.9)
    for environment in (lambda: Strict(0.9), strict, lambda: strict):
        result = fdtasil.distill(linear, environment, 1, **{**QUICK, "horizon": 40})
        assert result.evaluation.episodes == 2


# --- steps that go wrong


def _raise(*answer):
    raise ValueError("boom\n" + "a long story\n" * 30)


def _nan(x, *rest):
    return np.where(np.arange(5) == 2, np.nan, x), *rest


def broken(number_mark, name, change, found):
    return pytest.param(change, found, marks=number_mark, id=name)


RAISES, NAN, REWARD, SHAPE = (
    pytest.mark.fault(71),
    pytest.mark.fault(74),
    pytest.mark.fault(75),
    pytest.mark.fault(77),
)
BROKEN = [
    broken(RAISES, "raises", _raise, r"step\(\) raised ValueError: boom$"),
    broken(NAN, "one NaN", _nan, "^1 of the observation's 5 values .* value 2: nan$"),
    broken(NAN, "all infinite", lambda x, *rest: (x / 0, *rest), "^5 of the observation"),
    broken(NAN, "too large", lambda x, *rest: (x * 1e300, *rest), "not finite in float32"),
    broken(REWARD, "NaN", lambda x, _, *rest: (x, np.nan, *rest), "^the reward is nan$"),
    broken(REWARD, "-inf", lambda x, _, *rest: (x, -np.inf, *rest), "^the reward is -inf$"),
    broken(SHAPE, "no reward", lambda x, _, *rest: (x, None, *rest), "returned reward=None"),
    broken(SHAPE, "two rewards", lambda x, _, *rest: (x, np.ones(2), *rest), r"reward=array\(\["),
    broken(SHAPE, "two ends", lambda x, r, *_: (x, r, np.ones(2), 0, {}), r"terminated=array\(\["),
    broken(SHAPE, "old interface", lambda x, r, end, *_: (x, r, end, {}), "returned 4 things$"),
    broken(SHAPE, "nothing", lambda *answer: None, "returned a NoneType$"),
    broken(SHAPE, "shorter", lambda x, *rest: (x[:4], *rest), r"observation has shape \(4,\)$"),
    broken(SHAPE, "column", lambda x, *rest: (x[:, None], *rest), r"has shape \(5, 1\)$"),
    broken(SHAPE, "dictionary", lambda x, *rest: ({"x": x}, *rest), "is a dict of object"),
    broken(SHAPE, "text", lambda x, *rest: (list("abcde"), *rest), "is a list of <U1"),
    broken(SHAPE, "complex", lambda x, *rest: (x + 0j, *rest), "is a ndarray of complex"),
    broken(SHAPE, "objects", lambda x, *rest: (x.astype(object), *rest), "a ndarray of object"),
]


@pytest.mark.parametrize(("change", "found"), BROKEN)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:overflow", "ignore:invalid value")
@pytest.mark.usefixtures("nothing_is_trained")
def test_a_step_that_goes_wrong_is_named_with_episode_and_step(change, found, linear):
    error = refused(lambda: Odd(step=at(7, change)), linear)
    where, _, what = error.found.partition(": ")
    (seed,) = episode_seeds(0, "evaluation", 0, 1)
    assert where == f"Odd, episode 0 (seed {seed}), step 7"
    assert re.search(found, what), what
    if change is _raise:
        lines = traceback.extract_tb(error.__cause__.__traceback__)
        assert lines[-1].name == "_raise"  # down to the line that raised


@pytest.mark.parametrize(
    ("change", "found"),
    [
        pytest.param(_raise, r"reset\(\) raised ValueError: boom", marks=pytest.mark.fault(71)),
        pytest.param(_nan, "not finite", marks=pytest.mark.fault(74)),
        pytest.param(lambda x, _: x, r"reset\(\) returned a ndarray", marks=pytest.mark.fault(77)),
    ],
)
def test_a_reset_that_goes_wrong_is_named_with_its_seed(change, found, linear):
    error = refused(lambda: Odd(reset=change), linear)
    (seed,) = episode_seeds(0, "evaluation", 0, 1)
    assert error.found.startswith(f"Odd, episode 0 (seed {seed}): ")
    assert re.search(found, error.found)


@pytest.mark.fault(75)
def test_a_rare_nan_reward_never_gets_into_a_mean(linear):
    """In the last step of one episode of many, of the student only."""
    last = []

    def rare(count, x, reward, *rest):
        last.extend([count] * (count == 19))
        return x, np.nan if len(last) == 30 + 17 else reward, *rest

    with pytest.raises(EnvironmentFault, match=r"Odd, episode 16 .*, step 19: the reward is nan"):
        fdtasil.evaluate(linear, linear, Odd(step=rare), episodes=30, horizon=20)


def test_a_policy_that_is_not_finite_is_named(linear):
    with EnvironmentPool(TOY) as pool, pytest.raises(EnvironmentFault, match=r"episode 0 .*, step 0: the policy's action"):  # fmt: skip  # noqa: E501
        rollout(follow(lambda rows: linear(rows) * np.nan), pool, [3], 5)


@pytest.mark.fault(71)
@pytest.mark.parametrize("at_step", [80, 120])
def test_a_run_goes_on_with_a_mended_environment(at_step, linear, tmp_path):
    """It broke in the second round, or when the student was evaluated."""
    run = {**QUICK, "trainer": "dagger", "episodes": 3}
    golden = fdtasil.distill(linear, Odd, 2, **run)
    steps = []

    def later(count, *answer):
        steps.append(count)
        return _raise() if len(steps) == at_step else answer

    with pytest.raises(EnvironmentFault, match="boom"):
        fdtasil.distill(linear, lambda: Odd(step=later), 2, out=tmp_path, **run)
    assert list(tmp_path.glob("checkpoints/*/trained-0/manifest.json"))
    result = fdtasil.distill(linear, Odd, 2, resume=tmp_path, **run)
    assert result.student.to_bytes() == golden.student.to_bytes()
    assert result.queries == golden.queries


# --- physics


class Bomb(gymnasium.Wrapper):
    """Puts a velocity that no simulation survives into MuJoCo's state at some steps."""

    def __init__(self, environment, when):
        super().__init__(environment)
        self.when = when

    def reset(self, **named):
        self.count = -1
        return self.env.reset(**named)

    def step(self, action):
        self.count += 1
        if self.when(self.count, action):
            self.unwrapped.data.qvel[:] = 1e11
        return self.env.step(action)


def cheetah(when):
    return lambda: Bomb(gymnasium.make("HalfCheetah-v5"), when)


def run_forward(rows):
    return np.abs(np.tanh(rows[:, :6])) / 2


@pytest.mark.fault(76)
@pytest.mark.parametrize("step", [0, 1, 2, 7])
def test_physics_that_always_reset_are_refused_before_training(step, nothing_is_trained):
    """At the first steps the simulator's clock has no room to go back."""
    found = "HalfCheetah-v5: the simulation became unstable and reset itself in 2 of 2 episodes"
    with pytest.warns(FdtasilWarning, match=found):
        error = refused(cheetah(lambda count, _: count == step), run_forward)
    assert error.found.startswith(found)


@pytest.mark.fault(76)
def test_a_time_step_that_is_too_long_is_refused():
    """No bomb: MuJoCo itself can't keep a cheetah together in steps of a fifth of a second."""

    def coarse():
        environment = gymnasium.make("HalfCheetah-v5")
        environment.unwrapped.model.opt.timestep = 0.2
        return environment

    def shake(rows):
        return np.sign(np.sin(100 * rows[:, :6])) + 0.0

    with pytest.warns(FdtasilWarning, match="reset itself"):
        refused(coarse, shake, horizon=50)


@pytest.mark.fault(76)
@pytest.mark.filterwarnings("default::fdtasil.errors.FdtasilWarning")
def test_physics_that_reset_themselves_are_counted_and_warned_of():
    bombs = iter(range(10_000))

    def sometimes(count, _):
        return count == 7 and next(bombs) % 4 == 2

    run = {**QUICK, "episodes": 5, "evaluation_episodes": 5}
    with pytest.warns(FdtasilWarning, match="reset itself in 1 of 5 episodes"):
        result = fdtasil.distill(run_forward, cheetah(sometimes), 1, **run)
    report = result.report
    assert report["physics_resets"] == 1
    assert report["evaluation"]["expert_physics_resets"] == 1
    assert report["evaluation"]["physics_resets"] == 2
    # Of the expert, the demonstrations, the student, and random actions as the reference.
    assert sum("reset itself" in note for note in report["warnings"]) == 4


@pytest.mark.fault(76)
def test_a_student_that_breaks_the_physics_has_no_normalised_return():
    def backwards(rows):
        return np.full((len(rows), 6), -0.25)

    environment = cheetah(lambda count, action: (action == -0.25).all())
    with pytest.warns(FdtasilWarning, match="reset itself in 4 of 4 episodes"):
        found = fdtasil.evaluate(backwards, run_forward, environment, episodes=4, horizon=20)
    assert found.physics_resets == 4
    assert found.expert_physics_resets == 0
    assert found.normalized_return is None
    assert found.ci95 is None

    def half(rows):
        return backwards(rows) * (np.arange(len(rows)) % 2)[:, None]

    with pytest.warns(FdtasilWarning, match="reset itself in 2 of 4 episodes"):
        found = fdtasil.evaluate(half, run_forward, environment, episodes=4, horizon=20)
    assert found.physics_resets == 2
    assert found.normalized_return is not None


@pytest.mark.fault(81)
@pytest.mark.filterwarnings("ignore::fdtasil.errors.FdtasilWarning")
def test_the_simulator_leaves_no_log_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    environment = cheetah(lambda count, action: count == 3)
    with pytest.raises(EnvironmentFault, match="reset itself"):
        fdtasil.evaluate(run_forward, run_forward, environment, episodes=2, horizon=20)
    assert list(tmp_path.iterdir()) == []
    with EnvironmentPool("HalfCheetah-v5"):  # whose model file MuJoCo calls deprecated
        assert list(tmp_path.iterdir()) == []


# --- environments that take the process with them


CODE = """
import ctypes, time
from conftest import GAIN
from test_environment_faults import RUN, Odd

def linear(rows):
    return rows @ GAIN.T

def run(folder, how):
    steps = []

    def fate(count, *answer):
        steps.append(count)
        if len(steps) == 100:  # of the second of three rounds
            print("there", 0, flush=True)
            if how == "exit":
                os._exit(3)
            if how == "segfault":
                ctypes.string_at(0)
            if how == "hang":
                time.sleep(3600)
        return answer

    try:
        fdtasil.distill(linear, lambda: Odd(step=fate), 2, out=folder, **RUN)
    except KeyboardInterrupt:
        return 130
    return 0
"""
RUN = {**QUICK, "trainer": "dagger", "episodes": 6}


def start(*arguments):
    here, before = str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([here, before])},
        # A shell's background jobs ignore Ctrl-C, and their children with them.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.fixture(scope="module")
def nursery(tmp_path_factory):
    made = Nursery(CODE, tmp_path_factory.mktemp("nursery") / "errors")
    yield made
    made.close()


def goes_on(folder):
    """Resume with an environment that is mended; as a run that was never ended."""

    def linear(rows):
        return rows @ GAIN.T

    golden = fdtasil.distill(linear, Odd, 2, **RUN)
    result = fdtasil.distill(linear, Odd, 2, resume=folder, **RUN)
    assert result.student.to_bytes() == golden.student.to_bytes()
    assert result.dataset.to_bytes() == golden.dataset.to_bytes()
    assert not list(folder.rglob("*.tmp"))


@pytest.mark.slow
@pytest.mark.fault(72)
@pytest.mark.parametrize(("how", "code"), [("exit", 3), ("segfault", -signal.SIGSEGV)])
def test_a_process_that_an_environment_ends_leaves_whole_checkpoints(how, code, nursery, tmp_path):
    nursery.start(folder=tmp_path, how=how)
    assert nursery.end() == code, nursery.errors.read_text()
    goes_on(tmp_path)


@pytest.mark.fault(73)
def test_an_environment_that_hangs_is_ended_by_ctrl_c_and_the_run_goes_on(nursery, tmp_path):
    run = nursery.start(folder=tmp_path, how="hang")
    nursery.told("there")
    os.killpg(run, signal.SIGINT)
    assert nursery.ends_within(5)
    assert nursery.end() == 130
    with pytest.raises(ProcessLookupError):
        os.killpg(run, 0)
    goes_on(tmp_path)


@pytest.mark.slow
@pytest.mark.fault(80)
def test_ctrl_c_in_a_rollout_is_one_line_and_130(tmp_path):
    """From the command line, in the expert's first rollouts."""
    from conftest import mlp_onnx

    expert = mlp_onnx(tmp_path / "e.onnx")
    run = tmp_path / "run"
    long = ("--evaluation-episodes", 100_000)
    process = start("-m", "fdtasil", "distill", expert, TOY, *long, "--out", run)
    end = time.monotonic() + 60
    while not (run / "command.json").exists() and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(2)  # past the gate's first questions
    began = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    shown, error = process.communicate(timeout=20)
    assert time.monotonic() - began < 5
    assert process.returncode == 130
    assert shown == ""
    assert error.startswith("fdtasil: ")
    assert "Traceback" not in error
    assert len(error.splitlines()) <= 3
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


# --- seeds


@pytest.mark.fault(82)
@pytest.mark.parametrize("seed", [-1, 2**32, 1.0, np.float64(2), np.nan, True, None, "0"])
def test_a_wrong_seed_is_refused_at_once(seed, linear):
    for call in (
        lambda: fdtasil.distill(linear, TOY, 1, **QUICK, seed=seed),
        lambda: fdtasil.evaluate(linear, linear, TOY, episodes=2, seed=seed),
    ):
        with pytest.raises(SettingError, match=r"seed=.*\n.*an integer from 0 to 4294967295"):
            call()


@pytest.mark.fault(82)
@pytest.mark.parametrize("kind", [np.int64, np.uint32, np.int8])
def test_environments_are_seeded_by_plain_integers(kind, linear):
    """gymnasium refuses numpy's."""
    seeds = []

    class Told(Odd):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return super().reset(seed=seed)

    found = fdtasil.evaluate(linear, linear, Told, episodes=3, horizon=5, seed=kind(3))
    assert {type(seed) for seed in seeds} == {int}
    assert min(seeds) >= 0
    assert found == fdtasil.evaluate(linear, linear, Told, episodes=3, horizon=5, seed=3)


@pytest.mark.fault(83)
def test_the_seeds_of_runs_streams_and_episodes_do_not_overlap(linear):
    streams = ("evaluation", "rollout", "extra 1", "extra 2")
    drawn = [s for run in range(50) for name in streams for s in episode_seeds(run, name, 0, 20)]
    # 4,000 of 2**31: by chance two of them are equal once in 270 such draws.
    assert len(set(drawn)) == 4000
    first, second = (
        fdtasil.distill(linear, TOY, 1, **QUICK, seed=seed).demonstrations.observations
        for seed in (0, 1)
    )
    assert not {row.tobytes() for row in first} & {row.tobytes() for row in second}


def test_every_time_limit_counts_and_none_is_passed_over(linear):
    """Of a wrapper around an environment that was never registered, too."""

    def short():
        return gymnasium.wrappers.TimeLimit(Integrator(), 7)

    result = fdtasil.distill(linear, short, 0, **{**QUICK, "horizon": None})
    assert len(result.demonstrations) == 7 * QUICK["episodes"]
    with pytest.warns(FdtasilWarning, match="ends its episodes at 7 steps"):
        result = fdtasil.distill(linear, short, 0, **{**QUICK, "horizon": 9})
    assert result.evaluation.horizon == 7


def test_starts_that_differ_with_one_seed_are_warned_of():
    random = np.random.default_rng(0)

    class Unseeded(Integrator):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=int(random.integers(2**31)))

    with pytest.warns(FdtasilWarning, match="same first observation twice with one seed"):
        fdtasil.distill(lambda x: 0.1 * np.tanh(x[:, :2]), Unseeded, 0, **QUICK)


def test_a_module_that_registers_nothing_is_told_how():
    with pytest.raises(EnvironmentFault, match=r"must call gymnasium\.register"):
        fdtasil.distill(run_forward, "toy_environments:Cart-v0", **QUICK)


def test_an_unknown_id_is_not_blamed_on_its_kwargs():
    wanted = fdtasil.Environment("Pendulam-v1", kwargs={"g": 1.6})
    with pytest.raises(EnvironmentFault, match="ids of other packages") as caught:
        fdtasil.distill(run_forward, wanted, **QUICK)
    assert "kwargs" not in str(caught.value)
