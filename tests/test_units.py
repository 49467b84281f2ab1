"""Observations and actions of any size: a student learns as well in any unit."""

from dataclasses import replace

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from conftest import GAIN, QUICK, TOY
from onnx import TensorProto, helper, numpy_helper
from toy_environments import Integrator
from toy_tasks import linear_task, stream

import fdtasil
from fdtasil.errors import EnvironmentFault, FdtasilWarning, SettingError
from fdtasil.files.onnx.export import export_module
from fdtasil.probes.scales import measure_scales
from fdtasil.progress import Progress
from fdtasil.results.pair import evaluate_pair
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import Fit, fit
from fdtasil.student.policy import Student


def trained(unit, bounded):
    """Return a student of an expert whose actions are `unit` times as large, and its states."""
    states, _, _ = linear_task()
    states = replace(states, actions=(unit * states.actions).astype(np.float32))
    bound = np.full(2, 3.0 * unit if bounded else np.inf, np.float32)
    scales, actions = measure_scales(states.observations), measure_scales(states.actions)
    random = torch.Generator().manual_seed(0)
    student = Student(Mlp(32), scales.mean, scales.scale, -bound, bound, random, actions)
    history = fit(student, states, None, None, Fit(steps=300), stream)
    return student, states, history


@pytest.mark.slow
@pytest.mark.fault(200)
@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("unit", [1e-9, 1e-4, 1e6])
def test_actions_are_learnt_as_well_in_any_unit(unit, bounded):
    usual, states, before = trained(1.0, bounded)
    student, _, history = trained(unit, bounded)
    assert history[-1]["loss"] == pytest.approx(before[-1]["loss"], rel=0.05)
    error = np.abs(student.act(states.observations) / unit - usual.act(states.observations)).max()
    assert error < 0.05
    again = Student.from_bytes(student.to_bytes())
    assert np.array_equal(again.act(states.observations), student.act(states.observations))


@pytest.mark.fault(200)
@pytest.mark.parametrize("low", [[-1, -np.inf], [-np.inf, -np.inf], [-1e-9, -5.0]])
def test_the_exported_file_has_the_units_too(low, tmp_path):
    low, rows = np.asarray(low), np.random.default_rng(0).standard_normal((50, 3))
    actions = measure_scales(np.random.default_rng(1).normal(5.0, [2.0, 300.0], (50, 2)))
    zeros, ones, random = np.zeros(3), np.ones(3), torch.Generator().manual_seed(0)
    student = Student(Mlp(8), zeros, ones, low, -low, random, actions)
    rows = rows.astype(np.float32)
    (tmp_path / "s.onnx").write_bytes(export_module(student, rows, {}))
    answers = fdtasil.load_expert(tmp_path / "s.onnx", 3, 2).ask(rows, "act")
    assert np.allclose(answers, student.act(rows), rtol=1e-5, atol=1e-5 * np.abs(answers).max(0))


def gap(unit):
    """Return the imitation gap of two linear policies where observations are in a unit."""
    box = gymnasium.spaces.Box(-np.inf, np.inf, Integrator().observation_space.shape)
    scaled = gymnasium.wrappers.TransformObservation(Integrator(), lambda o: unit * o, box)

    def policy(gain):
        return lambda rows: (gain * rows[:, :2] / unit).astype(np.float32)

    expert = fdtasil.load_expert(policy(-0.5))
    with EnvironmentPool(scaled) as pool:
        own = rollout(follow(expert.policy("evaluate")), pool, [1, 2], 15)
        judged = evaluate_pair(follow(policy(-0.3)), expert, own, pool, 15, 0, Progress(False))
    return judged.imitation_gap


@pytest.mark.fault(201)
@pytest.mark.parametrize("unit", [1e-7, 1e5])
def test_the_imitation_gap_is_the_same_in_any_unit(unit):
    assert gap(unit) == pytest.approx(gap(1.0), rel=1e-3)
    assert gap(unit) > 0.1


def test_the_imitation_gap_is_the_mean_of_the_episodes_largest_distances():
    expert, student = (
        fdtasil.load_expert(lambda rows, g=g: g * rows[:, :2]) for g in (-0.5, -0.3)
    )
    with EnvironmentPool(TOY) as pool:
        own, other = (
            rollout(follow(one.policy("act")), pool, [1, 2, 3], 15) for one in (expert, student)
        )
        acting = follow(student.policy("evaluate"))
        judged = evaluate_pair(acting, expert, own, pool, 15, 0, Progress(False))
    deviation = own.observations.reshape(-1, 5)[:, :4].std(axis=0)  # the last one never moves
    apart = (other.observations - own.observations)[..., :4] / deviation
    largest = np.sqrt((apart**2).mean(axis=2)).max(axis=1)
    assert len(set(largest.round(3))) == 3
    assert judged.imitation_gap == pytest.approx(largest.mean(), rel=1e-4)


@pytest.mark.fault(202)
@pytest.mark.parametrize("offset", [1e8, -1e9])
def test_observations_far_from_zero_are_refused_in_float32(offset):
    def shifted():
        box = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        plain = gymnasium.make("Pendulum-v1")
        return gymnasium.wrappers.TransformObservation(
            plain, lambda o: o.astype(np.float64) + offset, box
        )

    def swing(rows):
        return np.clip(-rows[:, 2:] + offset, -2, 2)

    with pytest.raises(EnvironmentFault, match="float32 rounds away how 3 of the 3"):
        fdtasil.distill(swing, shifted, 0, episodes=1, horizon=30, evaluation_episodes=2)


@pytest.mark.fault(202)
def test_a_single_coordinate_far_from_zero_is_warned_of():
    box = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    clock = gymnasium.wrappers.TransformObservation(
        gymnasium.make("Pendulum-v1"), lambda o: np.add(o, [0, 0, 1e9], dtype=np.float64), box
    )
    with EnvironmentPool(clock) as pool, pytest.warns(FdtasilWarning, match="how 1 of the 3"):
        rollout(follow(lambda rows: 0 * rows[:, :1]), pool, [1, 2], 30)


class InUnits(gymnasium.ObservationWrapper):
    """Metres of altitude beside radians of an angle: one law, other units."""

    def __init__(self, units):
        super().__init__(Integrator())
        self.units = np.asarray(units)

    def observation(self, observation):
        return (observation * self.units).astype(np.float32)


@pytest.mark.slow
@pytest.mark.fault(230)
@pytest.mark.parametrize("probes", [0, 5])
def test_a_coordinate_in_small_units_is_seen_and_probed(probes):
    def error(units):
        def law(rows):
            return np.tanh(rows / np.asarray(units, np.float32) @ GAIN.T)

        run = {"episodes": 3, "horizon": 40, "fit": Fit(steps=400), "student": Mlp(32)}
        result = fdtasil.distill(
            law, lambda: InUnits(units), probes, evaluation_episodes=2, progress=False, **run
        )
        assert result.report["frozen_coordinates"] == 1  # the constant one
        return result.evaluation.action_error

    usual = error([1.0, 1.0, 1.0, 1.0, 1.0])
    with pytest.warns(FdtasilWarning, match=r"1 coordinates deviate by less .* \(2: "):
        small = error([1e4, 1e4, 1e-3, 1e4, 1.0])
    assert small == pytest.approx(usual, rel=0.2)


def test_small_units_are_told_of_once_in_a_run_of_several_rounds():
    units = np.asarray([1e4, 1e4, 1e-3, 1e4, 1.0], np.float32)
    run = {"episodes": 3, "horizon": 20, "fit": Fit(steps=100), "student": Mlp(8)}
    with pytest.warns(FdtasilWarning) as told:
        fdtasil.distill(
            lambda rows: np.tanh(rows / units @ GAIN.T),
            lambda: InUnits(units),
            0,
            trainer=fdtasil.DAgger(updates=(1, 2)),
            evaluation_episodes=2,
            progress=False,
            **run,
        )
    assert sum("ten-thousandth" in str(one.message) for one in told) == 1


@pytest.mark.fault(230)
def test_dust_is_no_movement():
    states = np.random.default_rng(0).standard_normal((100, 3)) * [1.0, 2.0, 1e-14]
    scales = measure_scales(states)
    assert scales.live.tolist() == [True, True, False]
    assert scales.scale[2] == 1.0


def test_what_moves_in_float32_is_live_beside_any_offset_and_unit():
    """Three hundredths of a kelvin at 300; of a second at a million, they are rounding."""
    states = np.random.default_rng(0).standard_normal((100, 4)) * [1.0, 2.0, 0.03, 0.03]
    scales = measure_scales(states * [1e12, 1, 1, 1] + [0, 0, 300, 1e6])
    assert scales.live.tolist() == [True, True, True, False]
    assert scales.units[2:] == pytest.approx([states[:, 2].std(), 1.0])
    told = scales.spread_by({3: 0.5})
    assert told.live.all()
    assert told.told.tolist() == [False, False, False, True]
    assert told.deviation[3] == told.scale[3] == told.units[3] == 0.5


@pytest.mark.fault(231)
def test_bounds_as_large_as_float32_are_none():
    largest = float(np.finfo(np.float32).max)
    states = np.random.default_rng(0).standard_normal((60, 5)).astype(np.float32)
    data = fdtasil.from_arrays(states, states @ GAIN.T, low=-largest, high=largest)
    result = fdtasil.distill(None, None, 0, dataset=data, student=Mlp(8), fit=Fit(steps=200))
    assert not np.isfinite(result.student.low.numpy()).any()
    assert result.history[-1]["action_error"] < 0.9 * result.history[0]["action_error"]


def noisy_and_smooth(unit):
    """Action 0 is noisy, though it repeats itself, and action 1 smooth, in a unit of its own."""

    def law(rows):
        rows = np.asarray(rows, np.float64)
        noise = 0.05 * np.sin(1e6 * rows.sum(axis=1))
        return np.stack([np.tanh(rows[:, 0]) + noise, unit * np.tanh(rows[:, 1])], axis=1)

    return law


@pytest.mark.fault(274)
@pytest.mark.parametrize("bounded", [True, False])
def test_an_action_in_millimetres_does_not_hide_the_noise_of_another(bounded):
    rows = np.random.default_rng(0).standard_normal((200, 4)).astype(np.float32)
    found = []
    for unit in (1.0, 1000.0):
        law, bound = noisy_and_smooth(unit), 1.1 * np.array([1.0, unit])
        ends = {"low": -bound, "high": bound} if bounded else {}
        data = fdtasil.from_arrays(rows, law(rows), **ends)
        result = fdtasil.distill(law, probes=3, dataset=data, fit=Fit(steps=5), student=Mlp(4))
        found.append(result.report["calibration"])
    assert found[0]["regime"] == found[1]["regime"] != "smooth"
    assert found[0]["stencil"] == found[1]["stencil"] == "central"
    assert found[1]["noise_floor"] == pytest.approx(found[0]["noise_floor"], rel=0.3)


@pytest.mark.fault(274)
def test_one_action_in_millimetres_makes_no_law_steep():
    rows = np.random.default_rng(0).standard_normal((500, 17)).astype(np.float32)
    weights = 1.5 * np.random.default_rng(1).standard_normal((17, 40)) / 17**0.5
    for units in (np.ones(40), np.array([1000.0, *[1] * 39])):
        law = lambda x, units=units: units * np.tanh(x @ weights)  # noqa: E731
        data = fdtasil.from_arrays(rows, law(rows))
        result = fdtasil.distill(law, probes=3, dataset=data, fit=Fit(steps=5), student=Mlp(4))
        assert result.report["calibration"]["match"] is None


def scaled_actions(unit):
    """Return a function that makes an environment of two actions, one of them in a unit."""
    box = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    return lambda: gymnasium.wrappers.TransformAction(
        Integrator(), lambda action: np.clip(action / [unit, 1.0], -1, 1), box
    )


@pytest.mark.fault(274)
@pytest.mark.parametrize("unit", [1, 1000])
def test_another_expert_is_found_by_an_action_in_small_numbers_too(unit, tmp_path):
    law = lambda rows: np.tanh(rows[:, :2]) * [unit, -1.0]  # noqa: E731
    other = lambda rows: law(rows) * [1.0, -1.0]  # noqa: E731
    run = {**QUICK, "probes": 0}
    rows = np.random.default_rng(0).standard_normal((200, 5)).astype(np.float32)
    data = fdtasil.from_arrays(rows, law(rows))
    with pytest.warns(FdtasilWarning, match="otherwise than the demonstrations at 1[56] of 16"):
        fdtasil.distill(other, dataset=data, probes=0, fit=Fit(steps=5), student=Mlp(4))
    with pytest.raises(ZeroDivisionError):
        fdtasil.distill(law, scaled_actions(unit), out=tmp_path, callback=lambda _: 1 / 0, **run)
    with pytest.raises(SettingError, match="begun with another expert"):
        fdtasil.distill(other, scaled_actions(unit), resume=tmp_path, **run)


def test_an_action_that_is_rounding_makes_no_expert_another(tmp_path):
    law = lambda rows, sign=1: np.tanh(rows[:, :2]) * [1.0, sign * 1e-8]  # noqa: E731
    run = {**QUICK, "probes": 0}
    with pytest.raises(ZeroDivisionError):
        fdtasil.distill(law, TOY, out=tmp_path, callback=lambda _: 1 / 0, **run)
    fdtasil.distill(lambda rows: law(rows, -1), TOY, resume=tmp_path, **run)


@pytest.mark.fault(274)
@pytest.mark.parametrize("unit", [1, 1000])
def test_a_change_of_an_action_in_small_numbers_is_found_at_the_end(unit):
    changed = []  # told by the last event, before the expert is asked again

    def law(rows):
        return np.tanh(rows[:, :2]) * [unit, -1.0 if changed else 1.0]

    def change(event):
        if event.kind == "evaluation":
            changed.append(event)

    with pytest.warns(FdtasilWarning, match="has changed during the run.*altogether other"):
        fdtasil.distill(law, scaled_actions(unit), 1, callback=change, **QUICK)


@pytest.mark.fault(200)
@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_a_graph_that_jumps_has_no_twin_in_any_unit(unit, tmp_path):
    """A twin computes in float32 throughout, so its numbers are no whole ones."""
    nodes = [
        helper.make_node("Cast", ["obs"], ["whole"], to=TensorProto.INT32),
        helper.make_node("Cast", ["whole"], ["back"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["back", "unit"], ["actions"]),
    ]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 3])
        for name in ("obs", "actions")
    ]
    weights = [numpy_helper.from_array(np.float32(unit), "unit")]
    graph = helper.make_graph(nodes, "jumps", ends[:1], ends[1:], weights)
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), tmp_path / "j.onnx")
    assert fdtasil.load_expert(tmp_path / "j.onnx", 3, 3).module is None
