"""Every maker of black boxes makes one that passes the gate and can be distilled."""

import importlib.util
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import fdtasil

sys.path.append(str(Path(__file__).parents[1]))  # the benchmarks are not installed
from benchmarks.black_boxes import BLACK_BOXES, BlackBox, measure
from benchmarks.black_boxes.bang_bang import bang_bang
from benchmarks.black_boxes.forest import make_forest
from benchmarks.black_boxes.int8 import make_int8
from benchmarks.black_boxes.mpc import SamplingController, make_mpc

QUICK = {
    "episodes": 2,
    "horizon": 10,
    "student": fdtasil.Mlp(16),
    "fit": fdtasil.Fit(steps=20),
    "evaluation_episodes": 2,
}
TINY = {
    "forest": partial(make_forest, trees=4, rounds=2, episodes=1, horizon=20),
    "int8": partial(make_int8, episodes=1, horizon=20),
    "mpc": partial(make_mpc, workers=1, samples=8),
}


def small(kind: str) -> BlackBox:
    """Return a kind with a setting that takes a second to make."""
    box = BLACK_BOXES[kind]
    for library in box.needs:
        if importlib.util.find_spec(library) is None:
            pytest.skip(f'{kind} needs {library}: pip install "fdtasil[bench]"')
    return replace(box, make=TINY.get(kind, box.make))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:2 coordinates stand still")  # of Reacher: the goal
@pytest.mark.fault(29, 44)
@pytest.mark.parametrize("kind", BLACK_BOXES)
def test_kind_passes_the_gate_and_is_distilled(kind, tmp_path):
    box = small(kind)
    with box.open(tmp_path) as expert:
        result = fdtasil.distill(expert, box.environment, 3, **QUICK)
    assert result.queries["probe"] >= 3 * 2 * 10
    assert np.isfinite(result.evaluation.student_return)


@pytest.mark.parametrize("kind", ["forest", "int8", "float16"])
def test_equal_makings_give_equal_answers(kind, tmp_path):
    box, returns = small(kind), []
    for folder in ("first", "second"):
        with box.open(tmp_path / folder) as expert:
            returns.append(measure(expert, box.environment, 20, 1).returns[0])
    assert returns[0] == returns[1]


def test_the_planner_answers_each_row_for_itself():
    random = np.random.default_rng(0)
    rows = random.standard_normal((5, 10)).astype(np.float32)
    controller = SamplingController(samples=8, steps=4)
    together = controller(rows)
    alone = np.concatenate([controller(row[None]) for row in rows])
    np.testing.assert_allclose(together, alone, atol=1e-12)
    np.testing.assert_array_equal(together, SamplingController(samples=8, steps=4)(rows))


def test_the_planner_and_the_swing_up_law_are_good():
    planner = measure(SamplingController(samples=32), "Reacher-v5", 50, 3)
    assert planner.returns.mean() > -10  # random torques: -43
    law = measure(bang_bang, "Pendulum-v1", 200, 5)
    assert law.returns.mean() > -400  # random torques: -1200
    assert (law.rewards[:, -20:] > -0.1).all()  # upright at the end, and still
