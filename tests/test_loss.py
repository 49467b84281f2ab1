"""The Taylor loss: zero at the expert, and the analytic loss where the expert is smooth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.stencils import EXACT
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS
from fdtasil.student.architectures import ACTIVATIONS, Mlp
from fdtasil.student.fit import Fit
from fdtasil.student.loss import Minibatch, ProbeBatch, Weights, taylor_loss
from fdtasil.student.policy import Student


def smooth_expert(n=6, m=3):
    random = torch.Generator().manual_seed(3)
    zeros, ones = np.zeros(n), np.ones(n)
    return Student(Mlp((32, 32)), zeros, ones, -np.ones(m), np.ones(m), random).eval()


def weaker_expert(n=6):
    """The expert with smaller weights, as a student that has something to learn."""
    student = smooth_expert(n)
    with torch.no_grad():
        for parameter in student.parameters():
            parameter.mul_(0.8)
    return student


def batch_of(module, spec, states, order=1):
    """The whole stencil of every state, and which it is."""
    probes = (
        replace(PRESETS["standard"], calibrated=False)
        .complete(Probes.parse(spec))
        .with_order(order)
    )
    expert = load_expert(module, states.shape[1])
    random = np.random.default_rng(0)
    around = Surroundings.of(states, probes, measure_scales(states))
    answers = ask_probes(expert, around, random, order)
    around = ProbeBatch(
        torch.from_numpy(answers.displacements[answers.numbers]),
        torch.from_numpy(answers.values),
        torch.from_numpy(answers.gains[answers.numbers]).float(),
    )
    labels = torch.from_numpy(expert.ask(states, "label"))
    return Minibatch(torch.from_numpy(states), labels, around), probes.stencil


@pytest.fixture
def states():
    return np.random.default_rng(0).standard_normal((40, 6)).astype(np.float32)


@pytest.mark.parametrize(
    "spec",
    ["5", "basis,central", "orthogonal:4", "jacobian", "sphere:5,labels", "5,both,radius=0.1..2"],
)
def test_the_loss_is_zero_at_the_expert(states, spec):
    expert = smooth_expert()
    batch, stencil = batch_of(expert, spec, states)
    weights = Weights(0.5, moved=None if spec == "jacobian" else 1.0)
    loss = taylor_loss(expert, batch, stencil, weights)
    assert float(loss.loss) < 1e-4


def test_the_analytic_loss_and_gradient_agree_with_the_differences(states):
    """Standard basis, central; the analytic Jacobian taken along the same directions."""
    expert, student = smooth_expert(), weaker_expert()
    found = {}
    for spec in ("basis,central,radius=0.02", "jacobian"):
        student.zero_grad()
        batch, stencil = batch_of(expert, spec, states)
        loss = taylor_loss(student, batch, stencil, Weights(0.5))
        loss.loss.backward()
        gradient = torch.cat([p.grad.flatten() for p in student.parameters()])
        found[spec] = loss.loss.detach(), gradient
    (fd_loss, fd_gradient), (loss, gradient) = found.values()
    assert float(abs(fd_loss - loss) / loss) < 1e-3
    assert float((fd_gradient - gradient).norm() / gradient.norm()) < 1e-3


@pytest.mark.filterwarnings("error")  # a derivative that has no batched form is slow, and warns
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_jacobian_by_rows_and_by_columns_is_one_loss(activation):
    """Of four actions: six directions at once go by its rows, each alone by its columns."""
    random = torch.Generator().manual_seed(5)
    student = Mlp((8, 8), activation).build(6, 4, random)
    state, along, slopes, labels = (
        torch.randn(1, *shape, generator=random) for shape in ((6,), (6, 6), (6, 1, 4), (4,))
    )

    def squares(part):
        """Return the squared error of the derivatives along these directions, and its gradient."""
        around = ProbeBatch(along[:, part], slopes[:, part], torch.ones(1, len(along[0, part])))
        found = taylor_loss(student, Minibatch(state, labels, around), EXACT, Weights(1.0))
        total = found.derivative_error**2 * len(along[0, part])
        parameters = [p for p in student.parameters() if p.shape != (4,)]  # but the last bias
        gradient = torch.autograd.grad(total, parameters)
        return total.detach(), torch.cat([part.flatten() for part in gradient])

    total, gradient = squares(slice(None))
    alone = [squares(slice(number, number + 1)) for number in range(6)]
    assert float(total) == pytest.approx(float(sum(part for part, _ in alone)), rel=1e-5)
    torch.testing.assert_close(gradient, sum(part for _, part in alone), rtol=1e-4, atol=1e-5)


def test_a_linear_difference_is_the_exact_derivative(states):
    """Student zero, expert x -> A x: the derivative error is |A S|_F whatever the radius."""
    matrix = torch.nn.Linear(6, 3, bias=False, device="cpu")
    with torch.no_grad():
        matrix.weight.copy_(torch.arange(18.0).reshape(3, 6))
    expected = float((matrix.weight * torch.from_numpy(states.std(axis=0))).norm())
    for spec in ("basis", "basis,central,radius=3", "orthogonal:6,radius=1", "jacobian"):
        batch, stencil = batch_of(matrix, spec, states)
        loss = taylor_loss(lambda x: 0 * x[:, :3], batch, stencil, Weights(1.0))
        assert float(loss.derivative_error) == pytest.approx(expected, rel=1e-4), spec


def test_labels_are_the_action_error_at_the_moved_states(states):
    expert, student = smooth_expert(), weaker_expert()
    batch, stencil = batch_of(expert, "sphere:1,labels,radius=0.5..3", states)
    loss = taylor_loss(student, batch, stencil, Fit().weights("labels"))
    moved = batch.observations + batch.probes.displacements[:, 0]
    with torch.no_grad():
        error = (student(moved) - expert(moved)).norm(dim=-1).mean()
    assert float(loss.moved_error) == pytest.approx(float(error), rel=1e-4)
    assert float(loss.derivative_error) == 0
    assert float(loss.loss) == pytest.approx(float(loss.action_error + error), rel=1e-4)


@pytest.mark.parametrize("spec", ["sphere:1,labels", "sphere:5,labels", "sphere:3,central,labels"])
def test_a_label_weighs_the_same_for_every_number_of_them(states, spec):
    expert = smooth_expert()
    batch, stencil = batch_of(expert, spec, states)
    loss = taylor_loss(lambda x: expert(x).detach() + 1, batch, stencil, Fit().weights("labels"))
    assert float(loss.moved_error) == pytest.approx(3**0.5, rel=1e-4)
    assert float(loss.loss) == pytest.approx(2 * 3**0.5, rel=1e-4)


def test_both_are_the_sum_of_labels_and_differences(states):
    """Each difference is measured in units of its own distance."""
    expert, student = smooth_expert(), weaker_expert()
    batch, stencil = batch_of(expert, "sphere:1,both,radius=0.5..3", states)
    weights = Fit(weight=0.25, moved_weight=2.0).weights("both")
    loss = taylor_loss(student, batch, stencil, weights)
    moved = batch.observations + batch.probes.displacements[:, 0]
    with torch.no_grad():
        here, there = (student(x) - expert(x) for x in (batch.observations, moved))
        steps = (batch.probes.displacements[:, 0] / states.std(axis=0)).norm(dim=-1)
        change = ((there - here).norm(dim=-1) * states.shape[1] ** 0.5 / steps).mean()
    assert float(loss.derivative_error) == pytest.approx(float(change), rel=1e-4)
    expected = here.norm(dim=-1).mean() + 0.25 * change + 2 * there.norm(dim=-1).mean()
    assert float(loss.loss) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize(
    ("spec", "order", "weights"),
    [
        ("5,central,both", 2, Weights(0.5, 0.1, 1.0)),
        ("jacobian", 2, Weights(0.5, 0.1)),
        ("jacobian", 1, Weights(0.5)),
        ("5", 1, None),
    ],
)
def test_every_term_is_in_units_of_the_actions(states, spec, order, weights):
    """Student and expert a thousand times as loud in one action, and as quiet in another."""
    student, units = weaker_expert(), torch.tensor([1.0, 1e3, 1e-3])
    batch, stencil = batch_of(smooth_expert(), spec, states, order)
    if weights is None:
        batch, stencil, weights = replace(batch, probes=None), None, Weights(None)
    probes = batch.probes and replace(batch.probes, values=units * batch.probes.values)
    scaled = replace(batch, actions=units * batch.actions, probes=probes)
    usual = taylor_loss(student, batch, stencil, weights)
    found = taylor_loss(lambda x: units * student(x), scaled, stencil, weights, units)
    torch.testing.assert_close(torch.stack(found), torch.stack(usual), rtol=1e-3, atol=1e-6)
    terms = [1.0, weights.derivative, weights.curvature, weights.moved]
    parts = sum(weight * part for weight, part in zip(terms, usual[1:], strict=True) if weight)
    assert float(usual.loss.detach()) == pytest.approx(float(parts.detach()))


def test_distances_are_spread_evenly_over_their_orders_of_magnitude(states):
    many = np.tile(states, (20, 1))
    batch, _ = batch_of(smooth_expert(), "sphere:2,radius=0.01..1", many)
    whitened = batch.probes.displacements / many.std(axis=0)
    lengths = (whitened.norm(dim=-1) / states.shape[1] ** 0.5).flatten().numpy()
    assert lengths.min() >= 0.0099
    assert lengths.max() <= 1.01
    shares = np.histogram(np.log10(lengths), bins=[-2.1, -1.5, -1, -0.5, 0.1])[0] / len(lengths)
    assert shares == pytest.approx([0.25] * 4, abs=0.05)


def test_second_differences_agree_with_exact_second_derivatives():
    """Ten inputs, the same directions: central differences against the analytic reference."""
    states = np.random.default_rng(0).standard_normal((40, 10)).astype(np.float32)
    expert, student = smooth_expert(10), weaker_expert(10)
    found = {}
    for spec in ("orthogonal:10,central,radius=0.05", "jacobian"):
        student.zero_grad()
        batch, stencil = batch_of(expert, spec, states, order=2)
        loss = taylor_loss(student, batch, stencil, Weights(0.5, 0.1))
        loss.loss.backward()
        gradient = torch.cat([p.grad.flatten() for p in student.parameters()])
        found[spec] = loss.curvature_error.detach(), gradient
    (differences, fd_gradient), (exact, gradient) = found.values()
    assert float(exact) > 0.1
    assert float(abs(differences - exact) / exact) < 0.02
    assert float((fd_gradient - gradient).norm() / gradient.norm()) < 0.02


def test_a_parabola_has_its_own_second_difference(states):
    """z'Hz of x -> |x|^2 / 2 in whitened coordinates, whatever the radius."""

    class Parabola(torch.nn.Module):
        def forward(self, x):
            """(B, n) -> (B, 1)."""
            return (x**2).sum(dim=1, keepdim=True) / 2

    curvatures = []
    for spec in ("orthogonal:6,central", "orthogonal:6,central,radius=2", "jacobian"):
        batch, stencil = batch_of(Parabola(), spec, states, order=2)
        loss = taylor_loss(lambda x: 0 * x[:, :1], batch, stencil, Weights(1.0, 1.0))
        curvatures.append(float(loss.curvature_error.detach()))
    # E |u'Hu|, sqrt of the mean over a frame, lies near the trace of the whitened Hessian.
    assert curvatures == pytest.approx([float((states.std(axis=0) ** 2).sum())] * 3, rel=0.05)


@pytest.fixture(autouse=True)
def untouched_global_randomness():
    """torch.nn.Linear above draws its first weights from torch's own generator."""
