"""The Taylor loss: zero at the expert, and the analytic loss where the expert is smooth."""

import numpy as np
import pytest
import torch

from fdtasil.demonstrations import ask_probes, statistics
from fdtasil.experts import load_expert
from fdtasil.loss import Minibatch, taylor_loss
from fdtasil.presets import PRESETS
from fdtasil.probes import Probes
from fdtasil.student import Student, StudentShape


def smooth_expert(n=6, m=3):
    random = torch.Generator().manual_seed(3)
    shape = StudentShape(n, m, (32, 32), "gelu")
    zeros, ones = np.zeros(n), np.ones(n)
    return Student(shape, zeros, ones, -np.ones(m), np.ones(m), random).eval()


def batch_of(module, spec, states):
    """The whole stencil of every state, and the stencil's gain."""
    probes = PRESETS["standard"].complete(Probes.parse(spec))
    expert = load_expert(module)
    answers = ask_probes(expert, states, probes, statistics(states), np.random.default_rng(0))
    batch = Minibatch(
        torch.from_numpy(states),
        torch.from_numpy(expert.ask(states, "label")),
        torch.from_numpy(answers.displacements[answers.numbers]),
        torch.from_numpy(answers.values),
    )
    return batch, probes.stencil, answers.gain


@pytest.fixture
def states():
    return np.random.default_rng(0).standard_normal((40, 6)).astype(np.float32)


@pytest.mark.parametrize("spec", ["5", "basis,central", "orthogonal:4", "jacobian"])
def test_the_loss_is_zero_at_the_expert(states, spec):
    expert = smooth_expert()
    batch, stencil, gain = batch_of(expert, spec, states)
    loss = taylor_loss(expert, batch, stencil, 0.5, gain)
    assert float(loss.total) < 1e-4


def test_the_analytic_loss_and_gradient_agree_with_the_differences(states):
    """Standard basis, central; the analytic Jacobian taken along the same directions."""
    expert, student = smooth_expert(), smooth_expert()
    with torch.no_grad():
        for parameter in student.parameters():
            parameter.mul_(0.8)
    found = {}
    for spec in ("basis,central,radius=0.02", "jacobian"):
        student.zero_grad()
        batch, stencil, gain = batch_of(expert, spec, states)
        loss = taylor_loss(student, batch, stencil, 0.5, gain)
        loss.total.backward()
        gradient = torch.cat([p.grad.flatten() for p in student.parameters()])
        found[spec] = loss.total.detach(), gradient
    (fd_loss, fd_gradient), (loss, gradient) = found.values()
    assert float(abs(fd_loss - loss) / loss) < 1e-3
    assert float((fd_gradient - gradient).norm() / gradient.norm()) < 1e-3


def test_a_linear_difference_is_the_exact_derivative(states):
    """Student zero, expert x -> A x: the derivative error is |A S|_F whatever the radius."""
    matrix = torch.nn.Linear(6, 3, bias=False, device="cpu")
    with torch.no_grad():
        matrix.weight.copy_(torch.arange(18.0).reshape(3, 6))
    expected = float((matrix.weight * torch.from_numpy(states.std(axis=0))).norm())
    for spec in ("basis", "basis,central,radius=3", "orthogonal:6,radius=1", "jacobian"):
        batch, stencil, gain = batch_of(matrix, spec, states)
        loss = taylor_loss(lambda x: 0 * x[:, :3], batch, stencil, 1.0, gain)
        assert float(loss.derivative) == pytest.approx(expected, rel=1e-4), spec


@pytest.fixture(autouse=True)
def untouched_global_randomness():
    """torch.nn.Linear above draws its first weights from torch's own generator."""
