"""The examples do what they say."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import fdtasil

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def cart_pole(monkeypatch):
    pytest.importorskip("casadi")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield import_module("constrained_cart_pole")
    sys.modules.pop("constrained_cart_pole")


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore::fdtasil.FdtasilWarning")
def test_a_planner_with_hard_limits(cart_pole):
    rest, lost = np.zeros(4), np.array([0.99, 0.0, 2.0, 0.0])  # too fast for what is left of it
    answers = cart_pole.controller(np.stack([rest, lost]))
    assert abs(answers[0, 0]) < 1e-3
    assert np.isnan(answers[1, 0])
    result = fdtasil.distill(
        cart_pole.controller,
        cart_pole.CartPole,
        2,
        episodes=1,
        horizon=20,
        evaluation_episodes=2,
        student=fdtasil.Mlp(16),
        fit=fdtasil.Fit(steps=40),
        constraints=cart_pole.LIMITS,
        progress=False,
    )
    ((name, *shares),) = result.evaluation.violations
    assert name == "rail"
    assert all(0 <= share < 0.5 for share in shares)
