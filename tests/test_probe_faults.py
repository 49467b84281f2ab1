"""Finite differences that can't be taken: refused, warned of, or taken so that they are right."""

import tracemalloc
from contextlib import nullcontext

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from gymnasium.spaces import Box
from toy_environments import Integrator

import fdtasil
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS

BOX = Box(-np.inf, np.inf, (5,), np.float64)


def seen_through(change, box=BOX):
    """The toy, with other observations."""
    return lambda: gymnasium.wrappers.TransformObservation(Integrator(), change, box)


def asked(expert, states, spec, seed=0):
    probes = PRESETS["standard"].complete(Probes.parse(spec)).with_order(1)
    scales = measure_scales(states)
    around = Surroundings.of(states, probes, scales)
    return ask_probes(load_expert(expert), around, np.random.default_rng(seed))


def never(rows):
    raise AssertionError("asked")


# --- how many


@pytest.mark.fault(84)
@pytest.mark.parametrize(
    "probes",
    [-1, 2.0, True, np.nan, np.float64(3), [3], "-1", "2.5", "nan", "", "sphere:0", "sphere:-2"],
)
def test_a_number_that_is_none_is_refused_before_anything_is_asked(probes):
    with pytest.raises(SettingError, match="probes=") as error:
        fdtasil.distill(never, TOY, probes, **QUICK)
    assert len(str(error.value).splitlines()) <= 6
    assert "a number of probes" in str(error.value)


@pytest.mark.fault(84)
@pytest.mark.parametrize("probes", [0, "0", "none"])
def test_no_probes_are_plain_cloning_and_say_so(probes, linear):
    result = fdtasil.distill(linear, TOY, probes, **QUICK)
    assert result.report["probes"] == "none"
    assert result.queries["probe"] == 0


def test_probes_that_are_left_out_are_ten(linear):
    for left_out in ({}, {"probes": None}):
        result = fdtasil.distill(linear, TOY, **left_out, **QUICK)
        assert result.report["probes"].startswith("adaptive:10,")
        assert result.queries["probe"] == 400


@pytest.mark.fault(84)
def test_a_numpy_integer_is_a_number(linear):
    assert fdtasil.distill(linear, TOY, np.int64(3), **QUICK).queries["probe"] == 120


@pytest.mark.fault(85)
@pytest.mark.parametrize("count", [5, 8, 11])
def test_more_orthogonal_probes_than_coordinates_are_of_further_frames(count, linear):
    result = fdtasil.distill(linear, TOY, f"orthogonal:{count},forward", **QUICK)
    assert result.report["frozen_coordinates"] == 1  # four coordinates are left
    assert result.queries["probe"] == count * len(result.demonstrations)
    for numbers in result.answers.numbers:
        assert len(set(numbers.tolist())) == count


# --- how far


@pytest.mark.fault(86)
@pytest.mark.parametrize("radius", ["0", "-1", "inf", "-inf", "nan", "1e999", "1e-999", "x"])
def test_a_radius_that_is_none_is_refused_before_anything_is_asked(radius):
    with pytest.raises(SettingError, match="radius=") as error:
        fdtasil.distill(never, TOY, f"sphere:3,radius={radius}", **QUICK)
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.fault(86)
@pytest.mark.parametrize("radius", ["1e39", "1e-46"])
@pytest.mark.filterwarnings("ignore::fdtasil.errors.FdtasilWarning")
def test_a_radius_that_float32_does_not_have_is_refused(radius, linear):
    with pytest.raises(SettingError, match="moves a state by"):
        fdtasil.distill(linear, TOY, f"sphere:3,forward,raw,radius={radius}", **QUICK)


@pytest.mark.fault(87)
@pytest.mark.parametrize("sizes", [(5, 16, 2), (5, 64, 64, 2)])
def test_a_radius_in_the_rounding_of_float32_is_warned_of(sizes, tmp_path):
    """By what the expert's answers show, which depends on its size, and not by a rule."""
    expert = mlp_onnx(tmp_path / "e.onnx", sizes=sizes)
    with pytest.warns(FdtasilWarning, match=r"radius=1e-06: \d+% of a difference there is noise"):
        result = fdtasil.distill(expert, TOY, "basis,radius=1e-6", **QUICK)
    assert result.report["calibration"]["regime"] == "smooth"
    assert any("is noise" in note for note in result.report["warnings"])
    gone = pytest.raises(SettingError, match="float32 rounds the step away")
    with pytest.warns(FdtasilWarning), gone:
        fdtasil.distill(expert, TOY, "basis,radius=1e-9", **QUICK)


@pytest.mark.fault(87)
def test_a_radius_above_the_rounding_is_not_warned_of(tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    result = fdtasil.distill(expert, TOY, "sphere:3,radius=0.001", **QUICK)
    assert result.report["warnings"] == []


@pytest.mark.fault(87, 89)
def test_a_step_that_float32_rounds_is_warned_of_without_a_calibration(linear):
    """Raw probes, as the paper's preset has them."""
    said = r"float32 rounds away 100% of the step along coordinate 4, of .* beside values of 3:"
    with pytest.warns(FdtasilWarning, match=said):
        fdtasil.distill(linear, TOY, "sphere:3,forward,raw,radius=1e-7", **QUICK)


@pytest.mark.fault(88)
@pytest.mark.parametrize("radius", ["8", "1000"])
def test_a_radius_beyond_every_state_is_warned_of(radius, tmp_path):
    """Even of an expert whose answers, there, saturate smoothly."""
    with pytest.warns(FdtasilWarning, match=f"radius={radius}: no demonstrated state lies"):
        fdtasil.distill(mlp_onnx(tmp_path / "e.onnx"), TOY, f"sphere:3,radius={radius}", **QUICK)


# --- coordinates of all sizes


@pytest.mark.fault(89)
@pytest.mark.parametrize("offset", [1e5, 1e7, 1e10])
def test_a_coordinate_so_large_that_it_stands_still_is_frozen_and_counted(offset):
    move = np.array([offset, 0, 0, 0, 0])
    environment = seen_through(lambda x: x + move)

    def expert(rows):
        return np.clip((rows - move) @ GAIN.T, -1, 1)

    # At 1e5 it moves by some steps of float32, at 1e7 by one or two, which is said.
    said = {1e5: "by few of the steps that float32 has", 1e7: "rounds away how 1 of the 4"}
    with pytest.warns(FdtasilWarning, match=said[offset]) if offset in said else nullcontext():
        result = fdtasil.distill(expert, environment, "basis", **QUICK)
    assert result.report["frozen_coordinates"] == 2
    assert not result.answers.displacements[:, 0].any()
    with pytest.warns(FdtasilWarning) as caught:
        fdtasil.distill(expert, environment, "sphere:3,forward,raw,radius=0.01", **QUICK)
    said = " ".join(str(one.message) for one in caught)
    assert "of the step along coordinate 0, of " in said


@pytest.mark.fault(89)
def test_a_whole_step_that_is_rounded_away_is_refused():
    states = np.random.default_rng(0).uniform(1e6, 1e6 + 10, (50, 5)).astype(np.float32)
    with pytest.warns(FdtasilWarning), pytest.raises(SettingError, match="do not move the state"):
        asked(lambda rows: rows[:, :2], states, "basis,forward,raw,radius=1e-3")


@pytest.mark.fault(90)
@pytest.mark.parametrize("around", [0.0, 5.0])
def test_coordinates_that_hardly_move_are_frozen_and_counted(around):
    """Humanoid has one whose deviation is 1.8e-14: what is left of a sum that should be zero."""

    def change(x):
        return np.append(x[:4] + around, around + 1.8e-14 * x[0])

    def expert(rows):
        return np.clip((rows[:, :4] - around) @ GAIN[:, :4].T, -1, 1)

    result = fdtasil.distill(expert, seen_through(change), "basis", **QUICK)
    assert result.report["frozen_coordinates"] == 1
    assert not result.answers.displacements[:, 4].any()
    assert result.queries["probe"] == 4 * len(result.demonstrations)
    # A bump of a hundredth must not become a million in the student's eyes.
    rows = result.demonstrations.observations
    bumped = rows + np.float32([0, 0, 0, 0, 0.01])
    assert np.abs(result.student.act(bumped) - result.student.act(rows)).max() < 0.05
    assert result.student.scale.min() > 1e-3


@pytest.mark.fault(90)
@pytest.mark.parametrize("unit", [1e-20, 1e-6, 1e20])
def test_the_unit_of_the_observations_does_not_matter(unit):
    def expert(rows):
        return np.clip(rows @ (GAIN.T / unit), -1, 1)

    result = fdtasil.distill(expert, seen_through(lambda x: unit * x), 3, **QUICK)
    assert result.report["frozen_coordinates"] == 1
    assert result.evaluation.normalized_return > 0.7


# --- memory


@pytest.mark.fault(91)
@pytest.mark.filterwarnings("ignore:the expert takes")
def test_probes_that_no_memory_holds_are_refused(linear):
    with pytest.raises(SettingError, match="at 40 states does not fit into memory") as error:
        fdtasil.distill(linear, TOY, "sphere:1000000000000,forward", **QUICK)
    assert isinstance(error.value.__cause__, MemoryError)


@pytest.mark.fault(91)
def test_asking_takes_little_memory_beside_the_answers(figure):
    """Of Humanoid's size; the points are made and asked a bounded number at a time."""
    states = np.random.default_rng(0).standard_normal((8000, 348)).astype(np.float32)
    tracemalloc.start()
    try:
        answers = asked(lambda rows: rows[:, :17], states, "sphere:10,forward,radius=0.3")
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert answers.values.shape == (8000, 10, 1, 17)
    assert peak - held < 256 * 2**20
    figure("memory beside the answers, 348 coordinates", f"{(peak - held) / 2**20:.0f} MiB")


# --- centre and probes


@pytest.mark.fault(92)
@pytest.mark.parametrize("kind", ["module", "onnx", "function"])
def test_a_centre_asked_apart_makes_no_difference_that_counts(kind, tmp_path):
    """Labels are asked by 25 rows and fewer, probes by 1,024: the last bits may differ."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = torch.nn.Sequential(
            torch.nn.Linear(17, 64), torch.nn.Tanh(), torch.nn.Linear(64, 6)
        )
    weights = module[0].weight.detach().numpy().T.copy()
    expert = load_expert(
        {
            "module": module,
            "onnx": mlp_onnx(tmp_path / "e.onnx", sizes=(17, 64, 6)),
            "function": lambda rows: np.tanh(rows @ weights)[:, :6],
        }[kind]
    )
    states = np.random.default_rng(0).standard_normal((200, 17)).astype(np.float32)
    alone = np.concatenate([expert.ask(row[None], "label") for row in states])
    together = expert.ask(states, "label")
    assert np.abs(alone - together).max() <= 1e-6
    if kind == "onnx":
        assert np.array_equal(alone, together)
    answers = asked(expert, states, "basis,forward,radius=0.3")
    steps = answers.displacements[answers.numbers].max(axis=-1, keepdims=True)
    found, expected = ((answers.values[:, :, 0] - c[:, None]) / steps for c in (alone, together))
    assert np.abs(found - expected).max() <= 1e-5
    assert np.abs(expected).max() > 0.1


# --- bounds


@pytest.mark.fault(93)
def test_probes_are_not_clipped_to_the_bounds_of_the_observations(linear):
    """Clipped ones would have other steps than the student's, on one side of the box."""
    narrow = Box(-0.05, 0.05, (5,), np.float64)
    found, expected = (
        fdtasil.distill(linear, seen_through(lambda x: x, box), 3, **QUICK)
        for box in (narrow, BOX)
    )
    assert found.dataset.to_bytes() == expected.dataset.to_bytes()


@pytest.mark.fault(93)
@pytest.mark.usefixtures("nothing_is_trained")
def test_an_expert_that_refuses_most_of_what_lies_outside_is_told_why_before_training(linear):

    def strict(rows):
        if np.abs(rows[:, :4]).max() > 1.2:
            raise ValueError("outside of the bounds")
        return linear(rows)

    with pytest.raises(ExpertError, match=r"no answer .*: outside of the bounds") as error:
        fdtasil.distill(strict, TOY, "sphere:3,forward,radius=4,raw", **QUICK)
    assert "moved states" in error.value.found
    assert "smaller radius" in error.value.next_step
    assert len(str(error.value).splitlines()) <= 6


class Derives:
    """x -> GAIN x with its own derivatives, counting the rows of each call."""

    def __init__(self):
        self.rows = []

    def __call__(self, observations):
        return np.asarray(observations, np.float64)[:, :5] @ GAIN.T.astype(np.float64)

    def jacobian(self, observations):
        self.rows.append(len(observations))
        given = np.zeros((len(observations), *GAIN.shape[:1], observations.shape[1]))
        given[:, :, :5] = GAIN
        return given


def test_own_derivatives_are_asked_as_many_at_once_as_actions(tmp_path):
    expert = Derives()
    states = np.random.default_rng(0).standard_normal((9, 5))
    log = fdtasil.from_arrays(states, expert(states))
    one = load_expert(expert, 5, 2, batch=1)
    fdtasil.distill(one, None, "jacobian", dataset=log, fit=fdtasil.Fit(steps=3))
    assert set(expert.rows) == {1}


@pytest.mark.fault(311)
def test_a_large_number_that_stands_still_is_no_fault_of_own_derivatives():
    expert = Derives()
    states = np.random.default_rng(0).standard_normal((40, 6))
    states[:, 5] = 300_000
    log = fdtasil.from_arrays(states, expert(states))
    result = fdtasil.distill(expert, None, "jacobian", dataset=log, fit=fdtasil.Fit(steps=3))
    assert result.queries["probe"] > 40


@pytest.mark.fault(312)
@pytest.mark.filterwarnings("ignore:the expert had no answer")
def test_derivatives_of_a_module_that_are_none_teach_nothing():
    class Law(torch.nn.Module):
        def __init__(self, broken):
            super().__init__()
            self.broken = broken

        def forward(self, x):
            held = torch.where(x[:, :1] > 1, self.broken(x[:, :1] - x[:, :1].detach()), 0.0)
            return x[:, :2] + 5 + held

    states = np.random.default_rng(0).standard_normal((20, 5)).astype(np.float32)
    log = fdtasil.from_arrays(states, states[:, :2] + 5)
    run = {"dataset": log, "fit": fdtasil.Fit(steps=3), "progress": False}
    found = fdtasil.distill(Law(lambda x: torch.sqrt(torch.relu(x))), None, "jacobian", **run)
    silent = states[:, 0] > 1
    assert 0 < silent.sum() < 10
    assert not found.answers.values[silent].any()  # no action in the place of a derivative
    assert not found.answers.displacements[found.answers.numbers[silent]].any()
    with pytest.raises(ExpertError, match=r"infinite derivatives at \d+ of 20 states"):
        fdtasil.distill(Law(lambda x: torch.sqrt(x)), None, "jacobian", **run)
