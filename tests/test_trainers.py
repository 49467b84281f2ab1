"""Who acts in round i."""

import functools
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY
from toy_environments import Integrator

import fdtasil
from fdtasil.demonstrations.trainers import (
    TRAINERS,
    DAgger,
    Dart,
    NoisyExpert,
    Situation,
    describe_trainer,
    trainer_of,
)
from fdtasil.errors import FdtasilWarning, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.results.summary import call_of
from fdtasil.rollouts.behaviours import Decision
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout

HALF = np.array([1.0, 2.0], np.float32)
ROWS = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 5)).astype(np.float32)


def linear(rows):
    return rows @ GAIN.T


def off_by(error):
    return lambda rows: (rows @ GAIN.T + error).astype(np.float32)


def decide(trainer, round_, student, rows=ROWS, chooses=False):
    with EnvironmentPool(TOY) as pool:
        expert = load_expert(linear, 5, 2)

        def record(behaviour, count):
            noise = [np.random.default_rng(e) for e in range(count)]
            return rollout(behaviour, pool, range(count), 20, noise)

        situation = Situation(round_, expert, HALF, student, record, chooses)
        behaviour = trainer.behaviour(situation)
        asked = dict(expert.queries)
        decision = behaviour(rows, [np.random.default_rng(e) for e in range(len(rows))])
    return decision, asked


@pytest.mark.parametrize("name", TRAINERS)
@pytest.mark.parametrize("episodes", [1, 2, 5, 7, 31, 100])
def test_rounds_add_up_to_the_budget(name, episodes):
    trainer = trainer_of(name)
    rounds = trainer.rounds(episodes)
    assert sum(rounds) == episodes
    assert min(rounds) > 0
    assert sum(trainer.queries(episodes, 10).values()) >= 10 * episodes


def test_the_papers_rounds():
    assert DAgger().rounds(50) == [1, 4, 15, 10, 20]
    assert DAgger().rounds(10) == [1, 4, 5]
    assert Dart().rounds(1) == [1]
    assert DAgger(updates=(3, 4)).rounds(2) == [2]
    assert DAgger(updates=()).rounds(6) == [6]


@pytest.mark.parametrize("name", TRAINERS)
def test_the_expert_acts_in_round_0(name):
    decision, _ = decide(trainer_of(name), 0, None)
    assert np.array_equal(decision.expert_action, linear(ROWS))
    noisy = (decision.action != linear(ROWS)).any(axis=1)
    assert noisy.tolist() == [name == "noise" and row % 2 == 0 for row in range(len(ROWS))]


def test_noise_is_a_share_of_half_the_range():
    decision, _ = decide(NoisyExpert(sigma=0.25), 0, None)
    deviations = (decision.action - linear(ROWS))[::2].std(axis=0)
    assert deviations == pytest.approx(0.25 * HALF, rel=0.15)
    still, _ = decide(NoisyExpert(sigma=0), 0, None)
    assert np.array_equal(still.action, linear(ROWS))


def test_each_second_episode_is_noisy_however_many_run_side_by_side():
    """Twenty-five at a time are stepped together; labels are the expert's own everywhere."""
    run = {**QUICK, "probes": 0, "trainer": "noise", "episodes": 60, "horizon": 3}
    states = fdtasil.distill(linear, TOY, **run).demonstrations
    off = (states.taken != states.actions).any(axis=1)
    assert [bool(off[states.episode == e].all()) for e in range(60)] == [True, False] * 30
    assert [bool(off[states.episode == e].any()) for e in range(60)] == [True, False] * 30
    assert np.allclose(states.actions, linear(states.observations), atol=1e-6)


def test_dagger_blends():
    student = off_by(1)
    for trainer, round_, share in [
        (DAgger(), 1, 0.5),
        (DAgger(), 3, 0.125),
        (DAgger(beta=0.8), 2, 0.64),
        (DAgger(beta=lambda i: 1 / (i + 1)), 3, 0.25),
    ]:
        decision, _ = decide(trainer, round_, student)
        assert np.allclose(decision.action, linear(ROWS) + (1 - share), atol=1e-6)
        assert np.array_equal(decision.expert_action, linear(ROWS))


def test_dagger_switches():
    decision, _ = decide(DAgger(beta=0.3, mix="switch"), 1, off_by(1))
    own = np.isclose(decision.action, linear(ROWS) + 1, atol=1e-6).all(axis=1)
    theirs = np.isclose(decision.action, linear(ROWS), atol=1e-6).all(axis=1)
    assert (own | theirs).all()
    assert theirs.mean() == pytest.approx(0.3, abs=0.07)


def test_dagger_takes_the_choice_of_one_of_both():
    """The mean of two scores is the best of nobody."""
    decision, _ = decide(DAgger(), 1, off_by(1), chooses=True)
    assert set(np.round(decision.action - linear(ROWS), 5).flat) == {0, 1}


def test_a_student_alone_is_labelled_afterwards():
    decision, _ = decide(DAgger(beta=0.0), 1, off_by(1))
    assert decision.expert_action is None
    never = DAgger(updates=(1,), beta=lambda round_: 0.0)  # but there is no student at first
    assert never.queries(3, 10) == {"act": 10, "label": 20}
    result = fdtasil.distill(linear, TOY, 0, trainer=DAgger(beta=0.0), **{**QUICK, "episodes": 3})
    assert result.queries["act"] == 20
    assert result.queries["label"] == 40
    assert np.allclose(result.demonstrations.actions, linear(result.demonstrations.observations))


def test_darts_noise_has_the_covariance_of_the_students_error():
    error = np.array([0.3, -0.1])
    decision, asked = decide(Dart(), 1, off_by(error))
    noise = decision.action - linear(ROWS)
    assert np.allclose(np.cov(noise.T), np.outer(error, error), atol=0.02)
    assert np.array_equal(decision.expert_action, linear(ROWS))
    assert asked == {"act": 5 * 20}


def test_darts_alpha_is_the_noise_of_an_episode():
    decision, _ = decide(Dart(alpha=4.0), 1, off_by(np.array([0.3, -0.1])))
    noise = decision.action - linear(ROWS)
    assert 20 * np.trace(noise.T @ noise / len(noise)) == pytest.approx(4.0, rel=0.15)


@pytest.mark.fault(103)
def test_a_perfect_student_makes_no_noise():
    decision, _ = decide(Dart(alpha=1.0), 1, linear)
    assert np.allclose(decision.action, linear(ROWS), atol=1e-6)


@pytest.mark.fault(103)
@pytest.mark.parametrize("alpha", [0.0, 4.0])
def test_noise_of_a_single_state_is_finite(alpha):
    """Its covariance has one direction only, and no root by Cholesky."""
    with EnvironmentPool(TOY) as pool:
        expert = load_expert(linear, 5, 2)

        def record(behaviour, count):
            return rollout(behaviour, pool, [0], 1)

        situation = Situation(1, expert, HALF, off_by(np.array([0.3, -0.1])), record)
        act = Dart(alpha=alpha, extra=1).behaviour(situation)
        noise = [np.random.default_rng(e) for e in range(len(ROWS))]
        apart = act(ROWS, noise).action - linear(ROWS)
    assert np.isfinite(apart).all()
    assert np.abs(apart @ [0.1, 0.3]).max() < 1e-6
    assert apart.std() > 0.05


@pytest.mark.fault(104)
@pytest.mark.parametrize("beta", [1.5, -0.1, np.nan, np.inf, "half", None, 1j])
def test_a_mixture_that_is_no_share_is_refused(beta):
    with pytest.raises(SettingError, match=r"beta=.*\n.*a share from 0 to 1"):
        DAgger(beta=beta)
    run = {**QUICK, "episodes": 3, "trainer": DAgger(beta=lambda i: beta)}
    with pytest.raises(SettingError, match="beta="):
        fdtasil.distill(linear, TOY, 0, **run)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: DAgger(beta=1.5),
        lambda: DAgger(mix="stir"),
        lambda: DAgger(updates=(5, 1)),
        lambda: DAgger(updates=(0, 1)),
        lambda: Dart(alpha=-1),
        lambda: Dart(extra=0),
        lambda: decide(DAgger(beta=lambda i: 2.0), 1, linear),
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(SettingError):
        wrong()


@pytest.mark.parametrize("trainer", ["dagger", "dart"])
def test_one_episode_is_one_round(trainer, linear):
    with pytest.warns(FdtasilWarning, match="leave trainer="):
        fdtasil.distill(linear, TOY, 0, trainer=trainer, **{**QUICK, "episodes": 1})


@pytest.mark.filterwarnings("ignore:.*leaves the action bounds")
def test_what_happened_is_counted_over_all_rounds():
    """The expert acts in each of three, at twice what the environment takes."""
    run = {**QUICK, "episodes": 3, "trainer": DAgger(updates=(1, 2), beta=1.0), "force": True}
    result = fdtasil.distill(lambda rows: -2 * np.sign(rows[:, :2]), TOY, 0, **run)
    assert result.report["clipped_actions"] == len(result.demonstrations) == 60


@pytest.mark.fault(338)
def test_noise_stays_in_the_episodes_that_it_is_for():
    """Others are recorded in the place of those that fell, of which the noisy ones are more."""

    class Slips(Integrator):
        """Falls from most starts, where it is pushed otherwise than the law pushes."""

        def step(self, action):
            law = np.clip(linear(self._observe()[None].astype(np.float32))[0], -1, 1)
            pushed = bool(np.abs(np.asarray(action) - law).max() > 1e-3)
            *found, fallen, cut, about = super().step(action)
            return *found, fallen or (pushed and self.position[0] > 0.5), cut, about

    made = lambda: Slips()  # noqa: E731
    about = QUICK | {"episodes": 12, "horizon": 20, "trainer": "noise", "keep": "survivors"}
    result = fdtasil.distill(linear, made, 0, **about)
    assert result.report["replaced_episodes"] > 0
    states = result.demonstrations
    apart = np.abs(states.taken - states.actions).max(axis=1) > 1e-3
    noisy = [bool(apart[states.episode == number].any()) for number in range(12)]
    assert noisy == [number % 2 == 0 for number in range(12)]


@pytest.mark.fault(339)
def test_an_expert_that_is_silent_in_extra_episodes_gives_no_noise():
    situation = Situation(1, load_expert(linear, 5, 2), HALF, linear, lambda *_: SILENT)
    with pytest.warns(FdtasilWarning, match="no answer in the 5 extra episodes"):
        behaviour = Dart().behaviour(situation)
    decision = behaviour(ROWS[:3], [np.random.default_rng(e) for e in range(3)])
    assert np.array_equal(decision.action, linear(ROWS[:3]))


SILENT = SimpleNamespace(
    answered=np.zeros((5, 20), bool),
    observations=np.zeros((5, 20, 5), np.float32),
    expert_actions=np.zeros((5, 20, 2), np.float32),
)


@pytest.mark.fault(340)
def test_a_share_that_is_a_function_is_known_by_what_it_says(tmp_path):
    def begun(share, folder):
        run = QUICK | {"trainer": DAgger(updates=(1,), beta=share)}
        with pytest.raises(StopEarly):
            fdtasil.distill(linear, TOY, 0, out=tmp_path / folder, callback=stop, **run)

    def stop(event):
        raise StopEarly

    begun(lambda round_: 0.7**round_, "run")
    other = DAgger(updates=(1,), beta=lambda round_: 0.0)
    with pytest.raises(SettingError, match="trainer was"):
        fdtasil.distill(linear, TOY, 0, resume=tmp_path / "run", **QUICK, trainer=other)
    same = DAgger(updates=(1,), beta=functools.partial(pow, 0.7))
    found = fdtasil.distill(linear, TOY, 0, resume=tmp_path / "run", **QUICK, trainer=same)
    assert found.report["trainer"] == "dagger,updates=(1,),beta=[0.7]"
    call = call_of(found.settings, 1)
    assert "beta=lambda round_: [0.7][round_ - 1]" in call
    names = {"expert": linear}
    exec(call.replace("expert = ...", ""), names)
    assert names["result"].student.to_bytes() == found.student.to_bytes()


class StopEarly(Exception):
    pass


class Own:
    """A trainer of somebody's own, with a matrix and a generator."""

    name = "own"

    def __init__(self, rounds=None, decision=None):
        self.covariance, self.random = np.eye(2), np.random.default_rng(0)
        self.given, self.decision = rounds, decision

    def rounds(self, episodes):
        return [episodes] if self.given is None else self.given

    def behaviour(self, situation):
        def act(observations, noise):
            answers = situation.expert.ask(observations, "act")
            return Decision(answers, answers) if self.decision is None else self.decision(answers)

        return act

    def queries(self, episodes, horizon):
        return {"act": episodes * horizon, "label": 0}


@dataclass(slots=True)
class Slots:
    name: str = "slots"
    rounds = Own.rounds
    given = None
    decision = None
    behaviour, queries = Own.behaviour, Own.queries


@pytest.mark.fault(340)
def test_a_trainer_is_described_whole():
    long = DAgger(updates=range(1, 100), beta=np.float64(0.5))
    assert describe_trainer(long, 100) == f"dagger,updates={(*range(1, 100),)}"


@pytest.mark.fault(341)
@pytest.mark.parametrize("made", [Own, Slots])
def test_a_trainer_of_ones_own(made):
    found = fdtasil.distill(linear, TOY, 0, trainer=made(), **QUICK)
    expected = fdtasil.distill(linear, TOY, 0, **QUICK)
    assert found.student.to_bytes() == expected.student.to_bytes()
    assert " at 0x" not in found.report["trainer"]
    assert "\n" not in found.report["trainer"]


@pytest.mark.fault(341)
@pytest.mark.parametrize("rounds", [[], [0, 2], [2, 0], [4], [1.5, 0.5], 2])
def test_rounds_that_are_none_are_refused(rounds):
    with pytest.raises(SettingError, match=r"rounds\(2\) of the trainer own is"):
        fdtasil.distill(linear, TOY, 0, trainer=Own(rounds), **QUICK)


@pytest.mark.fault(341)
@pytest.mark.parametrize("decision", [lambda a: a, lambda a: (a, a), lambda a: None])
def test_what_is_no_decision_is_refused(decision):
    with pytest.raises(SettingError, match="a trainer's behaviour that returns a"):
        fdtasil.distill(linear, TOY, 0, trainer=Own(decision=decision), **QUICK)
