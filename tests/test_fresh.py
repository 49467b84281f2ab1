"""Experts that are asked anew at every visit, and who is asked so where nobody says it."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from onnx import TensorProto
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.cost import CHEAP, multiply_adds
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.calibration import calibrate
from fdtasil.probes.device_twin import DeviceTwin
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.spread import Spread, stands_still
from fdtasil.probes.surroundings import Surroundings
from fdtasil.results.summary import call_of
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import episode_seeds
from fdtasil.student.fit import Fit

pytestmark = pytest.mark.usefixtures("no_pictures")


def linear(rows):
    return rows @ GAIN.T


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx", sizes=(5, 16, 16, 2))


# --- asking


def test_no_query_is_asked_twice_and_all_are_as_predicted():
    asked = []

    def noting(rows):
        asked.append(rows.copy())
        return linear(rows)

    result = fdtasil.distill(noting, TOY, "fresh", **{**QUICK, "fit": Fit(steps=40)})
    assert result.queries == result.report["predicted_queries"]
    assert result.queries["probe"] == 4 * 400  # forty states, ten visits a sample
    rows = np.concatenate(asked)
    assert len(np.unique(rows[-1600 - 40 : -40], axis=0)) > 1500
    assert result.report["radius"] == [0.2, 2.0]


@pytest.mark.parametrize("trainer", ["dagger", "dart"])
@pytest.mark.parametrize("order", [1, 2])
def test_every_trainer_and_order_asks_anew(trainer, order):
    settings = {**QUICK, "episodes": 3, "fit": Fit(steps=30, order=order), "trainer": trainer}
    result = fdtasil.distill(linear, TOY, "fresh", student_obs=[0, 1, 2, 3], **settings)
    assert result.queries == result.report["predicted_queries"]
    last = result.history[-1]
    assert last["moved_error"] > 0
    assert (last["derivative_error"] > 0) == (order == 2)
    assert (last["curvature_error"] > 0) == (order == 2)


def test_an_expert_of_steps_is_not_asked_where_it_says_nothing():
    random = np.random.default_rng(1)
    states = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    scales, source = measure_scales(states), Probes.parse("fresh,whitened")
    found = {}
    for name, answer in {
        "smooth": linear,
        "noisy": lambda rows: linear(rows) + 0.1 * random.standard_normal((len(rows), 2)),
        "steps": lambda rows: np.sign(linear(rows)),
    }.items():
        expert = fdtasil.load_expert(answer, 5, 2)
        ladder = calibrate(expert, states, scales, np.random.default_rng(0), 0.3)
        found[name] = ladder.complete(source).radius
    assert found["smooth"] == (0.2, 2.0)
    assert found["steps"] == (0.5, 2.0)
    assert 0.2 < found["noisy"][0] <= 1
    assert found["noisy"][1] == 2.0


@pytest.mark.fault(203)
def test_a_steep_law_is_held_to_labels_too():
    """A swing-up that ends at rest: most states lie near it, and their deviation is large."""
    random = np.random.default_rng(0)
    states = (0.002 * random.standard_normal((500, 3))).astype(np.float32)
    states[:50] = random.standard_normal((50, 3))

    def stiff(rows):
        return np.clip(-100 * rows[:, :1] - 50 * rows[:, 1:2], -2, 2)

    found = {}
    for name, law in {"stiff": stiff, "soft": lambda rows: stiff(rows / 1000)}.items():
        expert = fdtasil.load_expert(law, 3, 1)
        ladder = calibrate(expert, states, measure_scales(states), np.random.default_rng(0), 0.3)
        source = Probes.parse("10,whitened,per_step=1")
        found[name] = ladder.complete(source).match
        assert ladder.complete(Probes.parse("10,differences,whitened")).match == "differences"
    assert found == {"stiff": "both", "soft": None}


# --- who is asked anew


def test_what_is_cheap_follows_from_kind_and_size(expert, tmp_path):
    with torch.random.fork_rng():
        narrow = torch.nn.Linear(5, 2)
        wide = torch.nn.Sequential(torch.nn.Linear(5, 1024), torch.nn.Linear(1024, 1024))

    class Planner(torch.nn.Module):
        """Small, and takes thousands of operations."""

        def forward(self, rows):
            for _ in range(1000):
                rows = rows + 1
            return rows[:, :2]

    experts = {
        "onnx": (expert, 5 * 16 + 16 * 16 + 16 * 2, True),
        "reshaped": (mlp_onnx(tmp_path / "odd.onnx", reshape_to=[-1, 5]), None, None),
        "double": (mlp_onnx(tmp_path / "d.onnx", kind=TensorProto.DOUBLE), 5 * 8 + 8 * 2, True),
        "module": (narrow, 10, True),
        "wide": (wide, 2**20, False),
        "planner": (Planner(), None, None),
        "function": (linear, None, None),
    }
    for name, (source, least, cheap) in experts.items():
        found = multiply_adds(fdtasil.load_expert(source, 5), 5)
        if least is None:
            assert found is None, name
            continue
        assert least <= found <= least + 10_000, name
        assert (found <= CHEAP) == cheap, name
    for how in ({"workers": 2, "threads": True}, {"batch": 1}):
        assert multiply_adds(fdtasil.load_expert(expert, 5, **how), 5) is None


@pytest.mark.parametrize(
    ("change", "anew", "said"),
    [
        ({}, True, "asked anew all the time: 403 multiply-adds a query"),
        ({"max_queries": 2500}, False, "are more than max_queries"),
        ({"preset": "paper", "fit": Fit(steps=3)}, False, None),
        ({"probes": 10}, False, None),
        ({"probes": "fresh"}, True, None),
    ],
)
def test_the_default_says_what_it_takes(change, anew, said, expert):
    result = fdtasil.distill(expert, TOY, **{**QUICK, **change})
    assert ("resample" in result.report["probes"]) == anew
    reason = result.report["probes_chosen"]
    assert reason is None if said is None else said in reason
    assert result.report["steps"] == result.settings["fit"]["steps"]


def test_the_default_of_a_function_is_asked_once():
    result = fdtasil.distill(linear, TOY, **QUICK)
    assert result.report["probes"].startswith("adaptive:10,")
    assert result.report["probes_chosen"] == "asked once: what a query costs is not known"


def test_a_run_that_was_asked_anew_is_learnt_from_again(expert):
    """With the expert anew; without it from the answers that are stored."""
    first = fdtasil.distill(expert, TOY, **QUICK)
    alone = fdtasil.distill(dataset=first.dataset, student=QUICK["student"], fit=QUICK["fit"])
    assert alone.queries == dict.fromkeys(alone.queries, 0)
    assert alone.history[-1]["moved_error"] > 0
    shape = {name: QUICK[name] for name in ("horizon", "student", "fit", "evaluation_episodes")}
    again = fdtasil.distill(expert, TOY, dataset=first.dataset, **shape)
    assert again.queries["probe"] == first.queries["probe"]


def test_longer_and_faster_where_answers_are_new():
    usual, anew = (Fit().schedule(anew=anew) for anew in (False, True))
    assert [anew.total_steps(n) for n in (1, 5_000, 20_000)] == [12_000, 12_000, 24_000]
    assert (usual.learning_rate, anew.learning_rate) == (1e-3, 4e-3)
    said = Fit(steps=7, batch_size=3, learning_rate=0.5).schedule(anew=True)
    assert (said.total_steps(10**6), said.batch_size, said.learning_rate) == (7, 3, 0.5)


# --- coordinates that stand still


class Commanded(Integrator):
    """The velocities are to be those of a command, one for each episode."""

    def __init__(self):
        super().__init__(wall=np.inf)
        ends = np.array([np.inf] * 4 + [1.0])
        self.observation_space = gymnasium.spaces.Box(-ends, ends, (5,), np.float64)

    def reset(self, *, seed=None, options=None):
        observation, about = super().reset(seed=seed, options=options)
        self.command = self.np_random.uniform(-1, 1)
        return np.concatenate([observation[:4], [self.command]]), about

    def step(self, action):
        observation, _, _, cut, about = super().step(action)
        reward = 1 - np.abs(self.velocity - self.command).mean()
        return np.concatenate([observation[:4], [self.command]]), reward, False, cut, about


def follows(rows):
    return np.tanh(3 * (rows[:, 4:] - rows[:, 2:4]))


COMMANDED = {
    "episodes": 1,
    "horizon": 40,
    "student": fdtasil.Mlp(32),
    "fit": Fit(steps=600),
    "evaluation_episodes": 10,
}


@pytest.mark.slow
@pytest.mark.fault(297)
@pytest.mark.parametrize("probes", [0, 3, "fresh:3"])
@pytest.mark.parametrize("spread", [{4: 0.58}, "bounds"])
def test_a_dataset_keeps_the_deviations_that_were_said(spread, probes, tmp_path):
    run = {"fit": fdtasil.Fit(steps=30), "student": fdtasil.Mlp(8), "progress": False}
    recorded = {"episodes": 1, "horizon": 20, "evaluation_episodes": 2}
    first = fdtasil.distill(follows, Commanded, probes, spread=spread, **recorded, **run)
    first.save(tmp_path / "run")
    assert first.dataset.spread.to_json() == first.settings["spread"]
    again = {"dataset": tmp_path / "run", "horizon": 20, "evaluation_episodes": 2}
    for said in ({}, {"spread": spread}):
        # The probes too: what was asked once and what is asked anew are answered alike.
        same = fdtasil.distill(follows, Commanded, probes, **again, **said, **run)
        assert same.settings["spread"] == first.settings["spread"]
        assert same.student.to_bytes() == first.student.to_bytes()
    assert same.evaluation == first.evaluation
    with pytest.warns(FdtasilWarning, match="no student of 1"):  # after 30 steps
        shrunk = fdtasil.shrink(
            first,
            follows,
            Commanded,
            sizes=[8],
            cloned=False,
            evaluation_episodes=2,
            keep=0.01,
            fit=run["fit"],
            progress=False,
        )
    assert shrunk.candidates[0].normalized_return is not None
    if probes == 3:
        with pytest.raises(SettingError, match="spread= with answers that are stored"):
            fdtasil.distill(follows, Commanded, **again, spread={4: 0.1}, **run)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [{4: 0.58}, "4:0.58", "bounds"])
def test_one_demonstration_teaches_every_command(spread):
    result = fdtasil.distill(follows, Commanded, "fresh", spread=spread, **COMMANDED)
    said = result.settings["spread"]
    assert (said["bounds"] if spread == "bounds" else said) == {"4": pytest.approx(0.58, abs=0.01)}
    assert not result.report["warnings"]
    assert result.evaluation.normalized_return > 0.9


def test_bounds_are_of_coordinates_that_stand_still_within_an_episode():
    """A place; commands, one of which hardly varies; without ends; a constant; drifts."""
    episode = np.repeat(np.arange(4), 50)
    states = np.random.default_rng(0).standard_normal((200, 7))
    states[:, 1] = np.array([-1.0, 0.2, 0.5, 3.0])[episode]
    states[:, 2] = 1e-4 * states[:, 2] + episode
    states[:, 3], states[:, 4], states[:, 5] = episode, 7, 0.015 * states[:, 5] + episode
    states[50:, 6] = episode[50:]
    low, high = np.array([[-6, -6, -12, -np.inf, 7, 0, -9], [6, 6, 12, np.inf, 7, 3, 9]])
    told = Spread.of("bounds", low, high, 7).among(states, episode)
    assert told == pytest.approx({1: 12 / 12**0.5, 2: 24 / 12**0.5})
    assert stands_still(states, episode).tolist() == [False, True, True, True, *[False] * 3]


@pytest.mark.fault(204)
def test_coordinates_that_stand_still_are_named():
    with pytest.warns(fdtasil.FdtasilWarning, match=r"spread=\{4: 0\.\d+\}"):
        result = fdtasil.distill(follows, Commanded, "fresh", **COMMANDED)
    assert result.evaluation.normalized_return < 0.7


def test_what_was_told_of_is_moved_alone_too():
    states = np.random.default_rng(0).standard_normal((400, 5)).astype(np.float32)
    states[:, 4] = 1
    scales = measure_scales(states).spread_by({4: 0.5})
    source = Probes.parse("sphere:10,radius=1,whitened,forward")
    moved = Surroundings.of(states, source, scales).sample(np.random.default_rng(0)).displacements
    alone = (moved[:, :4] == 0).all(axis=1)
    rest = moved[:, 4] == 0
    assert alone.mean() == pytest.approx(0.25, abs=0.03)
    assert rest.mean() == pytest.approx(0.25, abs=0.03)
    assert moved[alone, 4].std() == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    "spread",
    ["far", "1:2:3", "1:2,1:3", "4:", {5: 1.0}, {"command": 1.0}, {0: 0.0}, {0: "a"}, [0.5], 3],
)
def test_a_wrong_spread_is_refused(spread):
    with pytest.raises(SettingError, match="next step"):
        fdtasil.distill(linear, TOY, "fresh", spread=spread, **QUICK)


# --- demonstrations that fell


class Falling(Integrator):
    """Every third start ends after five steps."""

    def reset(self, *, seed=None, options=None):
        self.count, self.falls = 0, seed is not None and seed % 3 == 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, _, cut, about = super().step(action)
        self.count += 1
        return observation, reward, self.falls and self.count == 5, cut, about


@pytest.fixture
def seed():
    """Of a run whose first demonstration falls."""
    return next(s for s in range(50) if episode_seeds(s, "rollout", 0, 1)[0] % 3 == 0)


FALLING = {**QUICK, "episodes": 1, "horizon": 20, "evaluation_episodes": 20, "probes": 0}


def test_a_demonstration_that_fell_is_replaced(seed):
    kept = fdtasil.distill(linear, Falling, keep="survivors", seed=seed, **FALLING)
    assert not kept.demonstrations.terminated.any()
    assert len(kept.demonstrations) == 20
    assert kept.report["replaced_episodes"] >= 1
    assert kept.queries["act"] == 5 + 20 + 5 * (kept.report["replaced_episodes"] - 1)
    assert kept.queries["act"] <= kept.report["predicted_queries"]["act"]


@pytest.mark.fault(205)
def test_a_demonstration_that_fell_is_named(seed):
    share = r"1 of 1 demonstrations ended early, after 5 of 20 steps"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fdtasil.run.doubts._USUALLY", 0.5)
        with pytest.warns(fdtasil.FdtasilWarning, match=share):
            fdtasil.distill(linear, Falling, seed=seed, **FALLING)


def test_nothing_is_recorded_anew_of_a_given_dataset(expert):
    given = fdtasil.distill(linear, TOY, 0, **QUICK).dataset
    with pytest.raises(SettingError, match="given dataset"):
        fdtasil.distill(linear, TOY, dataset=given, keep="survivors")
    with pytest.raises(SettingError, match="keep="):
        fdtasil.distill(linear, TOY, keep="best", **QUICK)


# --- what a review found


def test_a_budget_that_is_another_does_not_change_what_is_asked(expert, tmp_path):
    """Begun with ten stored probes for want of queries, and gone on with so."""
    from test_resume import Stop, stop_at

    run = {**QUICK, "fit": Fit(steps=300)}
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path, callback=stop_at(1), max_queries=2500, **run)
    result = fdtasil.distill(expert, TOY, resume=tmp_path, **run)
    assert result.report["probes"].startswith("adaptive:10,forward,whitened")
    assert result.student.architecture == run["student"]


def test_short_episodes_do_not_ask_more_than_what_was_allowed(expert, tmp_path):
    """Fewer states are visited more often: what is chosen is held to the most that may be due."""
    run = {**QUICK, "episodes": 1, "horizon": 40, "fit": Fit(steps=200, batch_size=30)}
    full = fdtasil.distill(expert, TOY, **run)
    assert full.report["probes"].startswith("adaptive:10,forward,labels,resample")
    predicted = sum(full.report["predicted_queries"].values())
    held = fdtasil.distill(expert, TOY, max_queries=predicted, **run)
    assert "resample" not in held.report["probes"]


def test_answers_of_fresh_probes_are_used_as_they_are_if_so_is_asked_for(expert):
    first = fdtasil.distill(expert, TOY, "fresh", **QUICK)
    again = fdtasil.distill(dataset=first.dataset, probes="fresh", fit=QUICK["fit"])
    assert again.report["probes"] == first.report["probes"].replace(",resample", "")


def test_no_told_coordinate_is_moved_by_next_to_nothing():
    """Beside large values float32 would round such a step away, and the run would end."""
    states = np.random.default_rng(0).standard_normal((300, 5)).astype(np.float32)
    states[:, 4] = 1000
    scales = measure_scales(states).spread_by({4: 0.5})
    source = Probes.parse("fresh,radius=0.2..2,whitened").with_order(1)
    around = Surroundings.of(states, source, scales)
    for sample in range(60):
        drawn = around.sample(np.random.default_rng(sample)).displacements
        told = drawn[(drawn[:, :4] == 0).all(axis=1), 4]
        assert np.abs(told).min() > 0.09


def test_a_function_of_the_observation_keeps_its_own_scale():
    """A view of as many coordinates is not the observation itself."""
    run = {**QUICK, "student_obs": lambda rows: rows[:, ::-1] * 0.01, "probes": "3,forward"}
    told = fdtasil.distill(linear, TOY, spread={0: 50.0}, **run).student
    assert np.array_equal(told.scale, fdtasil.distill(linear, TOY, **run).student.scale)


@pytest.mark.parametrize("source", ["10,raw", "stored"])
def test_deviations_that_no_probe_is_moved_by_are_refused(source):
    stored = source == "stored"
    given = fdtasil.distill(linear, TOY, 3, **QUICK).dataset if stored else None
    shape = {name: QUICK[name] for name in ("fit", "student", "evaluation_episodes")}
    with pytest.raises(SettingError, match="spread= with"):
        fdtasil.distill(
            linear,
            TOY,
            None if stored else source,
            spread={0: 1.0},
            dataset=given,
            **(shape if stored else QUICK),
        )


@pytest.mark.parametrize(
    ("spec", "match"),
    [
        ("jacobian,radius=0.1..1", None),
        ("10,radius=0.3..0.3", None),
        ("10,radius=0.1..1", "labels"),
    ],
)
def test_many_distances_alone_make_labels(spec, match):
    assert Probes.parse(spec).with_order(1).match == match


class Module(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.from_numpy(GAIN))

    def forward(self, observations):
        """(B, 5) -> (B, 2)."""
        return observations @ self.weight.T


def fresh_around(states):
    preset = replace(PRESETS["standard"], calibrated=False)
    source = preset.complete(Probes.parse("fresh:3,radius=0.2..2")).with_order(1)
    return Surroundings.of(states, source, measure_scales(states))


@pytest.mark.parametrize("kind", ["file", "module"])
def test_a_twin_on_a_device_answers_as_the_expert_and_is_counted(kind, expert):
    states = np.random.default_rng(0).standard_normal((20, 5)).astype(np.float32)
    asked = load_expert(expert if kind == "file" else Module())
    around = fresh_around(states)
    said = ask_probes(asked, around, np.random.default_rng(0))
    twin = DeviceTwin.of(asked, around, said, torch.device("cpu"))
    assert asked.queries["probe"] == 60  # a comparison is no query
    ours = ask_probes(asked, around, np.random.default_rng(1), asked=twin.values)
    assert asked.queries["probe"] == 120
    theirs = ask_probes(asked, around, np.random.default_rng(1))
    assert np.array_equal(ours.displacements, theirs.displacements)
    assert ours.values == pytest.approx(theirs.values, abs=1e-5)


def test_a_twin_that_answers_otherwise_is_warned_of_and_not_used():
    states = np.random.default_rng(0).standard_normal((20, 5)).astype(np.float32)
    asked = load_expert(Module())
    around = fresh_around(states)
    said = ask_probes(asked, around, np.random.default_rng(0))
    other = replace(said, values=said.values + 0.01)
    with pytest.warns(fdtasil.FdtasilWarning, match="answers moved states otherwise"):
        assert DeviceTwin.of(asked, around, other, torch.device("cpu")) is None
    assert DeviceTwin.of(load_expert(linear), around, said, torch.device("cpu")) is None


def test_a_twin_that_is_infinite_is_named():
    states = np.random.default_rng(0).standard_normal((20, 5)).astype(np.float32)
    asked = load_expert(Module())
    around = fresh_around(states)
    said = ask_probes(asked, around, np.random.default_rng(0))
    twin = DeviceTwin.of(asked, around, said, torch.device("cpu"))
    with torch.no_grad():
        twin.module.weight[0] = torch.inf
    with pytest.raises(ExpertError, match="infinite on some of 60"):
        ask_probes(asked, around, np.random.default_rng(1), asked=twin.values)


@pytest.mark.fault(238)
def test_held_out_states_are_asked_about_once(expert):
    """So a budget that allows the run at the start allows its end."""
    fit = Fit(steps=300, validation=0.5)
    run = {**QUICK, "fit": fit, "evaluation_episodes": 0}
    result = fdtasil.distill(expert, TOY, "fresh", **run)
    assert result.queries == result.report["predicted_queries"]
    samples = -(-300 * 20 // 200)  # twenty states of one episode, ten visits a sample
    assert result.queries["probe"] == 400 + 200 * (samples - 1)


@pytest.mark.fault(239)
def test_fresh_is_asked_anew_beside_answers_of_fresh(expert):
    given = fdtasil.distill(expert, TOY, "fresh", **QUICK).dataset
    run = {"dataset": given, "fit": QUICK["fit"], "student": QUICK["student"]}
    usual = fdtasil.distill(expert, TOY, evaluation_episodes=0, **run)
    told = fdtasil.distill(expert, TOY, "fresh", evaluation_episodes=0, **run)
    assert usual.queries["probe"] == told.queries["probe"] == 1600
    assert usual.queries["calibrate"] == 0  # what was open is stored
    assert told.report["probes"] == usual.report["probes"] == given.probes.describe()


class Switches(torch.nn.Module):
    """A bang-bang law."""

    def forward(self, rows):
        return torch.sign(rows @ torch.from_numpy(GAIN).T)


@pytest.mark.parametrize("probes", [None, "sphere:4,resample"])
def test_another_source_than_fresh_is_asked_anew_too(probes, expert):
    """As it is stored: what a calibration found is not lost."""
    given = fdtasil.distill(Switches(), TOY, "sphere:4,resample", **QUICK).dataset
    assert given.probes.match == "both"
    again = fdtasil.distill(Switches(), TOY, probes, dataset=given, **QUICK)
    assert again.report["probes"] == given.probes.describe()
    assert again.queries["calibrate"] == 0
    assert again.queries["probe"] > 0


@pytest.mark.fault(240)
def test_a_weight_of_nothing_is_warned_of(expert):
    with pytest.warns(FdtasilWarning, match="weight=50 weighs nothing: 'adaptive:10"):
        fdtasil.distill(expert, TOY, "fresh", **{**QUICK, "fit": Fit(steps=20, weight=50)})
    run = {**QUICK, "fit": Fit(steps=20, moved_weight=2)}
    with pytest.warns(FdtasilWarning, match="moved_weight=2 weighs nothing"):
        fdtasil.distill(expert, TOY, "3,differences", **run)
    run = {**QUICK, "fit": Fit(steps=20, curvature_weight=3)}
    with pytest.warns(FdtasilWarning, match="curvature_weight=3 weighs nothing without order=2"):
        fdtasil.distill(expert, TOY, 3, **run)


@pytest.mark.fault(356)
def test_less_than_what_a_coordinate_shows_is_not_taken():
    with pytest.warns(FdtasilWarning, match=r"spread=\{0: 0\.001\} is less than"):
        narrow = fdtasil.distill(linear, TOY, 3, spread={0: 0.001}, **QUICK)
    told = fdtasil.distill(linear, TOY, 3, spread={0: 0.5}, **QUICK)
    own = narrow.dataset.demonstrations.observations[:, 0].std()
    assert narrow.student.scale[0].item() == pytest.approx(own, rel=1e-5)
    assert told.student.scale[0].item() == pytest.approx(max(own, 0.5), rel=1e-5)


@pytest.mark.fault(241)
@pytest.mark.parametrize("probes", [0, 3])
def test_a_spread_that_moves_nothing_is_refused(probes):
    with pytest.raises(SettingError, match="spread= of coordinate 4, which no probe moves"):
        fdtasil.distill(linear, TOY, probes, student_obs=[0, 1], spread={0: 1.0, 4: 2.0}, **QUICK)
    with pytest.raises(SettingError, match="spread= of coordinate 6"):
        fdtasil.distill(linear, TOY, probes, history=2, spread={6: 2.0}, **QUICK)


class Padded(Integrator):
    """Its last coordinate is padding."""

    def __init__(self):
        super().__init__()
        high = np.array([9, 9, 9, 9, 1], np.float32)
        low = np.array([-9, -9, -9, -9, 1], np.float32)
        self.observation_space = gymnasium.spaces.Box(low, high)


@pytest.mark.fault(242)
@pytest.mark.parametrize("probes", [0, "sphere:3", 3])
def test_bounds_of_padding_are_no_spread(probes):
    result = fdtasil.distill(linear, Padded, probes, spread="bounds", **QUICK)
    assert result.settings["spread"]["bounds"].keys() == {"0", "1", "2", "3"}
    assert np.isfinite(result.history[-1]["loss"])


def test_derivatives_are_not_asked_anew():
    assert Probes.parse("jacobian,resample") == Probes.parse("jacobian")


class Named(Integrator):
    """A dictionary of its observation's parts."""

    def __init__(self):
        super().__init__()
        box = gymnasium.spaces.Box
        sizes = {"constant": 1, "position": 2, "velocity": 2}
        self.observation_space = gymnasium.spaces.Dict(
            {name: box(-np.inf, np.inf, (size,)) for name, size in sizes.items()}
        )

    def _observe(self):
        names = {"constant": [3.0], "position": self.position, "velocity": self.velocity}
        return {name: np.asarray(part, np.float32) for name, part in names.items()}


@pytest.mark.parametrize(
    "spread",
    [
        {"constant": 0.5, 1: 2.0},
        "constant:0.5, 1:2.0",
        "{'constant': 0.5, 1: 2.0}",
        '{"constant": 0.5, "1": 2.0}',
    ],
)
def test_a_spread_of_a_part_is_said_by_its_name(spread):
    law = lambda seen: -0.3 * (seen["position"] + seen["velocity"])  # noqa: E731
    result = fdtasil.distill(law, Named, 3, spread=spread, **QUICK)
    assert result.settings["spread"] == {"0": 0.5, "1": 2.0}
    with pytest.raises(SettingError, match="a coordinate twice"):
        fdtasil.distill(law, Named, 3, spread={"position": 3.0, 1: 0.1}, **QUICK)
    with pytest.raises(SettingError, match=r"(?s)goal': 1.0.*constant, position, velocity"):
        fdtasil.distill(law, Named, 3, spread={"goal": 1.0}, **QUICK)


def test_a_budget_says_how_many_probes_fit():
    source = "sphere:{},forward,raw,radius=0.1"
    with pytest.raises(SettingError, match="7 probes fit; or lower episodes"):
        fdtasil.distill(linear, TOY, source.format(9), max_queries=800, **QUICK)
    fdtasil.distill(linear, TOY, source.format(7), max_queries=800, **QUICK)
    with pytest.raises(SettingError, match="7 probes fit"):
        fdtasil.distill(linear, TOY, source.format(8), max_queries=800, **QUICK)
    with pytest.raises(SettingError, match="batch=16"):  # most of it is the gate's large batch
        fdtasil.distill(linear, TOY, source.format(9), max_queries=200, **QUICK)
    few = fdtasil.load_expert(linear, batch=16)
    with pytest.raises(SettingError) as caught:
        fdtasil.distill(few, TOY, source.format(9), max_queries=200, **QUICK)
    assert "batch=16" not in caught.value.next_step


@pytest.mark.fault(297)
def test_said_deviations_stay_where_probes_go_as_far():
    run = {"fit": fdtasil.Fit(steps=5), "student": fdtasil.Mlp(4), "progress": False}
    recorded = {"episodes": 1, "horizon": 20, "evaluation_episodes": 0}
    first = fdtasil.distill(follows, Commanded, 2, spread={4: 0.58}, **recorded, **run)
    for probes, kept in ((3, {"4": 0.58}), ("3,raw,radius=0.01", None)):
        with pytest.warns(FdtasilWarning, match="are not used"):
            again = fdtasil.distill(follows, None, probes, dataset=first.dataset, **run)
        assert again.dataset.spread.to_json() == kept
    with (
        pytest.warns(FdtasilWarning, match="are not used"),
        pytest.raises(SettingError, match="which no probe moves"),
    ):
        fdtasil.distill(follows, None, 3, dataset=first.dataset, student_obs=[0, 1], **run)
    bounds = fdtasil.distill(follows, Commanded, 0, spread="bounds", **recorded, **run).dataset
    alone = fdtasil.distill(None, None, 0, dataset=bounds, **run)
    assert "spread" not in call_of(alone.settings, 1)
