"""What a student does not see, and what follows from what it sees: probes move both."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import QUICK
from gymnasium.spaces import Box
from toy_environments import Integrator

import fdtasil
from fdtasil.probes.scales import measure_following, measure_scales

SEEN = (0, 1, 2, 3, 4)
COPY, SUM, OWN = 5, 6, 7


class Copied(Integrator):
    """With a copy of the first position, twice the sum of both, and a number of its own."""

    def __init__(self):
        super().__init__()
        self.observation_space = Box(-np.inf, np.inf, (8,), np.float64)

    def reset(self, *, seed=None, options=None):
        self.own = 0.0
        return super().reset(seed=seed)

    def _observe(self):
        self.own = 0.5 * self.own + float(self.np_random.normal())
        further = [self.position[0], 2 * self.position.sum(), self.own]
        return np.concatenate([super()._observe(), further])


def law(rows):
    """Reacts to the copy, the sum and the velocities, not to the positions themselves."""
    forces = np.stack([rows[:, COPY] + rows[:, 2], 0.2 * rows[:, SUM] + rows[:, 3]], axis=1)
    return np.tanh(-forces)


def distilled(probes, **given):
    quick = {**QUICK, "evaluation_episodes": 0, "horizon": 40} | given
    return fdtasil.distill(law, Copied, probes, student_obs=SEEN, **quick)


@pytest.mark.fault(355)
@pytest.mark.parametrize(
    "probes", ["sphere:4,forward", "adaptive:4,central", "basis", "orthogonal:3", "fresh"]
)
def test_probes_move_it_along(probes):
    result = distilled(probes)
    moves = result.answers.displacements
    assert np.abs(moves[:, :2]).max() > 0.01
    assert moves[:, COPY] == pytest.approx(moves[:, 0], abs=1e-5)
    assert moves[:, SUM] == pytest.approx(2 * moves[:, :2].sum(axis=1), abs=1e-5)
    assert (moves[:, OWN] == 0).all()
    assert result.report["following_coordinates"] == 2


@pytest.mark.slow
def test_the_student_learns_the_whole_reaction():
    """Of an expert that reads a copy alone: asked about contradictions, it would not react."""
    fit = fdtasil.Fit(steps=1500)
    result = distilled("fresh", fit=fit, student=fdtasil.Mlp(32), episodes=4)
    random = np.random.default_rng(0)
    place, speed = random.uniform(-1, 1, (200, 2)), random.uniform(-0.3, 0.3, (200, 2))
    seen = np.concatenate([place, speed, np.full((200, 1), 3.0)], axis=1)
    whole = np.zeros((200, 8))
    whole[:, :5], whole[:, COPY], whole[:, SUM] = seen, place[:, 0], 2 * place.sum(axis=1)
    apart = np.abs(result.student.act(seen.astype(np.float32)) - law(whole))
    assert apart.mean() < 0.05


def rows(count=200):
    random = np.random.default_rng(0)
    free = random.standard_normal((count, 3)) * (1.0, 100.0, 0.01)
    noisy = free[:, :1] + 0.05 * random.standard_normal((count, 1))
    curved = np.sin(2 * free[:, :1])
    both = free[:, :1] + 0.01 * free[:, 1:2]
    return np.concatenate([free, 7 - 2 * free[:, 1:2], both, noisy, curved], axis=1)


def following(states, seen, hidden):
    n = states.shape[1]
    scales = measure_scales(states, np.isin(np.arange(n), seen))
    return measure_following(states, scales, np.isin(np.arange(n), hidden))


def test_what_follows_in_its_own_units():
    found = following(rows(), [0, 1, 2], [3, 4, 5, 6])
    expected = np.zeros((7, 7))
    expected[1, 3], expected[0, 4], expected[1, 4] = -2, 1, 0.01
    assert found == pytest.approx(expected, abs=1e-6)  # not the noisy one, nor the curved one


@pytest.mark.parametrize(
    ("states", "seen", "hidden"),
    [
        (rows(), [0, 1, 2], [5, 6]),  # nothing that follows
        (rows(), [0, 1, 2], []),  # a whole view
        (rows(), [0, 2], [3]),  # what it follows from is hidden too
        (rows(8), [0, 1, 2], [3]),  # too few to say
        (np.ones((200, 4)), [0, 1], [2, 3]),  # nothing moves
    ],
)
def test_what_does_not_follow(states, seen, hidden):
    assert following(states, seen, hidden) is None


def test_what_is_seen_or_held_never_follows():
    found = following(rows(), [0, 1, 2, 3], [4])
    assert not found[:, :4].any()


class OfPart(torch.nn.Module):
    """The law of what is seen: a copy of the first position stands for the hidden one, or 0."""

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, seen):
        first = self.weight * seen[:, 0]
        both = 2 * (seen[:, 0] + seen[:, 1])
        return torch.tanh(-torch.stack([first + seen[:, 2], 0.2 * both + seen[:, 3]], dim=1))


@pytest.mark.parametrize(("weight", "least", "most"), [(1.0, 0.0, 1e-3), (0.0, 0.1, 1.0)])
def test_a_student_that_hides_a_copy_is_looked_at_as_it_was_taught(weight, least, most):
    result = replace(distilled(0), student=OfPart(weight))
    brief = {"episodes": 2, "horizon": 40, "steps": 5, "progress": False}
    error = fdtasil.diagnose(result, law, Copied, **brief).fidelity.error
    assert least <= error <= most
