"""Actions that are choices: scores are learnt, the best of them is taken."""

import gymnasium
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from conftest import GAIN, QUICK, mlp_onnx
from onnx import TensorProto, helper, numpy_helper
from sb3_agents import fresh_agent, save_agent, shake
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.load import expert_in
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.student.plain import PlainPolicy

pytestmark = pytest.mark.usefixtures("no_pictures")


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


def scores(rows):
    """Of the four choices of the toy, the sum of the two forces where they are right."""
    left, right = law(rows).T
    return np.stack([a * left + b * right for b in (-1, 1) for a in (-1, 1)], axis=1)


def distilled(expert, done="choice", probes=3, **changes):
    options = {**QUICK, "progress": False, **changes}
    return fdtasil.distill(expert, lambda: InForm("box", done), probes, **options)


@pytest.fixture
def pool():
    with EnvironmentPool(lambda: InForm("box", "choice")) as opened:
        yield opened


def rows_of(count=50):
    return np.random.default_rng(1).standard_normal((count, 5)).astype(np.float32)


def test_a_number_added_to_all_scores_is_nothing_to_be_learnt(pool):
    rows = rows_of()
    plain = expert_in(scores, pool).ask(rows, "check")
    shifted = expert_in(lambda x: scores(x) + 100 * x[:, :1], pool).ask(rows, "check")
    assert plain == pytest.approx(scores(rows), abs=1e-5)  # which sum to zero
    assert shifted == pytest.approx(plain, abs=1e-4)


def test_who_only_chooses_has_ones_for_scores(pool):
    rows = rows_of()
    chosen = expert_in(in_form(law, "box", "choice"), pool).ask(rows, "check")
    assert np.array_equal(chosen.argmax(1), scores(rows).argmax(1))
    assert np.array_equal(np.unique(chosen), np.float32([-0.25, 0.75]))
    silent = lambda x: np.where(x[:, 0] > 0, 1.0, np.nan)  # noqa: E731
    assert np.isnan(expert_in(silent, pool).ask(rows, "check")).all(1).tolist() == (
        (rows[:, 0] <= 0).tolist()
    )


@pytest.mark.fault(215)
@pytest.mark.parametrize(
    "answer",
    [
        lambda x: np.full(len(x), 5),
        lambda x: np.zeros((len(x), 3)),
        lambda x: np.full(len(x), 1.5),
    ],
)
def test_an_answer_that_is_no_choice(answer):
    with pytest.raises(ExpertError, match="choices"):
        distilled(answer)


@pytest.mark.parametrize("expert", [scores, in_form(law, "box", "choice")])
@pytest.mark.parametrize("probes", [0, 3, "sphere:2,central", "fresh:2", "10,labels"])
@pytest.mark.parametrize("trainer", ["bc", "dagger"])
def test_every_source_teaches_choices(expert, probes, trainer, tmp_path):
    result = distilled(expert, probes=probes, trainer=trainer)
    again = distilled(expert, probes=probes, trainer=trainer)
    assert result.student.to_bytes() == again.student.to_bytes()
    assert 0 <= result.evaluation.agreement <= 1
    assert "agreement" in str(result.evaluation)


@pytest.mark.slow
def test_scores_are_learnt_and_the_best_is_taken(tmp_path):
    result = distilled(scores, fit=fdtasil.Fit(steps=1500), episodes=5)
    assert result.evaluation.agreement > 0.9
    rows = result.demonstrations.observations[:20]
    chosen = result.student.predict(rows)[0]
    assert np.array_equal(chosen, 1 + result.student.act(rows).argmax(1))
    assert chosen.dtype == np.int64
    one = result.student.predict(rows[0])[0]
    assert one == chosen[0]
    assert InForm("box", "choice").action_space.contains(one)

    path = result.export(tmp_path / "student.onnx")
    session = onnxruntime.InferenceSession(path)
    found = session.run(["scores", "actions"], {"obs": rows})
    assert found[0] == pytest.approx(result.student.act(rows), abs=1e-4)
    assert np.array_equal(found[1], chosen)
    environment = lambda: InForm("box", "choice")  # noqa: E731
    for judged in (result.student, str(path)):
        judgement = fdtasil.evaluate(judged, scores, environment, episodes=2, horizon=20)
        assert judgement.student_returns == result.evaluation.student_returns[:2]
        assert judgement.agreement == pytest.approx(result.evaluation.agreement)
    # Judged as an expert: another student learns from the file.
    assert distilled(str(path), probes=2).evaluation.expert_return == pytest.approx(
        result.evaluation.student_return
    )
    result.save(tmp_path / "run")
    read = fdtasil.Distilled.load(tmp_path / "run")
    assert np.array_equal(read.student.predict(rows)[0], chosen)
    small = fdtasil.distill(dataset=tmp_path / "run", fit=fdtasil.Fit(steps=5))
    assert small.student.predict(rows)[0].dtype == np.int64


def test_several_choices(tmp_path):
    result = distilled(in_form(law, "box", "choices"), "choices", episodes=5)
    rows = result.demonstrations.observations[:20]
    chosen = result.student.predict(rows)[0]
    assert chosen.shape == (20, 2)
    session = onnxruntime.InferenceSession(result.export(tmp_path / "s.onnx"))
    assert np.array_equal(session.run(["actions"], {"obs": rows})[0], chosen)


def test_choices_agree_where_all_of_them_do():
    half, expert = (
        in_form(lambda x, sides=sides: law(x) * sides, "box", "choices")
        for sides in ([1, -1], [1, 1])
    )
    made, run = lambda: InForm("box", "choices"), {"episodes": 2, "horizon": 20}
    assert fdtasil.evaluate(half, expert, made, **run).agreement == 0
    assert fdtasil.evaluate(expert, expert, made, **run).agreement == 1


@pytest.mark.fault(218)
@pytest.mark.parametrize("trainer", ["dart", "noise"])
def test_noise_on_choices_is_refused(trainer):
    with pytest.raises(SettingError, match="choices"):
        distilled(scores, trainer=trainer)


def test_the_analytic_reference_has_scores():
    with torch.random.fork_rng():
        network = torch.nn.Sequential(
            torch.nn.Linear(5, 8), torch.nn.Tanh(), torch.nn.Linear(8, 4)
        )
    exact, asked = (distilled(network, probes=probes) for probes in ("jacobian", "basis"))
    assert exact.answers.values.sum(axis=-1) == pytest.approx(0, abs=1e-4)
    assert exact.demonstrations.actions == pytest.approx(asked.demonstrations.actions, abs=1e-6)


def test_an_onnx_file_of_scores(tmp_path):
    path = mlp_onnx(tmp_path / "q.onnx", (5, 8, 4))
    result = distilled(str(path))
    assert result.demonstrations.actions.shape[1] == 4
    assert result.demonstrations.actions.sum(axis=1) == pytest.approx(0, abs=1e-4)
    assert (
        distilled(str(path), probes=None, fit=fdtasil.Fit(steps=5))
        .report["probes"]
        .startswith("adaptive:10")
    )


@pytest.mark.parametrize("shape", [("batch",), ("batch", 1)])
def test_an_onnx_file_that_only_chooses(shape, tmp_path):
    """As a classifier of another library is exported: a label, and nothing beside it."""
    weights = [numpy_helper.from_array(np.float32(np.eye(5)[:, :4]), "w")]
    keep = int(len(shape) > 1)
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["z"]),
        helper.make_node("ArgMax", ["z"], ["best"], axis=1, keepdims=keep),
        helper.make_node("Add", ["best", "one"], ["label"]),
    ]
    weights.append(numpy_helper.from_array(np.array([1] * keep or 1, np.int64), "one"))
    graph = helper.make_graph(
        nodes,
        "chooser",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["batch", 5])],
        [helper.make_tensor_value_info("label", TensorProto.INT64, shape)],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, tmp_path / "c.onnx")
    result = distilled(str(tmp_path / "c.onnx"))
    states = result.demonstrations
    expected = states.observations[:, :4].argmax(1)
    assert np.array_equal(states.actions.argmax(1), expected)


@pytest.mark.parametrize("name", ["PPO", "A2C", "DQN", "QRDQN"])
def test_agents_that_choose(name, tmp_path):
    agent = shake(fresh_agent(name, "CartPole-v1", {"net_arch": [9, 8]}))
    path = save_agent(tmp_path, agent)
    read = read_agent(path)
    assert read.algorithm == name
    rows = np.random.default_rng(0).standard_normal((200, 4)).astype(np.float32)
    expected = agent.predict(rows, deterministic=True)[0]
    found = read.module(torch.from_numpy(rows)).detach().numpy()
    assert np.array_equal(found.argmax(1), expected)
    with EnvironmentPool("CartPole-v1") as pool:
        ours = [expert_in(one, pool).ask(rows, "check") for one in (str(path), agent)]
    assert ours[0] == pytest.approx(ours[1], abs=1e-4)  # the object's own scores
    assert np.array_equal(ours[0].argmax(1), expected)


def test_the_policy_of_an_agent_that_chooses(tmp_path):
    agent = shake(fresh_agent("DQN", "CartPole-v1", {"net_arch": [9]}))
    rows = np.random.default_rng(0).standard_normal((50, 4)).astype(np.float32)
    expected = agent.predict(rows, deterministic=True)[0]
    fdtasil.load_expert(agent.policy, 4, 2)
    with EnvironmentPool("CartPole-v1") as pool:
        found = expert_in(agent.policy, pool).ask(rows, "check")
    assert np.array_equal(found.argmax(1), expected)


def test_several_choices_of_an_agent(tmp_path):
    agent = shake(fresh_agent("PPO", InForm("box", "choices"), {}))
    rows = rows_of()
    expected = agent.predict(rows, deterministic=True)[0]
    with EnvironmentPool(lambda: InForm("box", "choices")) as pool:
        for one in (str(save_agent(tmp_path, agent)), agent):
            found = expert_in(one, pool).ask(rows, "check")
            assert np.array_equal(pool.spaces.actions.best(found), expected)


def test_an_agent_exported_by_the_command(tmp_path, inside):
    agent = shake(fresh_agent("QRDQN", "CartPole-v1", {"net_arch": [9], "n_quantiles": 7}))
    path = save_agent(tmp_path, agent)
    done = inside("export-sb3", path, "--out", tmp_path / "q.onnx", "--env", "CartPole-v1")
    assert (done.returncode, done.stderr) == (0, "")
    rows = np.random.default_rng(0).standard_normal((50, 4)).astype(np.float32)
    session = onnxruntime.InferenceSession(tmp_path / "q.onnx")
    (found,) = session.run(None, {"obs": rows})
    assert np.array_equal(found.argmax(1), agent.predict(rows, deterministic=True)[0])


def test_stable_baselines3_evaluates_a_student():
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    balance = lambda x: (x[:, 2] + 0.5 * x[:, 3] > 0).astype(int)  # noqa: E731
    options = {**QUICK, "episodes": 3, "horizon": 100, "fit": fdtasil.Fit(steps=1500)}
    result = fdtasil.distill(balance, "CartPole-v1", "10,labels", **options)
    environment = Monitor(gymnasium.make("CartPole-v1"))
    mean, _ = evaluate_policy(result.student, environment, n_eval_episodes=2, warn=False)
    assert mean > 50


def test_a_history_of_choices_is_what_was_chosen():
    """As the environment showed it in training, so `History` keeps it where the student runs."""
    options = {**QUICK, "history": 2, "episodes": 3}
    result = distilled(scores, **options)
    rows = result.demonstrations.observations
    states = result.demonstrations
    assert rows.shape[1] == 5 + 5 + 4
    done = rows[states.episode == 0][1:, 10:]
    chosen = states.actions[states.episode == 0][:-1].argmax(1)
    assert np.array_equal(done, np.eye(4)[chosen])
    policy = fdtasil.History(result.student, 2)
    environment = InForm("box", "choice")
    seen, _ = environment.reset(seed=0)
    before = np.append(seen, np.zeros(4))
    for step in range(5):
        action, _ = policy.predict(seen, episode_start=step == 0)
        flat = result.student.act(np.append(seen, before)[None].astype(np.float32))[0]
        assert action == 1 + flat.argmax()
        before = np.append(seen, np.eye(4)[flat.argmax()])
        seen, *_ = environment.step(action)


def test_a_module_that_chooses():
    class Chooses(torch.nn.Module):
        def forward(self, rows):
            return torch.from_numpy(scores(rows.numpy())).argmax(1) + 1

    result = distilled(Chooses())
    assert np.array_equal(
        result.demonstrations.actions.argmax(1),
        scores(result.demonstrations.observations).argmax(1),
    )


def test_yes_and_no_of_an_agent():
    class Switches(InForm):
        def __init__(self):
            super().__init__("box", "choices")
            self.action_space = gymnasium.spaces.MultiBinary(2)

    agent = shake(fresh_agent("PPO", Switches(), {}))
    rows = rows_of()
    with EnvironmentPool(Switches) as pool:
        found = expert_in(agent, pool).ask(rows, "check")
        best = pool.spaces.actions.best(found)
    assert np.array_equal(best, agent.predict(rows, deterministic=True)[0])


def test_the_copy_in_numpy_chooses_too(tmp_path):
    result = distilled(scores)
    plain, states = result.student.plain, result.demonstrations.observations[:5]
    result.save(tmp_path / "run")
    loaded = PlainPolicy.load(tmp_path / "run" / "student.safetensors")
    assert plain.choices == loaded.choices != ()
    assert np.array_equal(plain.choose(states), loaded.choose(states))


def test_choices_in_rows_keep_their_shape_in_the_file(tmp_path):
    class Square(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1, 1, (3,))
        action_space = gymnasium.spaces.MultiBinary([2, 2])

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

        def step(self, action):
            seen = self.np_random.uniform(-1, 1, 3).astype(np.float32)
            return seen, float(action.sum()), False, False, {}

    def switches(rows):
        return (np.asarray(rows)[:, [0, 1, 2, 0]] > 0).astype(np.int8).reshape(-1, 2, 2)

    result = fdtasil.distill(switches, Square, 3, **QUICK)
    result.export(tmp_path / "square.onnx")
    rows = result.demonstrations.observations[:5]
    session = onnxruntime.InferenceSession(tmp_path / "square.onnx")
    (chosen,) = session.run(["actions"], {"obs": rows})
    assert chosen.shape == (5, 2, 2)
    assert np.array_equal(chosen, result.student.predict(rows)[0])


@pytest.mark.filterwarnings("default::fdtasil.errors.FdtasilWarning")
def test_recorded_choices_are_taken_as_the_error_says():
    made, rows = lambda: InForm("box", "choice"), rows_of()
    chosen, run = scores(rows).argmax(axis=1), {"probes": 0, "evaluation_episodes": 2}
    run |= {"horizon": 10, "fit": fdtasil.Fit(steps=5), "student": fdtasil.Mlp(4)}
    plain = fdtasil.from_arrays(rows, chosen[:, None].astype(np.float32))
    with pytest.raises(SettingError) as caught:
        fdtasil.distill(scores, made, dataset=plain, **run)
    told = caught.value.next_step.partition("there: ")[2]
    data = fdtasil.from_arrays(rows, eval(told, {"np": np, "chosen": chosen}))
    assert fdtasil.distill(None, made, dataset=data, **run).student.action_size == 4


@pytest.mark.fault(284)
def test_where_nothing_lies_between_two_observations_the_choices_are_cloned():
    law = lambda fields: np.asarray(fields) % 4  # noqa: E731
    run = QUICK | {"fit": fdtasil.Fit(steps=300), "horizon": 50, "episodes": 10}
    with pytest.warns(FdtasilWarning) as told:
        result = fdtasil.distill(law, "FrozenLake-v1", **run)
    assert "nothing lies between two of them" in str(told[0].message)
    assert result.settings["probes"] == "none"
    assert result.evaluation.agreement == 1.0
    asked = []
    with pytest.raises(SettingError, match="leave probes= out"):
        fdtasil.distill(lambda f: [asked.append(len(f)), law(f)][1], "FrozenLake-v1", 3, **run)
    assert sum(asked) < 10  # what it answers is looked at, and nothing is recorded


@pytest.mark.fault(290)
def test_recorded_scores_are_centred_as_an_experts_are():
    """Else the student would learn them at the states, and others at the probes around."""
    rows = rows_of()
    chosen = scores(rows).argmax(axis=1)
    data = fdtasil.from_arrays(rows, np.eye(4)[chosen])
    lookup = lambda x: 1 + scores(x).argmax(axis=1)  # noqa: E731
    made, run = lambda: InForm("box", "choice"), QUICK | {"episodes": None}
    result = fdtasil.distill(lookup, made, 3, dataset=data, progress=False, **run)
    assert result.demonstrations.actions == pytest.approx(np.eye(4)[chosen] - 0.25)
    centred = fdtasil.from_arrays(rows, scores(rows))  # but for rounding
    kept = fdtasil.distill(scores, made, 0, dataset=centred, progress=False, **run).dataset
    assert np.array_equal(kept.demonstrations.actions, centred.demonstrations.actions)
    again = fdtasil.distill(lookup, made, dataset=result.dataset, progress=False, **run)
    assert np.array_equal(again.demonstrations.actions, result.demonstrations.actions)


@pytest.mark.fault(320)
@pytest.mark.parametrize("done", ["choice", "choices"])
def test_a_student_of_choices_is_as_far_off_however_it_is_judged(done, tmp_path):
    """A number added to all scores changes no choice, and no error."""
    made = lambda: InForm("box", done)  # noqa: E731
    expert = in_form(law, "box", done)
    result = fdtasil.distill(expert, made, 0, **QUICK)
    about = {"episodes": 2, "horizon": 20}
    for policy in (result, result.export(tmp_path / "s.onnx")):
        found = fdtasil.evaluate(policy, expert, made, **about)
        assert found.action_error == pytest.approx(result.evaluation.action_error, rel=1e-3)


@pytest.mark.fault(324)
def test_nothing_is_chosen_of_an_observation_that_is_none(tmp_path):
    result = distilled(in_form(law, "box", "choice"), probes=0)
    nothing = np.full(5, np.nan, np.float32)
    with pytest.raises(SettingError, match="NaN or infinite"):
        result.student.predict(nothing)
    plain = PlainPolicy.load(result.save(tmp_path / "run") / "student.safetensors")
    with pytest.raises(ValueError, match="NaN"):
        plain.choose(nothing)
