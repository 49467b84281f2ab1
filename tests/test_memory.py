"""Experts with a memory: carried along each episode, kept by probes, never seen by the student."""

import itertools

import gymnasium
import numpy as np
import onnx
import pytest
from conftest import GAIN, QUICK, TOY
from onnx import TensorProto, helper, numpy_helper
from toy_environments import Integrator
from toy_forms import InForm

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.load import expert_in, load_expert
from fdtasil.files.onnx.recurrent import find_memory
from fdtasil.results.summary import call_of
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.student.schedule import Schedule
from fdtasil.testing import check_expert

pytestmark = pytest.mark.usefixtures("no_pictures")

RANDOM = np.random.default_rng(0)
NOW = RANDOM.standard_normal((5, 2)).astype(np.float32) / 4
THEN = RANDOM.standard_normal((6, 2)).astype(np.float32) / 8
KEEP = np.diag([0.5, 0.9, 0.1, 0.5, 0.3]).astype(np.float32)
N, K = 5, 6


def step(observations, memories):
    """What the toy does: six numbers, a decaying sum of the observations and a clock."""
    actions = np.tanh(observations @ NOW + memories @ THEN)
    sums = memories[:, :5] @ KEEP + 0.1 * observations
    return actions, np.concatenate([sums, memories[:, 5:] + 0.01], axis=1)


class Remembers:
    """Looks like sb3-contrib's recurrent agents: a tuple of arrays (layers, rows, size)."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        rows = len(observation)
        if state is None:
            state = np.zeros((1, rows, 5), np.float32), np.zeros((1, rows, 1), np.float32)
        memory = np.concatenate([part[0] for part in state], axis=1)
        memory = np.where(np.asarray(episode_start)[:, None], 0, memory)
        actions, after = step(observation, memory)
        return actions, (after[None, :, :5], after[None, :, 5:])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The look of rsl_rl's exports: one row at a time, the state in and out."""

    def entry(name, shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    nodes = [
        helper.make_node("Squeeze", ["h_in", "zero"], ["sums"]),
        helper.make_node("Squeeze", ["c_in", "zero"], ["clock"]),
        helper.make_node("Concat", ["sums", "clock"], ["memory"], axis=1),
        helper.make_node("MatMul", ["obs", "now"], ["a"]),
        helper.make_node("MatMul", ["memory", "then"], ["b"]),
        helper.make_node("Add", ["a", "b"], ["c"]),
        helper.make_node("Tanh", ["c"], ["actions"]),
        helper.make_node("MatMul", ["sums", "keep"], ["kept"]),
        helper.make_node("Mul", ["obs", "tenth"], ["new"]),
        helper.make_node("Add", ["kept", "new"], ["sum"]),
        helper.make_node("Unsqueeze", ["sum", "zero"], ["h_out"]),
        helper.make_node("Add", ["c_in", "hundredth"], ["c_out"]),
    ]
    constants = {
        "zero": np.array([0], np.int64),
        "now": NOW,
        "then": THEN,
        "keep": KEEP,
        "tenth": np.float32(0.1),
        "hundredth": np.float32(0.01),
    }
    graph = helper.make_graph(
        nodes,
        "recurrent",
        [entry("obs", [1, 5]), entry("h_in", [1, 1, 5]), entry("c_in", [1, 1, 1])],
        [entry("actions", [1, 2]), entry("h_out", [1, 1, 5]), entry("c_out", [1, 1, 1])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    path = tmp_path_factory.mktemp("recurrent") / "e.onnx"
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)
    return path


@pytest.fixture(params=["file", "object"])
def expert(request, file):
    return file if request.param == "file" else Remembers()


def played(seed, steps):
    """Return the expert's own actions in the toy, remembered by hand."""
    environment, memory = Integrator(), np.zeros((1, K), np.float32)
    observation, _ = environment.reset(seed=seed)
    actions = []
    for _ in range(steps):
        action, memory = step(observation[None].astype(np.float32), memory)
        actions.append(action[0])
        observation, _, terminated, *_ = environment.step(action[0])
        if terminated:
            break
    return np.array(actions)


def test_the_memory_is_carried_and_begins_anew_with_each_episode(expert):
    opened = load_expert(expert, N, 2)
    assert (opened.observation_size, opened.memory.size) == (N + K, K)
    result = fdtasil.distill(expert, TOY, 3, **QUICK, progress=False)
    states = result.dataset.demonstrations
    assert states.observations.shape[1] == N + K
    seeds = fdtasil.seeding.episode_seeds(0, "rollout", 0, 2)
    for number, seed in enumerate(seeds):
        mine = states.actions[states.episode == number]
        assert mine == pytest.approx(played(seed, 20), abs=1e-4)


def test_probes_keep_the_memory_and_the_student_sees_none(expert, tmp_path):
    result = fdtasil.distill(expert, TOY, 3, **QUICK, progress=False)
    answers = result.dataset.answers
    assert (answers.displacements[:, N:] == 0).all()
    assert (answers.displacements[:, :4] != 0).any(axis=0).all()  # the fifth stands still
    states = result.dataset.demonstrations.observations
    moved = states[:, None] + answers.displacements[answers.numbers]
    rows = moved.reshape(-1, N + K)
    said = answers.values[:, :, 0].reshape(-1, 2)
    assert said == pytest.approx(step(rows[:, :N], rows[:, N:])[0], abs=1e-4)
    assert result.student.predict(np.zeros(N, np.float32))[0].shape == (2,)
    file = result.to_onnx(tmp_path / "s.onnx")
    again = fdtasil.evaluate(file, expert, TOY, episodes=2, horizon=20, progress=False)
    assert again.student_return == pytest.approx(result.evaluation.student_return, rel=1e-4)


def test_every_row_asked_is_predicted_and_counted(expert):
    result = fdtasil.distill(expert, TOY, 3, **QUICK, progress=False)
    asked, predicted = result.report["queries"], result.report["predicted_queries"]
    assert 0 < asked["remember"] <= predicted["remember"]
    assert asked["check"] <= predicted["check"]
    whole = fdtasil.distill(Remembers(), TOY, 3, **QUICK, progress=False)
    assert whole.queries["check"] == whole.report["predicted_queries"]["check"]


@pytest.mark.parametrize("trainer", ["dagger", "dart"])
def test_whoever_acts_the_expert_remembers(trainer, expert):
    trainer = {"dagger": fdtasil.DAgger((1, 2)), "dart": fdtasil.Dart((1, 2), extra=1)}[trainer]
    run = {**QUICK, "episodes": 3}
    result = fdtasil.distill(expert, TOY, 3, trainer=trainer, progress=False, **run)
    rows = result.dataset.demonstrations.observations
    assert result.dataset.demonstrations.actions == pytest.approx(
        step(rows[:, :N], rows[:, N:])[0], abs=1e-4
    )
    for number in range(3):
        mine = rows[result.dataset.demonstrations.episode == number]
        for before, after in itertools.pairwise(mine):
            memory = step(before[None, :N], before[None, N:])[1][0]
            assert after[N:] == pytest.approx(memory, abs=1e-4)


def test_a_student_that_sees_less_never_sees_the_memory(expert):
    run = {**QUICK, "progress": False}
    some = fdtasil.distill(expert, TOY, 3, student_obs=[0, 3], **run)
    assert some.student.predict(np.zeros(2, np.float32))[0].shape == (2,)
    doubled = fdtasil.distill(expert, TOY, 3, student_obs=lambda rows: 2 * rows, **run)
    assert doubled.student.predict(np.zeros(N, np.float32))[0].shape == (2,)
    with pytest.raises(SettingError, match="indices from 0 to 4"):
        fdtasil.distill(expert, TOY, 3, student_obs=[5], **run)


def test_an_environment_that_is_passed_in_is_wrapped_too():
    environment = gymnasium.make(TOY)
    result = fdtasil.distill(Remembers(), environment, 3, **QUICK, progress=False)
    expected = fdtasil.distill(Remembers(), TOY, 3, **QUICK, progress=False)
    ours, theirs = result.demonstrations.observations, expected.demonstrations.observations
    # One copy is asked about a row at a time, and a product's last digit may depend on that.
    assert ours == pytest.approx(theirs, abs=1e-6)


class Stop(Exception):
    """Stands for a kill."""


@pytest.mark.slow
@pytest.mark.usefixtures("many_checkpoints")
def test_it_resumes_to_the_byte(expert, tmp_path):
    run = {**QUICK, "trainer": "dagger", "episodes": 3, "fit": fdtasil.Fit(steps=105)}
    fdtasil.distill(expert, TOY, 3, out=tmp_path / "whole", progress=False, **run)

    def stop(event):
        raise Stop

    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, 3, out=tmp_path / "run", callback=stop, **run)
    fdtasil.distill(expert, TOY, 3, resume=tmp_path / "run", progress=False, **run)
    for name in ("student.safetensors", "demonstrations.npz"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_other_names_are_said(file, tmp_path):
    model = onnx.load(file)
    for part in (*model.graph.input, *model.graph.output):
        part.name = {"h_in": "u", "h_out": "v"}.get(part.name, part.name)
    for node in model.graph.node:
        node.input[:] = ["u" if name == "h_in" else name for name in node.input]
        node.output[:] = ["v" if name == "h_out" else name for name in node.output]
    path = tmp_path / "named.onnx"
    onnx.save(model, path)
    opened = load_expert(path, N, 2, memory={"u": "v", "c_in": "c_out"})
    rows = RANDOM.standard_normal((4, N + K)).astype(np.float32)
    assert opened.ask(rows, "act") == pytest.approx(step(rows[:, :N], rows[:, N:])[0], abs=1e-5)
    with pytest.raises(SettingError, match="memory: 'x'"):
        load_expert(path, N, 2, memory={"x": "v"})


def test_what_a_memory_does_not_go_with_is_refused(file, expert):
    with pytest.raises(SettingError, match="which has a memory"):
        load_expert(expert, N, 2, workers=2)
    with pytest.raises(SettingError, match="to be judged"):
        fdtasil.evaluate(expert, expert, TOY, episodes=1, horizon=5)
    dataset = fdtasil.distill(Remembers(), TOY, 3, **QUICK, progress=False).dataset
    with pytest.raises(SettingError, match="without an environment"):
        fdtasil.distill(expert, None, dataset=dataset, progress=False)


def test_a_student_that_can_not_follow_is_named(monkeypatch):
    """The action is the memory alone, of which the observation says nothing."""
    monkeypatch.setattr(Schedule, "total_steps", lambda schedule, states: 40)

    class Clock(Remembers):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            _, after = super().predict(observation, state, episode_start)
            clock = after[1][0]
            return np.concatenate([np.sin(50 * clock), np.cos(50 * clock)], axis=1), after

    run = {name: value for name, value in QUICK.items() if name != "fit"}
    with pytest.warns(fdtasil.FdtasilWarning, match="does not see the expert's memory") as caught:
        fdtasil.distill(Clock(), TOY, 3, **run, progress=False)
    assert any("fdtasil.Fit(steps=80)" in str(one.message) for one in caught)


@pytest.mark.fault(208)
def test_states_are_paired_by_their_names(file, tmp_path):
    """Outputs in another order, all of one size, which nothing but names can tell apart."""

    def entry(name):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, 5])

    nodes = [
        helper.make_node("Squeeze", ["h_in", "zero"], ["actions"]),
        helper.make_node("Add", ["c_in", "c_in"], ["c_out"]),
        helper.make_node("Add", ["h_in", "one"], ["h_out"]),
    ]
    obs = helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, 5])
    act = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 5])
    constants = {"zero": np.array([0], np.int64), "one": np.float32(1)}
    graph = helper.make_graph(
        nodes,
        "crossed",
        [obs, entry("h_in"), entry("c_in")],
        [act, entry("c_out"), entry("h_out")],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=9)
    assert find_memory(model, None) == (("h_in", "h_out"), ("c_in", "c_out"))


@pytest.mark.fault(208)
def test_a_memory_that_does_not_begin_with_zeros_is_refused():
    class Ones(Remembers):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            rows = len(observation)
            if state is None:
                state = np.ones((1, rows, 5), np.float32), np.ones((1, rows, 1), np.float32)
            return super().predict(observation, state, np.zeros(rows, bool))

    with pytest.raises(ExpertError, match="another memory than zeros"):
        load_expert(Ones(), N, 2)


@pytest.mark.fault(288)
def test_a_memory_that_does_not_begin_with_zeros_shows_where_episodes_begin():
    """Elsewhere this law is at its bounds, whatever it remembers."""

    class Settles:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            seen = np.asarray(observation[:, :2], np.float64)
            last = (
                seen
                if state is None
                else np.where(np.reshape(episode_start, (-1, 1)), seen, state)
            )
            far = 1e4 * (observation[:, 4:] - 3)  # the toy's constant
            return np.clip(far + seen - last, -1, 1), seen

    assert load_expert(Settles(), N, 2).memory is not None
    with pytest.raises(ExpertError, match="another memory than zeros"):
        fdtasil.distill(Settles(), TOY, 0, progress=False, **QUICK)
    for expert, said in ((Settles(), "another memory than zeros"), (Remembers(), "")):
        (begun,) = (one for one in check_expert(expert, TOY) if one.name == "beginning")
        assert (begun.problem.found if begun.problem else "").endswith(said)
        assert bool(begun.problem) == bool(said)


class Seats(Remembers):
    """Raises where it is asked about that many rows."""

    def __init__(self, seats):
        self.seats = seats

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if len(observation) in self.seats:
            raise ValueError("no seat")
        return super().predict(observation, state, episode_start)


@pytest.mark.fault(289)
@pytest.mark.parametrize("seats", [(1,), range(4, 99)])
def test_what_an_expert_with_a_memory_raises_is_no_fault_of_the_environment(seats):
    with pytest.raises(ExpertError, match=r"raised ValueError.*no seat"):
        fdtasil.distill(Seats(seats), TOY, 0, progress=False, **QUICK)


@pytest.mark.fault(289)
def test_a_state_that_can_not_be_carried_says_how_it_is_asked_for():
    class Listed:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return observation[:, :2], np.zeros((len(observation), 1)).tolist()

    class Short:
        def predict(self, observation, **ignored):
            return observation[:, :2], np.zeros((len(observation), 1))

    class Alone:
        def predict(self, observation):
            return observation[:, :2], np.zeros((len(observation), 1))

    for one in (Listed(), Short(), Alone()):
        with pytest.raises(ExpertError, match=r"predict\(observation, state, episode_start\)"):
            fdtasil.distill(one, TOY, 0, progress=False, **QUICK)


def test_the_call_of_a_run_with_memory_and_history_can_be_made():
    result = fdtasil.distill(Remembers(), TOY, 0, history=2, progress=False, **QUICK)
    call = call_of(result.settings, 2)
    assert "history=2" in call
    assert "student_obs" not in call


def test_inspect_and_gains_take_it_too(file, inside):
    shown = inside("inspect", file, TOY, "--episodes", 2)
    assert shown.returncode == 0, shown.stderr
    shown = inside("gains", file, TOY, "--states", 3, "--horizon", 20)
    assert shown.returncode == 0, shown.stderr
    assert "Jacobians of 2 x 11" in shown.stdout


class WithDictionary:
    """Remembers two things by their names."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = len(observation)
        if state is None:
            state = {"sum": np.zeros((rows, 2)), "last": np.zeros((rows, 5))}
        begun = np.reshape(episode_start, (-1, 1))
        before = {name: np.where(begun, 0, part) for name, part in state.items()}
        total = 0.5 * before["sum"] + (observation - 0.1 * before["last"]) @ GAIN.T
        return total, {"last": observation.copy(), "sum": total}  # in another order


def test_a_memory_may_be_a_dictionary():
    expert = fdtasil.load_expert(WithDictionary(), 5)
    assert expert.memory.size == 7
    rows = np.random.default_rng(0).standard_normal((3, 5)).astype(np.float32)
    first, kept = expert.memory.step(rows, np.zeros((3, 7), np.float32))
    second, _ = expert.memory.step(rows, kept)
    assert first == pytest.approx(rows @ GAIN.T, abs=1e-5)
    assert second == pytest.approx(0.5 * first + 0.9 * rows @ GAIN.T, abs=1e-5)


@pytest.mark.fault(309)
@pytest.mark.parametrize("unit", [1.0, 1e-5])
@pytest.mark.parametrize("keeps", [False, True])
def test_a_beginning_is_seen_in_any_unit_and_behind_one_buffer(unit, keeps):
    class FromOne:
        def __init__(self):
            self.buffer = np.zeros((64, 2))

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            last = np.zeros((len(observation), 1)) if state is None else state
            last = np.where(np.reshape(episode_start, (-1, 1)), 1.0, last)
            answers = unit * np.repeat(last, 2, axis=1)
            if keeps:
                self.buffer[: len(answers)] = answers
                answers = self.buffer[: len(answers)]
            return answers, last / 2

    with pytest.raises(ExpertError, match="another memory than zeros"):
        load_expert(FromOne(), N, 2)


class OfParts:
    """Pulls at the last place that it saw, which it is given by name."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        place = np.asarray(observation["place"], np.float32)
        last = np.zeros_like(place) if state is None else state
        return -0.5 * last[:, :2], place


@pytest.mark.fault(322)
def test_a_memory_beside_parts_is_carried_along():
    made = lambda: InForm("dictionary")  # noqa: E731
    with EnvironmentPool(made) as pool:
        expert = expert_in(OfParts(), pool)
        columns = list(pool.spaces.observations.columns("place"))
    n = expert.observation_size - expert.memory.size
    rows = np.random.default_rng(0).standard_normal((4, n)).astype(np.float32)
    first, memory = expert.memory.step(rows, np.zeros((4, expert.memory.size), np.float32))
    second, _ = expert.memory.step(rows, memory)
    assert not first.any()
    np.testing.assert_allclose(second, -0.5 * rows[:, columns][:, :2])
    result = fdtasil.distill(OfParts(), made, 0, progress=False, **QUICK)
    assert result.queries["remember"] > 0


class Chooses:
    """One choice a row, (B,) integers, of the last and of the present observation."""

    def __init__(self, first=0):
        self.first = first

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        last = np.zeros((len(observation), 1), np.float32) if state is None else state
        lean = observation[:, 2] + 0.5 * observation[:, 3] + 0.1 * last[:, 0]
        choice = (lean > 0).astype(int)
        return choice if state is not None else choice ^ self.first, observation[:, 2:3]


@pytest.mark.fault(334)
def test_a_memory_of_one_choice_a_row_is_carried_along():
    assert distil_cart_pole(Chooses()).queries["remember"] > 0
    with pytest.raises(ExpertError, match="another memory than zeros"):
        distil_cart_pole(Chooses(first=1))


def distil_cart_pole(expert):
    about = QUICK | {"horizon": 20}
    return fdtasil.distill(expert, "CartPole-v1", 0, progress=False, **about)


def test_a_function_is_given_to_load_as_it_was_to_the_run(tmp_path):
    """It sees the environment's observation, and the run's states have the memory behind them."""
    part = lambda rows: rows[:, 1:]  # noqa: E731
    result = fdtasil.distill(Remembers(), TOY, 0, student_obs=part, **QUICK)
    again = fdtasil.Distilled.load(result.save(tmp_path / "run"), student_obs=part)
    assert again.export_bytes("s.onnx") == result.export_bytes("s.onnx")


def test_a_memory_behind_observations_of_unknown_length_is_refused():
    class OfAnyLength:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 2)), np.zeros((len(observation), 1))

    with pytest.raises(ExpertError, match="nobody says how long") as caught:
        load_expert(OfAnyLength()).ask(np.zeros((2, N)), "check")
    assert "observation_size=n" in caught.value.next_step


@pytest.mark.fault(350)
def test_a_function_beside_a_memory_is_told_of_its_own_shape():
    with pytest.raises(SettingError, match=r"raised IndexError on \(2, 5\) observations"):
        fdtasil.distill(Remembers(), TOY, 0, student_obs=lambda rows: rows["place"], **QUICK)
