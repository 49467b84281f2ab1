"""Environments that remember, share, round or reuse; and runs that go on in another one."""

import gymnasium
import numpy as np
import pytest
from conftest import QUICK, TOY
from gymnasium.spaces import Box
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import EnvironmentFault, FdtasilWarning, SettingError
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import first_observations, rollout
from fdtasil.rollouts.trials import check_repeats, differ, fingerprint, other_environment
from fdtasil.run.folder import _numbered

pytestmark = pytest.mark.usefixtures("no_pictures")


class Adding(gymnasium.Wrapper):
    """Remembers how often it was stepped, and pays less each time."""

    count = 0

    def step(self, action):
        self.count += 1
        observation, reward, *rest = self.env.step(action)
        return observation, reward / self.count, *rest


class Remembering(Integrator):
    """Has a memory itself: its wall comes nearer with every episode."""

    episodes = 0

    def reset(self, **named):
        self.episodes += 1
        observation, info = super().reset(**named)
        return observation + self.episodes, info


WRAPPERS = {
    "NormalizeReward": gymnasium.wrappers.NormalizeReward,
    "NormalizeObservation": gymnasium.wrappers.NormalizeObservation,
    "Adding": Adding,
}


@pytest.mark.fault(175)
@pytest.mark.parametrize("name", WRAPPERS)
@pytest.mark.parametrize("around", [False, True])
def test_a_wrapper_that_remembers_is_refused_by_its_name(name, around, linear, nothing_is_trained):
    def made():
        inner = WRAPPERS[name](Integrator())
        return gymnasium.wrappers.TransformReward(inner, lambda x: x) if around else inner

    for call in (
        lambda: fdtasil.distill(linear, made, 1, **QUICK),
        lambda: fdtasil.evaluate(linear, linear, made, episodes=2, horizon=5),
    ):
        with pytest.raises(
            EnvironmentFault, match=f"Integrator: {name} remembers earlier"
        ) as error:
            call()
        assert f"leave {name} out" in error.value.next_step


class Leaks(Integrator):
    """Counts on over episodes."""

    count = 0

    def reset(self, *, seed=None, options=None):
        self.count += 1
        observation, info = super().reset(seed=seed)
        return self.seen(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.seen(observation), *rest

    def seen(self, observation):
        return observation + self.count


class LeaksInParts(Leaks):
    def __init__(self):
        super().__init__()
        self.observation_space = gymnasium.spaces.Dict({"all": self.observation_space})

    def seen(self, observation):
        return {"all": observation + self.count}


@pytest.mark.fault(295)
@pytest.mark.parametrize(
    ("made", "more"), [(Leaks, {}), (Leaks, {"history": 2}), (LeaksInParts, {})]
)
def test_a_wrapper_of_this_library_is_not_blamed(made, more):
    law = lambda rows: np.zeros((len(rows), 2), np.float32)  # noqa: E731
    with pytest.raises(EnvironmentFault, match=f"{made.__name__} remembers earlier") as error:
        fdtasil.distill(law, made, 0, **QUICK, **more)
    assert f"let reset() of {made.__name__} clear all" in error.value.next_step


@pytest.mark.fault(175)
@pytest.mark.parametrize("name", ["NormalizeReward", "NormalizeObservation"])
def test_the_next_steps_of_a_wrapper_that_remembers_work(name):
    def frozen():
        environment = WRAPPERS[name](Integrator())
        environment.update_running_mean = False
        return environment

    with EnvironmentPool(WRAPPERS[name](Integrator())) as pool:
        with pytest.raises(EnvironmentFault, match="update_running_mean = False"):
            check_repeats(pool, 0)
        with pytest.warns(FdtasilWarning, match=r"remembers earlier episodes.*\(forced\)"):
            check_repeats(pool, 0, force=True)
    with EnvironmentPool(frozen) as pool:
        check_repeats(pool, 0)


@pytest.mark.fault(175)
def test_an_environment_that_remembers_is_told_from_one_that_is_not_seeded():
    random = np.random.default_rng(0)

    def unseeded():
        return gymnasium.wrappers.TransformReward(
            Integrator(), lambda reward: reward + random.random()
        )

    pool, other = EnvironmentPool(Remembering), EnvironmentPool(unseeded)
    with pytest.raises(EnvironmentFault, match="Remembering remembers"):
        check_repeats(pool, 0)
    with pytest.warns(FdtasilWarning, match="same reward twice with one seed"):
        check_repeats(other, 0)


class Noisy(Integrator):
    """A simulator whose last digits differ, as Bullet's do."""

    random = np.random.default_rng(0)

    def __init__(self, size):
        super().__init__()
        self.size = size

    def _observe(self):
        return super()._observe() * (1 + self.size * self.random.uniform(-1, 1, 5))


@pytest.mark.fault(176)
def test_rounding_is_no_other_start():
    with EnvironmentPool(lambda: Noisy(1e-6)) as pool:
        with pytest.warns(FdtasilWarning, match="only up to rounding"):
            check_repeats(pool, 0)
        assert fingerprint(pool, 0) is not None
    with EnvironmentPool(lambda: Noisy(1e-2)) as pool:
        with pytest.warns(FdtasilWarning, match="same first observation twice"):
            check_repeats(pool, 0)
        assert fingerprint(pool, 0) is None


class Buffered(Integrator):
    """Hands out one array again and again."""

    def __init__(self):
        super().__init__()
        self.buffer = np.zeros(5)

    def _observe(self):
        self.buffer[:] = super()._observe()
        return self.buffer


@pytest.mark.fault(177)
def test_an_observation_buffer_that_is_reused_is_copied(linear):
    with EnvironmentPool(Buffered) as pool, EnvironmentPool(Integrator) as plain:
        starts, expected = (first_observations(one, range(4)) for one in (pool, plain))
        assert np.array_equal(starts, expected)
        found, same = (rollout(follow(linear), one, range(4), 10) for one in (pool, plain))
        assert np.array_equal(found.observations, same.observations)
    whole, again = (fdtasil.distill(linear, one, 2, **QUICK) for one in (Integrator, Buffered))
    assert whole.student.to_bytes() == again.student.to_bytes()


class Shared(Integrator):
    """All copies move the same masses."""

    world: dict[str, np.ndarray] = {}  # noqa: RUF012

    position = property(
        lambda self: self.world["position"], lambda self, x: self._put("position", x)
    )
    velocity = property(
        lambda self: self.world["velocity"], lambda self, x: self._put("velocity", x)
    )

    def _put(self, name, value):
        self.world[name] = value


@pytest.mark.fault(178)
def test_copies_that_share_a_simulator_are_played_in_turn(linear):
    with EnvironmentPool(Shared) as pool, EnvironmentPool(Integrator) as plain:
        with pytest.warns(FdtasilWarning, match="copies of Shared share one simulator"):
            found = rollout(follow(linear), pool, range(5), 10)
        assert len(pool.take(5)) == 1
        expected = rollout(follow(linear), plain, range(5), 10)
        assert np.allclose(found.rewards, expected.rewards)  # asked alone and in a batch


class Stop(Exception):
    """Stands for a kill."""


def stop(event):
    raise Stop


def begun(expert, environment, folder, **changes):
    with pytest.raises(Stop):
        fdtasil.distill(expert, environment, 2, out=folder, callback=stop, **{**QUICK, **changes})


def paid(times):
    return gymnasium.wrappers.TransformReward(Integrator(), lambda reward: times * reward)


def heavy():
    inner = Integrator()
    return gymnasium.wrappers.TransformAction(inner, lambda a: a / 2, inner.action_space)


@pytest.mark.fault(179)
def test_a_run_is_not_gone_on_with_in_another_environment(linear, tmp_path):
    begun(linear, lambda: paid(1), tmp_path)
    for other, found in ((lambda: paid(2), "first reward"), (heavy, "after one step")):
        with pytest.raises(SettingError, match=f"another configuration: .*{found} from seed"):
            fdtasil.distill(linear, other, 2, resume=tmp_path, **QUICK)
    # Another wrapper that changes nothing is none.
    resumed = fdtasil.distill(linear, Integrator, 2, resume=tmp_path, **QUICK)
    whole = fdtasil.distill(linear, TOY, 2, **QUICK)
    assert resumed.student.to_bytes() == whole.student.to_bytes()
    with pytest.raises(SettingError, match="first reward"):  # a finished one is not handed out
        fdtasil.distill(linear, lambda: paid(2), 2, resume=tmp_path, **QUICK)


@pytest.mark.fault(179)
def test_gravity_is_part_of_a_fingerprint():
    found = []
    for gravity in (5.0, 15.0):
        with EnvironmentPool(lambda g=gravity: gymnasium.make("Pendulum-v1", g=g)) as pool:
            found.append(fingerprint(pool, 3))
    (told,) = other_environment(*found)
    assert told.startswith("its observation after one step from seed 3 was [")
    nearly = {**found[0], "after": [value * (1 + 1e-6) for value in found[0]["after"]]}
    assert other_environment(found[0], nearly) == []
    for junk in (
        None,
        [],
        {},
        {"seed": 3},
        {**found[0], "after": "x"},
        {**found[0], "after": [[]]},
    ):
        assert isinstance(other_environment(junk, found[0]), list)


def test_where_two_long_observations_are_apart_is_told():
    before = {"seed": 3, "observation": [1.0] * 9, "after": [], "reward": [0.5]}
    now = before | {"observation": [*[1.0] * 6, 7.0, 1.0, 1.0]}
    (told,) = other_environment(before, now)
    assert told == "its first observation from seed 3 was [1.0], is [7.0] at coordinate 6"
    (told,) = other_environment(before | {"observation": [1.0] * 8}, now)
    assert told.endswith("had 8 numbers, has 9")
    for junk in ("x", [None] * 9, [[]] * 9, [[0] * 9, [9] * 9] * 5, [[0] * 9] * 9, [10**400] * 9):
        assert len(other_environment(before | {"observation": junk}, now)) == 1


@pytest.mark.fault(328)
def test_another_expert_is_found_around_the_states_where_they_agree(linear, tmp_path):
    """As two laws do that are at their bounds wherever the demonstrations went."""
    visited = set()

    class Noted(Integrator):
        def _observe(self):
            found = super()._observe()
            visited.add(found.astype(np.float32).tobytes())
            return found

    def other(rows):
        there = [row.tobytes() in visited for row in np.asarray(rows, np.float32)]
        return np.where(np.array(there)[:, None], linear(rows), 0.5 * linear(rows))

    with pytest.raises(Stop):
        fdtasil.distill(linear, Noted, 2, out=tmp_path, callback=stop, **QUICK)
    other.__name__ = linear.__name__
    with pytest.raises(SettingError, match="moved by a probe"):
        fdtasil.distill(other, Noted, 2, resume=tmp_path, **QUICK)
    fdtasil.distill(linear, Noted, 2, resume=tmp_path, **QUICK)


@pytest.mark.fault(180)
@pytest.mark.parametrize("probes", [0, 2])
def test_a_run_is_not_gone_on_with_by_another_expert(probes, linear, tmp_path):
    """Functions have one name, and no sha256."""
    with pytest.raises(Stop):
        fdtasil.distill(linear, TOY, probes, out=tmp_path, callback=stop, **QUICK)
    for other in (lambda rows: 0.9 * linear(rows), lambda rows: 0.99 * linear(rows)):
        with pytest.raises(SettingError, match=r"begun with another expert: at state \d+"):
            fdtasil.distill(other, TOY, probes, resume=tmp_path, **QUICK)
    resumed = fdtasil.distill(lambda rows: linear(rows), TOY, probes, resume=tmp_path, **QUICK)
    whole = fdtasil.distill(linear, TOY, probes, **QUICK)
    assert resumed.student.to_bytes() == whole.student.to_bytes()
    assert resumed.queries == whole.queries
    assert resumed.report["rows_asked_again_after_resuming"] >= 16


@pytest.mark.fault(181)
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.float16])
def test_actions_stay_inside_the_environments_own_bounds(kind):
    space = Box(kind(-0.1), kind(0.1), (2,), kind)
    sent = []

    class Strict(Integrator):
        def __init__(self):
            super().__init__()
            self.action_space = space

        def step(self, action):
            assert action in space
            sent.append(action)
            return super().step(action)

    def bang(rows):
        return np.where(rows[:, :2] > 0, -1, 1) * np.float64(kind(0.1))

    found = fdtasil.distill(bang, Strict, 1, **QUICK)
    assert {action.dtype for action in sent} == {np.dtype(kind)}
    assert np.isfinite(found.evaluation.student_returns).all()
    assert found.report["clipped_actions"] == 0 or kind is np.float16
    far = found.student.act(1e3 * found.demonstrations.observations).astype(kind)
    assert all(action in space for action in far)


def odd_reset(answer):
    class Reset(Integrator):
        def reset(self, *, seed=None, options=None):
            return answer(*super().reset(seed=seed), options)

    return Reset


class OldGym(Integrator):
    def reset(self):
        return super().reset()


@pytest.mark.fault(182)
@pytest.mark.parametrize(
    ("environment", "found", "step"),
    [
        (
            odd_reset(lambda x, info, _: x),
            r"returned a ndarray of shape \(5,\)",
            "observation, {}",
        ),
        (odd_reset(lambda x, info, _: (x,)), "returned 1 things", "observation, {}"),
        (odd_reset(lambda x, info, _: tuple(x[:2])), "returned a float64 in place of info", "{}"),
        (odd_reset(lambda x, info, o: (x + o["goal"], {})), "NoneType", "reset_options={...}"),
        (OldGym, "unexpected keyword argument 'seed'", "seed=None, options=None"),
    ],
)
def test_a_reset_of_another_kind_has_its_own_cause_and_next_step(environment, found, step, linear):
    with pytest.raises(EnvironmentFault, match=found) as error:
        fdtasil.distill(linear, environment, 1, **QUICK)
    assert "reset()" in error.value.found
    text = error.value.next_step
    assert step in text


@pytest.mark.fault(182)
def test_what_the_error_of_options_names_works(linear):
    needs = odd_reset(lambda x, info, options: (x + options["goal"], {}))
    told = fdtasil.Environment(needs, reset_options={"goal": 0.0})
    assert fdtasil.distill(linear, told, 1, **QUICK).evaluation


def test_an_environment_that_can_be_open_once_is_played_alone(linear):
    class Port(Integrator):
        used = False

        def __init__(self):
            super().__init__()
            if Port.used:
                raise OSError("port in use")
            Port.used = True

    with pytest.warns(FdtasilWarning, match="made 2 times .*port in use.*played in 1 at once"):
        alone = fdtasil.distill(linear, Port, 1, **QUICK)
    many = fdtasil.distill(linear, Integrator, 1, **QUICK)
    # A batch of one row has other last bits.
    returns, others = (one.evaluation.student_returns for one in (alone, many))
    assert returns == pytest.approx(others, rel=1e-3)


class Rude(Exception):
    def __str__(self):
        raise RuntimeError("no text")


def _rude(*answer):
    raise Rude


@pytest.mark.fault(183)
@pytest.mark.parametrize(
    ("change", "found"),
    [
        (_rude, r"step\(\) raised Rude"),
        (lambda x, r, *rest: (x, 10**400, *rest), "returned reward=1000"),
        (lambda x, r, *rest: (x, 10**9000, *rest), "returned reward=a int"),
        (lambda x, r, *rest: (x, "1.0", *rest), "returned reward='1.0'"),
        (lambda x, r, *rest: (x, np.datetime64("2020-01-01"), *rest), "returned reward=np.date"),
        (lambda x, r, e, *rest: (x, r, "False", *rest), "terminated='False'"),
        (lambda x, r, e, t, i: (x, r, e, "no", i), "truncated='no'"),
        (lambda x, *rest: (np.ma.masked_greater(x, 2.5), *rest), "values are masked"),
    ],
)
def test_a_step_that_returns_what_only_looks_like_a_number_is_refused(change, found, linear):
    class Odd(Integrator):
        def step(self, action):
            return change(*super().step(np.clip(action, -1, 1)))

    with pytest.raises(EnvironmentFault, match=found) as error:
        fdtasil.distill(linear, Odd, 1, **QUICK)
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.fault(184)
def test_a_folder_that_somebody_copied_is_no_checkpoint(linear, tmp_path):
    begun(linear, TOY, tmp_path)
    stage = next(tmp_path.glob("checkpoints/0/*-*"))
    for name in ("training-100 2", "training-", "training-²", "added-1 copy"):
        stage.with_name(name).mkdir()
    assert _numbered(tmp_path, 0, "training") == []
    assert fdtasil.distill(linear, TOY, 2, resume=tmp_path, **QUICK).evaluation


class Ambient(Integrator):
    """Positions of a centimetre beside a pressure that stands still."""

    def __init__(self, pressure, random=None):
        super().__init__()
        self.pressure, self.random = pressure, random

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.random is not None:
            self.position = self.random.uniform(-1, 1, 2)
        return self._observe(), {}

    def _observe(self):
        seen = super()._observe()
        return np.append(0.01 * seen[:4], self.pressure)


@pytest.mark.fault(287)
@pytest.mark.parametrize("pressure", [1.0, 101_325.0])
def test_a_large_coordinate_hides_no_other_start(pressure):
    random = np.random.default_rng(0)
    with (
        EnvironmentPool(lambda: Ambient(pressure, random)) as pool,
        pytest.warns(FdtasilWarning, match="same first observation twice with one seed"),
    ):
        check_repeats(pool, 0)
    with EnvironmentPool(lambda: Ambient(pressure)) as pool:
        check_repeats(pool, 0)
    with (
        EnvironmentPool(lambda: Weather(random)) as pool,
        pytest.warns(FdtasilWarning, match="same first obs"),
    ):
        check_repeats(pool, 0)


class Weather(Ambient):
    """A pressure of its own in each episode, by some tens of pascals."""

    def __init__(self, weather):
        super().__init__(101_325.0)
        self.weather = weather

    def reset(self, *, seed=None, options=None):
        self.pressure = 101_325.0 + self.weather.normal(scale=30.0)
        return super().reset(seed=seed)


@pytest.mark.fault(287)
@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ([[1.0, 1e-9]], [[1.0, 1.3e-9]]),  # of one step
        ([[0.0, 5.0], [0.0, 5.001]], [[3e-8, 5.0], [3e-8, 5.001]]),  # what is computed in float32
    ],
)
def test_rounding_is_no_difference_where_little_moves(ours, theirs):
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert not differ(ours, theirs, np.ptp(ours, axis=0))
    assert differ(ours, np.add(theirs, [0.0, 0.1]), np.ptp(ours, axis=0))
