"""Who acts in round i."""

import numpy as np
import pytest
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil.demonstrations.trainers import (
    TRAINERS,
    DAgger,
    Dart,
    NoisyExpert,
    Situation,
    trainer_of,
)
from fdtasil.errors import FdtasilWarning, SettingError
from fdtasil.experts.load import load_expert
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
