"""A student that sees the last observations and actions."""

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from test_memory import Remembers
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import SettingError
from fdtasil.results.card import card_of
from fdtasil.rollouts.spaces import Spaces, flat_layout

pytestmark = pytest.mark.usefixtures("no_pictures")

N, M, H = 5, 2, 3
PAST = (H - 1) * (N + M)
RUN = {**QUICK, "history": H, "progress": False}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


def linear_here(rows):
    assert rows.shape[1] == N
    return rows @ GAIN.T


def test_the_past_stands_behind_each_observation():
    states = fdtasil.distill(linear_here, TOY, 3, **RUN).dataset.demonstrations
    assert states.observations.shape[1] == N + PAST
    for number in range(2):
        rows = states.observations[states.episode == number]
        taken = states.taken[states.episode == number]
        before = np.concatenate([rows[0, :N], np.zeros(M)])
        assert np.array_equal(rows[0, N:], np.tile(before, H - 1))
        for t in range(2, len(rows)):
            one = np.concatenate([rows[t - 1, :N], taken[t - 1]])
            two = np.concatenate([rows[t - 2, :N], taken[t - 2]])
            assert rows[t, N:] == pytest.approx(np.concatenate([one, two]), abs=1e-5)
    assert states.actions == pytest.approx(states.observations[:, :N] @ GAIN.T, abs=1e-5)


@pytest.mark.parametrize("probes", [3, "fresh:3", "jacobian", "basis,central"])
def test_probes_move_the_present_alone(probes, file):
    result = fdtasil.distill(file, TOY, probes, **RUN)
    moved = result.dataset.answers.displacements
    assert (moved[:, N:] == 0).all()
    assert (moved[:, :4] != 0).any(axis=0).all()


def test_where_it_runs_it_keeps_its_own_past(file, tmp_path):
    result = fdtasil.distill(file, TOY, 3, **RUN)
    policy = fdtasil.History(result.student, H)
    assert policy.observation_size == N
    environment = gymnasium.make(TOY)
    rewards = 0.0
    for seed in fdtasil.seeding.episode_seeds(0, "evaluation", 0, 2):
        observation, _ = environment.reset(seed=seed)
        began = observation
        for step in range(20):
            action, _ = policy.predict(observation, episode_start=step == 0)
            observation, reward, terminated, *_ = environment.step(action)
            rewards += reward
            if terminated:
                break
        carried = policy.predict(began)[0]
        policy.reset()
        anew = policy.predict(began)[0]
        assert np.array_equal(anew, policy.predict(began, episode_start=True)[0])
        assert not np.array_equal(anew, carried)
    assert rewards / 2 == pytest.approx(result.evaluation.student_return, rel=1e-3)
    path = result.to_onnx(tmp_path / "s.onnx")
    again = fdtasil.evaluate(path, file, TOY, episodes=2, horizon=20, history=H, progress=False)
    alone = fdtasil.evaluate(path, file, TOY, episodes=2, horizon=20, progress=False)
    assert alone == again  # the file says itself how much it sees
    judged = fdtasil.evaluate(result, file, TOY, episodes=2, horizon=20, progress=False)
    assert judged.student_return == pytest.approx(again.student_return, rel=1e-3)
    assert again.student_return == pytest.approx(result.evaluation.student_return, rel=1e-3)


@pytest.mark.parametrize("done", ["box", "choices"])
def test_stable_baselines3_evaluates_it_in_one_environment(done):
    made = lambda: gymnasium.wrappers.TimeLimit(InForm("box", done), 20)  # noqa: E731
    result = fdtasil.distill(in_form(linear_here, "box", done), made, 0, **RUN)
    policy, alone, returns = fdtasil.History(result.student, H), made(), []
    one, two = (DummyVecEnv([made] * count) for count in (1, 2))
    one.seed(3)
    for episode in range(2):
        observation, _ = alone.reset(seed=None if episode else 3)
        begun, over, total = True, False, 0.0
        while not over:
            action, _ = policy.predict(observation, episode_start=begun)
            observation, reward, ended, late, _ = alone.step(action)
            begun, over, total = False, ended or late, total + reward
        returns.append(total)
    mean, _ = evaluate_policy(policy, one, n_eval_episodes=2, warn=False)
    assert mean == pytest.approx(np.mean(returns), rel=1e-5)
    action, _ = policy.predict(np.zeros((1, N)), episode_start=np.array([True]))
    assert action.shape == (1, M)
    with pytest.raises(SettingError, match="n_envs=1"):
        evaluate_policy(policy, two, n_eval_episodes=2, warn=False)


def test_beside_a_memory_it_is_seen_and_the_memory_is_not(tmp_path):
    result = fdtasil.distill(Remembers(), TOY, 3, **RUN)
    states = result.dataset.demonstrations.observations
    assert states.shape[1] == N + PAST + 6
    assert result.student.observation_size == N + PAST
    assert (result.dataset.answers.displacements[:, N:] == 0).all()
    path = result.to_onnx(tmp_path / "s.onnx")
    again = fdtasil.evaluate(
        path, Remembers(), TOY, episodes=2, horizon=20, history=H, progress=False
    )
    assert again.student_return == pytest.approx(result.evaluation.student_return, rel=1e-3)
    judged = fdtasil.evaluate(result, Remembers(), TOY, episodes=2, horizon=20, progress=False)
    assert judged.student_return == pytest.approx(again.student_return, rel=1e-3)


class Cart(gymnasium.Env):
    """A cart that is to stand at 0, pushed by a force; nobody sees its speed."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-3, 3, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-1, 1, 2)
        return np.array([self.place]), {}

    def step(self, action):
        self.speed += 0.1 * float(action[0])
        self.place += 0.1 * self.speed
        reward = 1 / (1 + 10 * self.place**2 + self.speed**2)
        return np.array([self.place]), reward, False, False, {}


class Differences:
    """A controller that remembers the last place, for the speed."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        begun = state is None
        before, known = (observation, np.zeros_like(observation)) if begun else state
        speed = known * (observation - before) / 0.1
        return np.clip(-2 * observation - 2 * speed, -3, 3), (observation, np.ones_like(known))


@pytest.mark.torture
def test_a_hidden_speed_is_learnt_from_the_past():
    run = {"episodes": 3, "horizon": 60, "fit": fdtasil.Fit(steps=2000), "progress": False}
    run |= {"student": fdtasil.Mlp(64), "evaluation_episodes": 10}
    blind = fdtasil.distill(Differences(), Cart, 5, **run)
    sees = fdtasil.distill(Differences(), Cart, 5, history=2, **run)
    assert sees.evaluation.normalized_return > 0.95
    assert blind.evaluation.normalized_return < 0.7


@pytest.mark.parametrize("history", [0, -1, 1.5, "2", True], ids=str)
def test_a_wrong_history_is_named(history):
    with pytest.raises(SettingError, match="history"):
        fdtasil.distill(linear_here, TOY, 3, **{**RUN, "history": history})


def test_what_a_history_does_not_go_with_is_refused(file):
    with pytest.raises(SettingError, match="with student_obs"):
        fdtasil.distill(file, TOY, 3, student_obs=[0], **RUN)
    result = fdtasil.distill(file, TOY, 0, **RUN)
    with pytest.raises(SettingError, match="of a student that sees 19 numbers"):
        fdtasil.History(result.student, 2)


def test_workers_are_given_the_present_alone():
    slow = fdtasil.load_expert(linear_here, N, M, workers=2, threads=True)
    result = fdtasil.distill(slow, TOY, 3, **RUN)
    expected = fdtasil.distill(linear_here, TOY, 3, **RUN)
    assert np.allclose(result.dataset.answers.values, expected.dataset.answers.values, atol=1e-6)


def test_constraints_are_of_the_environments_own_observations(file):
    seen = []

    def limit(states, actions):
        seen.append(states.shape[1])
        return states[:, -1]

    fdtasil.distill(file, TOY, 0, **RUN, constraints={"limit": limit})
    assert set(seen) == {N}


@pytest.mark.parametrize("history", [1, H])
def test_what_was_recorded_with_a_memory_is_learnt_again_without_asking(history, tmp_path):
    run = {**RUN, "history": history}
    first = fdtasil.distill(Remembers(), TOY, 3, **run, out=tmp_path / "run")
    alone = fdtasil.distill(None, None, dataset=tmp_path / "run", progress=False, fit=RUN["fit"])
    assert sum(alone.queries.values()) == 0
    assert alone.student.observation_size == first.student.observation_size
    states = first.demonstrations.observations[:5]
    assert (alone.student.act(alone.view.look(states)) != 0).all()
    again = fdtasil.distill(Remembers(), TOY, dataset=first.dataset, **{**run, "history": None})
    assert again.student.to_bytes() == first.student.to_bytes()
    assert again.evaluation == first.evaluation
    assert again.queries["act"] == 0
    stored = fdtasil.Dataset.from_bytes(first.dataset.to_bytes())
    assert (stored.history, stored.remembered, stored.own_size) == (history, 6, N)


AGAIN = {"progress": False, "fit": QUICK["fit"], "student": QUICK["student"]}


@pytest.mark.slow
@pytest.mark.fault(291)
@pytest.mark.parametrize("before", [1, 2, 5])
@pytest.mark.parametrize("expert", [linear_here, Remembers()], ids=["plain", "remembers"])
def test_a_recording_is_given_another_history(expert, before):
    there = fdtasil.distill(expert, TOY, 3, **{**RUN, "history": before}).dataset
    wanted = fdtasil.distill(expert, TOY, 3, **RUN)
    again = fdtasil.distill(None, None, dataset=there, history=H, **AGAIN)
    assert np.array_equal(again.demonstrations.observations, wanted.demonstrations.observations)
    assert np.array_equal(again.answers.displacements, wanted.answers.displacements)
    assert again.student.to_bytes() == wanted.student.to_bytes()
    assert (again.dataset.history, again.steps_seen) == (H, H)


def test_the_past_of_a_recording_is_left_out_where_that_is_asked(file):
    there = fdtasil.distill(file, TOY, 3, **RUN).dataset
    wanted = fdtasil.distill(file, TOY, 3, **{**RUN, "history": 1})
    again = fdtasil.distill(file, TOY, dataset=there, **{**RUN, "history": 1})
    assert again.student.to_bytes() == wanted.student.to_bytes()
    assert "history=1" in card_of(again)
    assert "history=" not in card_of(wanted)


@pytest.mark.parametrize("probes", [3, "fresh:3", "jacobian"])
def test_a_log_is_given_a_history_and_probed(probes, file):
    recorded = fdtasil.distill(file, TOY, 0, **{**RUN, "history": 1}).demonstrations
    ends = np.append(recorded.episode[1:] != recorded.episode[:-1], True)
    log = fdtasil.from_arrays(recorded.observations, recorded.actions, episode_ends=ends)
    wanted = fdtasil.distill(file, TOY, 0, **RUN).demonstrations.observations
    found = fdtasil.distill(file, None, probes, dataset=log, history=H, **AGAIN)
    # A log that knows no bounds has no actions to clip.
    assert np.array_equal(found.demonstrations.observations[:, :N], wanted[:, :N])
    assert (found.answers.displacements[:, N:] == 0).all()
    assert found.student.observation_size == N + PAST
    there = fdtasil.distill(file, TOY, probes, dataset=log, history=H, horizon=20, **AGAIN)
    assert np.array_equal(there.demonstrations.observations, wanted)
    assert there.evaluation is not None


def test_a_history_of_recorded_choices_is_what_was_chosen():
    made = lambda: gymnasium.wrappers.TimeLimit(InForm("box", "choices"), 20)  # noqa: E731
    expert, alone = in_form(linear_here, "box", "choices"), {**RUN, "history": 1}
    there = fdtasil.distill(expert, made, 0, **alone).dataset
    wanted = fdtasil.distill(expert, made, 0, **RUN).demonstrations.observations
    again = fdtasil.distill(None, None, 0, dataset=there, history=H, **AGAIN)
    assert np.array_equal(again.demonstrations.observations, wanted)
    assert set(np.unique(again.demonstrations.observations[:, -M:])) <= {0, 1}


@pytest.mark.fault(224)
def test_another_past_or_memory_than_the_datasets_is_refused(file):
    with_memory = fdtasil.distill(Remembers(), TOY, 0, **RUN).dataset
    with pytest.raises(SettingError, match="remembers nothing, beside states of one"):
        fdtasil.distill(file, TOY, dataset=with_memory, progress=False)
    with pytest.raises(SettingError, match="with student_obs"):
        fdtasil.distill(Remembers(), TOY, dataset=with_memory, student_obs=[0], progress=False)


@pytest.mark.fault(234)
@pytest.mark.parametrize("spaces", [None, Spaces(flat_layout(N + PAST), flat_layout(M))])
def test_what_is_remembered_is_what_an_environment_with_one_bound_takes(spaces):
    size, low, high = N + PAST, np.zeros(M), np.full(M, np.inf)
    random = torch.Generator().manual_seed(0)
    student = fdtasil.Student(
        fdtasil.Mlp(8), np.zeros(size), np.ones(size), low, high, random, spaces=spaces
    )
    states = np.random.default_rng(0).standard_normal((20, N))
    past = np.tile(np.concatenate([states[0], np.zeros(M)]), H - 1)
    policy, cut = fdtasil.History(student, H), 0
    for step, row in enumerate(states):
        action, _ = policy.predict(row, episode_start=step == 0)
        whole = np.concatenate([row, past])[None].astype(np.float32)
        assert action == pytest.approx(student.act(whole)[0], abs=1e-6)
        cut += action.min() == 0
        past = np.concatenate([row, action, past[: -(N + M)]])
    assert cut > 0


@pytest.mark.fault(285)
def test_before_the_start_there_is_no_other_place_than_any_other():
    """Zeros would be 0 kelvin, and the scale of all that is past."""

    class Warm(gymnasium.ObservationWrapper):
        def observation(self, observation):
            return observation + 300.0

    def scales(wrapped):
        made = lambda: wrapped(gymnasium.make(TOY))  # noqa: E731
        result = fdtasil.distill(lambda rows: (rows - rows[:, 4:] + 3) @ GAIN.T, made, 0, **RUN)
        return result.student.scale.numpy()

    plain, warm = scales(gymnasium.Wrapper), scales(Warm)
    assert warm == pytest.approx(plain, rel=1e-2)
    assert warm[N : N + 4] == pytest.approx(warm[:4], rel=0.2)


@pytest.mark.fault(286)
def test_what_is_no_number_is_forgotten_with_the_observation(file):
    student = fdtasil.distill(file, TOY, 0, **RUN).student
    rows = np.random.default_rng(0).standard_normal((6, N))
    for lost in (0, 2):
        policy = fdtasil.History(student, H)
        for step, row in enumerate(rows):
            seen = np.where(step == lost, np.nan, row)
            action, _ = policy.predict(seen, episode_start=step == 0)
            assert np.isfinite(action).all() == (step != lost)


@pytest.mark.fault(268)
def test_what_a_student_can_not_see_is_said_where_it_runs(quick):
    size = 5 + 2 * (5 + 2)  # of a history of three
    student = fdtasil.Student(
        fdtasil.Mlp(4),
        np.zeros(size),
        np.ones(size),
        -np.ones(2),
        np.ones(2),
        torch.Generator(),
    )
    with pytest.raises(SettingError, match=r"History\(result\.student"):
        fdtasil.History(quick, 3)
    policy = fdtasil.History(student, 3)
    with pytest.raises(SettingError, match=r"\(4,\).*\n.*\(5,\)"):
        policy.predict(np.zeros(4))
    with pytest.raises(SettingError, match="is a dict"):
        student.predict({"a": 1})


@pytest.mark.fault(298)
def test_a_file_that_sees_through_a_function_is_not_judged_without_it(file, tmp_path):
    seen, run = lambda rows: 3 * rows, {**RUN, "history": 1}
    result = fdtasil.distill(file, TOY, 0, student_obs=seen, **run)
    written = result.export(tmp_path / "s.onnx")
    again = {"episodes": 2, "horizon": 20, "progress": False}
    for judge in (fdtasil.evaluate, fdtasil.diagnose):
        with pytest.raises(SettingError, match=r"sees through the function .*file does not hold"):
            judge(written, file, TOY, **again)
    found = fdtasil.evaluate(written, file, TOY, student_obs=seen, **again)
    assert found.student_return == pytest.approx(result.evaluation.student_return, rel=1e-3)


def test_paths_are_compared_without_their_past(file):
    run = {"episodes": 2, "horizon": 20, "progress": False}
    law = lambda rows: 0.9 * rows[:, :N] @ GAIN.T  # noqa: E731
    gaps = {fdtasil.evaluate(law, file, TOY, history=h, **run).imitation_gap for h in (1, 2, 5)}
    assert max(gaps) == pytest.approx(min(gaps), rel=1e-6)
    assert min(gaps) > 0
