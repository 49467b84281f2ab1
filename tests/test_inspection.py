"""`fdtasil.inspect`: what an expert is, in Python, in a notebook and as JSON."""

import html
import json

import gymnasium
import numpy as np
import pytest
from conftest import GAIN, TOY, mlp_onnx
from gymnasium.spaces import Box, Dict, Discrete

import fdtasil
from fdtasil.errors import ExpertError

BRIEF = {"episodes": 2, "horizon": 20}


def test_a_sound_expert_is_shown_with_its_noise_and_its_return(linear):
    found = fdtasil.inspect(linear, TOY, **BRIEF)
    assert (found.problem, found.observations, found.memory, found.horizon) == (None, 5, 0, 20)
    assert found.calibration.regime == "smooth"
    assert np.mean(found.returns) > found.chance
    shown = str(found)
    for promised in ("determinism", "batch independence", "noise floor", "return", "ended early"):
        assert promised in shown
    assert html.escape(shown) in found._repr_html_()
    whole = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert whole["returns"] == list(found.returns)
    assert {one["problem"] for one in whole["findings"]} == {None}
    assert whole["calibration"]["radius"] == found.calibration.radius
    assert fdtasil.inspect(linear, TOY, **BRIEF).to_json() == whole


@pytest.mark.parametrize(
    ("expert", "named"),
    [
        (lambda rows: rows[:, :3] @ GAIN.T[:3, :1], "answers"),  # of one action for two
        ("no such file.onnx", "opening"),
        (lambda rows: rows @ GAIN.T + np.arange(len(rows))[:, None], "batch independence"),
    ],
)
def test_what_is_no_expert_is_shown_with_its_problem(expert, named):
    found = fdtasil.inspect(expert, TOY, **BRIEF)
    assert isinstance(found.problem, ExpertError)
    assert next(one.name for one in found.findings if one.problem) == named
    assert f"{named:20}FAILED: " in str(found)
    assert str(found.problem) in [one["problem"] for one in found.to_json()["findings"]]


def test_nothing_that_can_be_moved_is_no_calibration():
    """A mode, and a number that stands still: `distill` clones plainly there."""

    class Modes(gymnasium.Env):
        observation_space = Dict({"mode": Discrete(2), "still": Box(0, 9, (1,), np.float32)})
        action_space = Box(-1, 1, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self._observed(), {}

        def step(self, action):
            return self._observed(), 1.0 + float(action[0]), False, False, {}

        def _observed(self):
            return {"mode": self.np_random.integers(2), "still": np.full(1, 3, np.float32)}

    law = lambda seen: seen["mode"].reshape(-1, 1) * 0.5  # noqa: E731
    found = fdtasil.inspect(law, Modes, episodes=2, horizon=20)
    assert (found.problem, found.calibration) == (None, None)


@pytest.mark.slow
def test_a_shell_prints_it_as_json_alone(inside, tmp_path):
    expert = mlp_onnx(tmp_path / "e.onnx")
    line = ("inspect", expert, TOY, "--episodes", 2, "--json")
    shown = inside(*line, "-", "--picture", tmp_path / "ladder.png")
    assert shown.returncode == 0, shown.stderr
    assert json.loads(shown.stdout)["expert"] == str(expert)
    assert (tmp_path / "ladder.png").stat().st_size > 1000
    written = inside(*line, tmp_path / "found.json", "--picture", tmp_path / "again.png")
    assert "noise floor" in written.stdout
    assert f"written: {tmp_path / 'again.png'}" in written.stdout
    assert json.loads((tmp_path / "found.json").read_text()) == json.loads(shown.stdout)
    failed = inside("inspect", expert, "CartPole-v1", "--json", "-")
    assert failed.returncode == 1
    assert json.loads(failed.stdout)["findings"][-1]["problem"].startswith(str(expert))
