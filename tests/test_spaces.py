"""Environments and experts of any spaces: flat inside, their own form at the border."""

import gymnasium
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from conftest import GAIN, QUICK
from gymnasium.spaces import Box, Dict, Discrete, Sequence, Text
from onnx import TensorProto, helper, numpy_helper
from sb3_agents import fresh_agent
from toy_forms import ACTIONS, OBSERVATIONS, InForm, in_form

import fdtasil
from fdtasil.errors import EnvironmentFault, ExpertError, ExportError, SettingError
from fdtasil.results.distilled import Distilled
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.spaces import Layout, Spaces, layout_of

pytestmark = pytest.mark.usefixtures("no_pictures")


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


def distilled(seen="box", done="box", probes=3, **changes):
    options = {**QUICK, "progress": False, **changes}
    return fdtasil.distill(in_form(law, seen, done), lambda: InForm(seen, done), probes, **options)


@pytest.fixture(scope="module")
def plain():
    return distilled()


def values_of(space, rows, count):
    layout = layout_of(space, "actions" if rows == "a" else "observations")
    return layout, np.random.default_rng(0).standard_normal((count, layout.size))


@pytest.mark.parametrize("form", [*OBSERVATIONS.values(), *ACTIONS.values()])
def test_a_flat_form_leads_back(form):
    layout = layout_of(form.space, "observations")
    form.space.seed(0)
    samples = [form.space.sample() for _ in range(5)]
    rows = np.stack([layout.row(sample) for sample in samples])
    batch = layout.values(rows)
    again = layout.rows(batch)
    assert np.allclose(again, rows)
    for row, sample in zip(rows, samples, strict=True):
        value = layout.value(row)
        assert form.space.contains(value)
        assert np.array_equal(layout.row(value), layout.row(sample))
    assert Layout.from_json(layout.to_json()) == layout


@pytest.mark.slow
@pytest.mark.parametrize("form", OBSERVATIONS)
def test_the_same_numbers_in_another_form_teach_the_same(form, plain, tmp_path):
    """Rollout, probes, training, evaluation, the student's own form, file and ONNX."""
    result = distilled(form)
    assert tuple(result.report["held"]) == OBSERVATIONS[form].held
    ours, theirs = result.demonstrations, plain.demonstrations
    assert np.array_equal(ours.actions, theirs.actions)
    assert np.array_equal(ours.rewards, theirs.rewards)
    columns = _numbers_of(form)
    assert np.array_equal(ours.observations[:, columns], theirs.observations)
    moved = result.answers.displacements
    still = [c for c in range(moved.shape[1]) if c not in columns]
    assert not moved[:, still].any()
    if form != "mixed":  # whose further numbers the student sees
        assert result.student.to_bytes({})[-400:] == plain.student.to_bytes({})[-400:]
        assert result.evaluation == plain.evaluation

    # A student takes what the environment gives, one or many, and flat rows.
    rows = ours.observations[:4]
    layout = layout_of(OBSERVATIONS[form].space, "observations")
    many = result.student.predict(layout.values(rows))[0]
    assert np.allclose(many, result.student.predict(rows)[0], atol=1e-6)
    one = result.student.predict(layout.value(rows[0].astype(np.float64)))[0]
    assert np.allclose(one, many[0], atol=1e-5)
    again = fdtasil.evaluate(
        result.student, in_form(law, form), lambda: InForm(form), episodes=2, horizon=20
    )
    assert again.student_returns == pytest.approx(result.evaluation.student_returns)

    result.save(tmp_path / "run")
    read = Distilled.load(tmp_path / "run")
    assert np.array_equal(read.student.predict(layout.values(rows))[0], many)
    assert read.dataset.spaces == result.dataset.spaces
    judged = fdtasil.evaluate(
        str(tmp_path / "run" / "student.onnx"),
        in_form(law, form),
        lambda: InForm(form),
        episodes=2,
        horizon=20,
    )
    assert judged.student_returns == pytest.approx(result.evaluation.student_returns, rel=1e-4)


def _numbers_of(form):
    """The columns of the plain observation, in its order, in a form's flat one."""
    layout = layout_of(OBSERVATIONS[form].space, "observations")
    probe = np.arange(1.0, 6.0)
    flat = layout.row(OBSERVATIONS[form].of(probe))
    names = [p.name for p in layout.parts if p.kind == "number"]
    allowed = [c for name in names for c in layout.columns(name)] if names != [""] else range(5)
    return [next(c for c in allowed if flat[c] == value) for value in probe]


@pytest.mark.parametrize("form", ["dictionary", "nested", "mixed", "tuple"])
def test_an_onnx_file_with_one_input_a_key(form, tmp_path):
    result = distilled(form)
    session = onnxruntime.InferenceSession(result.export(tmp_path / "s.onnx", inputs="keys"))
    rows = result.demonstrations.observations[:4]
    layout = layout_of(OBSERVATIONS[form].space, "observations")
    kinds = {"tensor(float)": np.float32, "tensor(int64)": np.int64}
    feed = {}
    for entry, part, start in zip(session.get_inputs(), layout.parts, layout.starts, strict=True):
        assert entry.name == part.name
        value = part.values(rows[:, start : start + part.size])
        feed[entry.name] = value.astype(kinds[entry.type])
    (actions,) = session.run(None, feed)
    assert actions == pytest.approx(result.student.act(rows), abs=1e-5)
    # It is judged as it stands, choices among its inputs included.
    again = fdtasil.evaluate(
        str(tmp_path / "s.onnx"), in_form(law, form), lambda: InForm(form), episodes=2, horizon=20
    )
    returns = result.evaluation.student_returns
    assert again.student_returns == pytest.approx(returns, rel=1e-4)


def test_keys_of_observations_without_names(plain, tmp_path):
    with pytest.raises(fdtasil.FdtasilError, match="that have none"):
        plain.export(tmp_path / "s.onnx", inputs="keys")
    with pytest.raises(SettingError, match="keys"):
        plain.export(tmp_path / "s.c", inputs="keys")


@pytest.mark.parametrize("done", ["column", "dictionary"])
def test_actions_of_another_form(done, plain):
    result = distilled(done=done)
    assert np.array_equal(result.demonstrations.observations, plain.demonstrations.observations)
    assert result.evaluation == plain.evaluation
    space = ACTIONS[done].space
    assert space.contains(result.student.predict(np.zeros(5, np.float32))[0])


@pytest.mark.parametrize("trainer", ["dagger", "dart", "noise"])
@pytest.mark.parametrize("probes", ["fresh:2", "sphere:2,central", 0])
def test_every_trainer_on_a_dictionary(trainer, probes):
    fast = {"fit": fdtasil.Fit(epochs=3), "episodes": 3, "horizon": 10}
    result = distilled("nested", probes=probes, trainer=trainer, **fast)
    assert result.evaluation is not None


def test_the_student_sees_parts_by_name():
    result = distilled("dictionary", student_obs=["speed", "place"])  # in no order
    assert result.student.observation_size == 4
    assert result.student.spaces.observations.names == ("place", "speed")
    seen = {"place": np.zeros(2), "speed": np.ones(2)}
    flat = result.student.predict(np.array([0, 0, 1, 1], np.float32))[0]
    assert result.student.predict(seen)[0] == pytest.approx(flat)
    assert distilled("nested", student_obs="robot").student.observation_size == 4
    with pytest.raises(SettingError, match="names of parts of the observation: place"):
        distilled("dictionary", student_obs=["plaice"])


class OnDictionaries(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.first = torch.nn.Linear(2, 2)
        for numbers in self.first.parameters():
            torch.nn.init.constant_(numbers, -0.3)

    def forward(self, observations):
        return torch.tanh(self.first(observations["place"]) - observations["speed"])


def test_a_torch_module_takes_the_environments_own_form():
    with torch.random.fork_rng():
        module = OnDictionaries()
    environment = lambda: InForm("dictionary")  # noqa: E731
    analytic, asked = (
        fdtasil.distill(module, environment, probes, **QUICK, progress=False)
        for probes in ("jacobian", "basis")
    )
    assert analytic.answers.values.shape[3] == 2
    assert asked.evaluation.student_return == pytest.approx(
        analytic.evaluation.student_return, rel=0.2
    )
    # Few multiply-adds: asked anew at every step.
    small = {**QUICK, "horizon": 5, "episodes": 1, "fit": fdtasil.Fit(steps=5)}
    assert fdtasil.distill(module, environment, **small).report["probes"].startswith("adaptive:10")


def test_a_stable_baselines3_agent_on_dictionaries():
    kind = {"policy": "MultiInputPolicy", "n_steps": 8, "batch_size": 8}
    agent = fresh_agent("PPO", InForm("dictionary"), {}, **kind)
    result = fdtasil.distill(agent, lambda: InForm("dictionary"), 2, force=True, **QUICK)
    rows = result.demonstrations.observations
    layout = layout_of(OBSERVATIONS["dictionary"].space, "observations")
    expected = agent.predict(layout.values(rows), deterministic=True)[0]
    assert result.demonstrations.actions == pytest.approx(expected, abs=1e-5)


def test_resuming_needs_the_same_spaces(tmp_path):
    def stop(event):
        if event.kind == "round" and event.round == 0:
            raise KeyboardInterrupt

    again = {"trainer": "dagger", "episodes": 2}
    with pytest.raises(KeyboardInterrupt):
        distilled("dictionary", out=tmp_path / "a", callback=stop, **again)
    with pytest.raises(SettingError):
        distilled("tuple", resume=tmp_path / "a", **again)
    resumed = distilled("dictionary", resume=tmp_path / "a", **again)
    whole = distilled("dictionary", **again)
    assert resumed.dataset.to_bytes() == whole.dataset.to_bytes()
    assert resumed.student.to_bytes() == whole.student.to_bytes()


@pytest.mark.fault(214)
@pytest.mark.parametrize(
    "space",
    [
        Discrete(1),
        Text(3),
        Sequence(Box(-1, 1, (2,))),
        Box(-1, 1, (0,)),
        Dict(x=Box(-1, 1, (2,)), y=Text(3)),
        Dict({"a/b": Box(-1, 1, (2,))}),
    ],
)
@pytest.mark.parametrize("role", ["observation", "action"])
def test_spaces_without_a_flat_form_are_refused(space, role):
    class Odd(InForm):
        def __init__(self):
            super().__init__()
            setattr(self, f"{role}_space", space)

    with pytest.raises(EnvironmentFault, match=f"{role}s "):
        fdtasil.distill(law, Odd, 0, **QUICK)


@pytest.mark.fault(213)
@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda x: {"place": x["place"]}, "nothing for '"),
        (lambda x: {**x, "place": np.zeros(3)}, r"'place' of the shape \(3,\), where \(2,\)"),
        (lambda x: x["place"], "a ndarray, where '"),
        (lambda x: {**x, "speed": np.array(["a", "b"])}, "'speed' of <U1"),
        (lambda x: {**x, "speed": np.array([0, np.nan])}, "not finite"),
    ],
)
def test_an_observation_that_breaks_its_promise(change, found):
    class Breaks(InForm):
        def step(self, action):
            observation, *rest = super().step(action)
            return change(observation), *rest

    with pytest.raises(EnvironmentFault, match=found):
        fdtasil.distill(in_form(law, "dictionary"), lambda: Breaks("dictionary"), 0, **QUICK)


@pytest.mark.fault(215)
@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (lambda x: np.zeros((len(x["place"]), 3)), "the shape"),
        (lambda x: {"left": np.zeros((len(x["place"]), 1))}, "nothing for 'right'"),
    ],
)
def test_an_expert_that_answers_in_another_form(answer, found):
    with pytest.raises(ExpertError, match=found):
        fdtasil.distill(answer, lambda: InForm("dictionary", "dictionary"), 0, **QUICK)


def test_workers_are_not_sent_dictionaries():
    slow = fdtasil.load_expert(in_form(law, "dictionary"), workers=1)
    with pytest.raises(ExpertError, match="workers"):
        fdtasil.distill(slow, lambda: InForm("dictionary"), 0, **QUICK)


def test_a_file_with_spaces_that_are_none(plain):
    good = Spaces(layout_of(Box(-1, 1, (2,)), ""), layout_of(Discrete(3), "actions")).to_json()
    assert Spaces.from_json(good).actions.choices == ((0, 3),)
    for change in (
        {"kind": "soul"},
        {"sizes": [0]},
        {"sizes": [3, 3]},
        {"first": []},
        {"dtype": "O"},
        {"shape": [2]},
    ):
        with pytest.raises((ValueError, TypeError)):
            Spaces.from_json({**good, "actions": [{**good["actions"][0], **change}]})


def test_reset_options_and_kwargs():
    made = fdtasil.Environment(InForm, reset_options={"at": [0.5, -0.5]})
    result = fdtasil.distill(law, made, 0, **QUICK)
    first = result.demonstrations.observations[0, :2]
    assert first == pytest.approx([0.5, -0.5])
    moon = fdtasil.Environment("Pendulum-v1", kwargs={"g": 1.0})
    lazy = lambda rows: np.zeros((len(rows), 1))  # noqa: E731
    returns = [
        fdtasil.evaluate(lazy, lazy, env, episodes=2, horizon=50).student_return
        for env in (moon, "Pendulum-v1")
    ]
    assert returns[0] > returns[1]
    for wrong in ({"kwargs": {"a": 1}}, {"num_envs": 2}):
        with pytest.raises(SettingError):
            fdtasil.Environment(InForm, **wrong)
    with pytest.raises(SettingError, match="reset_options"):
        fdtasil.Environment("Pendulum-v1", reset_options=3)


def test_clip_action_hides_no_bounds():
    clipped = lambda: gymnasium.wrappers.ClipAction(InForm())  # noqa: E731
    result = fdtasil.distill(law, clipped, 3, **QUICK)
    assert result.student.high.tolist() == [1.0, 1.0]


def keyed_onnx(path, sizes):
    """A file with an input for each key, whose actions are the law of all of them."""
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape])
        for name, shape in sizes.items()
    ]
    weights = [
        numpy_helper.from_array(GAIN.T.copy(), "gain"),
        numpy_helper.from_array(np.array([-1, 5]), "flat"),
        numpy_helper.from_array(np.float32(-1), "low"),
        numpy_helper.from_array(np.float32(1), "high"),
    ]
    nodes = [
        helper.make_node("Concat", list(sizes), ["joined"], axis=1),
        helper.make_node("Reshape", ["joined", "flat"], ["row"]),
        helper.make_node("MatMul", ["row", "gain"], ["force"]),
        helper.make_node("Clip", ["force", "low", "high"], ["actions"]),
    ]
    outputs = [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["batch", 2])]
    graph = helper.make_graph(nodes, "keyed", inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, path)
    return str(path)


@pytest.mark.parametrize(
    ("form", "sizes"),
    [
        ("dictionary", {"place": (2,), "speed": (2,), "rest": (1,)}),
        ("row", {"frames": (1, 5)}),
        ("box", {"frames": (1, 5)}),
        ("nested", {"robot": (4,), "goal": (1,)}),
    ],
)
def test_inputs_of_a_file_are_found_by_name_and_shape(form, sizes, plain, tmp_path):
    path = keyed_onnx(tmp_path / "keys.onnx", sizes)
    result = fdtasil.distill(path, lambda: InForm(form), 3, **QUICK, progress=False)
    assert result.demonstrations.actions == pytest.approx(plain.demonstrations.actions, abs=1e-5)
    assert result.evaluation.expert_return == pytest.approx(plain.evaluation.expert_return)


def test_inputs_that_no_key_has_are_asked_for(tmp_path):
    path = keyed_onnx(tmp_path / "keys.onnx", {"place": (2,), "pace": (2,), "peace": (1,)})
    with pytest.raises(fdtasil.FdtasilError, match="'pace' and 'peace'"):
        fdtasil.distill(path, lambda: InForm("dictionary"), 3, **QUICK)


@pytest.mark.parametrize("third", ["choice_0", "actions"])
def test_names_that_a_graph_has_itself(third, tmp_path):
    """A part may be called as an input, an output or a node of the file is."""

    class Named(InForm):
        def __init__(self):
            super().__init__()
            names = ("obs", third, "constant_0", "scores", "value_1")
            self.names = names
            self.observation_space = Dict({name: Box(-9, 9, (1,)) for name in names})

        def reset(self, **given):
            row, info = super().reset(**given)
            return {name: row[i : i + 1] for i, name in enumerate(self.names)}, info

        def step(self, action):
            row, *rest = super().step(action)
            return {name: row[i : i + 1] for i, name in enumerate(self.names)}, *rest

    def expert(parts):
        return law(np.concatenate([parts[name] for name in Named().names], axis=1))

    result = fdtasil.distill(expert, Named, 2, **QUICK)
    if third == "actions":  # which is the output's
        with pytest.raises(ExportError, match="'actions'"):
            result.export(tmp_path / "s.onnx", inputs="keys")
        return
    path = result.export(tmp_path / "s.onnx", inputs="keys")
    rows = result.demonstrations.observations[:3]
    session = onnxruntime.InferenceSession(path)
    layout = layout_of(Named().observation_space, "observations")
    feed = {name: rows[:, list(layout.columns(name))] for name in layout.names}
    assert session.run(None, feed)[0] == pytest.approx(result.student.act(rows), abs=1e-5)


def test_an_answer_in_a_row_is_taken_for_any_shape():
    module = torch.nn.Linear(5, 2, device="meta").to_empty(device="cpu")
    module.load_state_dict({"weight": torch.from_numpy(GAIN), "bias": torch.zeros(2)})
    result = fdtasil.distill(module, lambda: InForm("box", "column"), 2, force=True, **QUICK)
    judged = fdtasil.evaluate(
        result.student, module, lambda: InForm("box", "column"), episodes=2, horizon=20, force=True
    )
    assert judged.student_returns == pytest.approx(result.evaluation.student_returns)


def test_what_nests_in_no_space():
    part = layout_of(Box(-1, 1, (2,)), "observations").to_json()[0]
    for paths in ([["a"], []], [["a"], [0]], [[1]], [["a", "b"], ["a"]], [["a"], ["a"]]):
        with pytest.raises(ValueError, match="no parts"):
            Layout.from_json([{**part, "path": path} for path in paths])
    with pytest.raises(ValueError, match="no parts"):
        Layout.from_json([{**part, "shape": [2**32, 2**32]}])
    assert Layout.from_json([{**part, "path": [0]}, {**part, "path": [1]}]).size == 4
    with pytest.raises(EnvironmentFault, match="key 0"):
        fdtasil.distill(law, lambda: _numbered(), 0, **QUICK)


def _numbered():
    environment = InForm()
    environment.observation_space = Dict({0: Box(-1, 1, (2,)), 1: Box(-1, 1, (3,))})
    return environment


def test_one_key_and_flat_rows_and_none():
    layout = layout_of(Dict(obs=Box(-1, 1, (3,))), "observations")
    for given in (np.zeros(3), {"obs": np.zeros(3)}):
        assert layout.read(given)[1]
    assert not layout.read(np.zeros((2, 3)))[1]
    frames = layout_of(Box(-1, 1, (2, 3)), "observations")
    assert frames.rows(np.zeros((0, 2, 3))).shape == (0, 6)


def test_what_was_made_and_is_refused_is_closed():
    closed = []

    class Odd(InForm):
        def __init__(self):
            super().__init__()
            self.observation_space = Text(3)

        def close(self):
            closed.append(self)

    with pytest.raises(EnvironmentFault):
        fdtasil.distill(law, Odd, 0, **QUICK)
    assert len(closed) == 1


def test_an_expert_that_is_called_wrongly_is_told_what_it_is_given():
    with pytest.raises(ExpertError, match=r"place \(B, 2\), speed \(B, 2\)|rest \(B, 1\)"):
        fdtasil.distill(lambda rows: rows[:, :2], lambda: InForm("dictionary"), 0, **QUICK)
    with pytest.raises(ExpertError, match=r"with shape \(16, 1, 2\); .* \(B, 1, 5\)"):
        fdtasil.distill(lambda rows: rows[..., :2], lambda: InForm("row"), 0, **QUICK)


def test_a_result_is_judged_as_it_is():
    result = distilled("dictionary", student_obs=["place", "speed"])
    expert, env = in_form(law, "dictionary"), lambda: InForm("dictionary")
    judged = fdtasil.evaluate(result, expert, env, episodes=2, horizon=20)
    assert judged.student_returns == pytest.approx(result.evaluation.student_returns)


@pytest.mark.fault(348)
def test_clip_action_hides_no_bounds_of_a_matrix():
    class Matrix(InForm):
        def __init__(self):
            super().__init__()
            self.action_space = gymnasium.spaces.Box(-0.5, 0.5, (2, 1), np.float32)

        def step(self, action):
            return super().step(np.asarray(action).reshape(2))

    with EnvironmentPool(lambda: gymnasium.wrappers.ClipAction(Matrix())) as pool:
        assert pool.boxes.low.tolist() == [-0.5, -0.5]
        assert pool.boxes.high.tolist() == [0.5, 0.5]
