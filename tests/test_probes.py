"""Probe designs: a contract for every registered one, and what is special about each."""

import numpy as np
import pytest

from fdtasil.errors import SettingError
from fdtasil.probes.adaptive import AdaptiveDirections, is_redundant
from fdtasil.probes.directions import OrthogonalFrames, RandomSphere
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import DIRECTIONS, Probes
from fdtasil.probes.stencils import CENTRAL, FORWARD
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS


def design_of(name, count):
    """A design with so many directions, where it takes a number."""
    spec = name if name in ("basis", "jacobian") else f"{name}:{count}"
    return Probes.parse(spec).directions


def states(dimension, physical=None):
    """Demonstrated states; functions of `physical` coordinates only, if given."""
    random = np.random.default_rng(5)
    if physical is None:
        return random.standard_normal((200, dimension))
    return random.standard_normal((200, physical)) @ random.standard_normal((physical, dimension))


def test_half_the_adaptive_directions_are_excursions_where_observations_are_redundant():
    redundant = states(20, physical=3)
    bank, _ = AdaptiveDirections(10).around(redundant)(300, np.random.default_rng(0))
    basis = np.linalg.svd(redundant, full_matrices=False)[2][:3]
    possible = np.linalg.norm(bank @ basis.T, axis=1) > 0.999 * np.linalg.norm(bank, axis=1)
    assert 0.45 < possible.mean() < 0.55
    assert np.allclose(np.linalg.norm(bank[~possible], axis=1), 1)
    free, _ = AdaptiveDirections(10).around(states(20))(300, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(free, axis=1), 1)


def test_few_states_say_nothing_of_redundant_directions():
    """As many coordinates as states: what looks like few directions is few states."""
    assert not is_redundant(states(20, physical=3)[:20])
    assert not is_redundant(np.ones((30, 20)))
    assert is_redundant(states(20, physical=3))


def test_excursions_are_twice_as_long_as_states_of_two_passes_lie_apart():
    """A way is gone twice, 0.2 apart: the steps along it are shorter, and lead nowhere new."""
    way = np.stack([np.tile(np.linspace(0, 6, 200), 2), np.repeat([0, 0.2], 200)], axis=1)
    frame, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 2)))
    draw = AdaptiveDirections(10).around(way @ frame.T)
    bank, _ = draw(300, np.random.default_rng(0))
    along = bank @ frame
    possible = np.linalg.norm(along, axis=1) > 0.999 * np.linalg.norm(bank, axis=1)
    assert np.abs(along[possible, 0]).max() < 1e-5
    assert (along[possible, 1] ** 2).mean() == pytest.approx((2 * 0.2) ** 2, rel=0.1)


def test_half_of_the_probes_lead_to_possible_states_in_any_units():
    """Functions of three coordinates are moved along them, whatever unit each has."""
    units = 10.0 ** np.random.default_rng(1).uniform(-3, 3, 20)
    rows = (states(20, physical=3) * units).astype(np.float32)
    probes = PRESETS["standard"].complete(Probes.parse("10,radius=0.3")).with_order(1)
    drawn = Surroundings.of(rows, probes, measure_scales(rows)).sample(np.random.default_rng(0))
    moved = drawn.displacements / units
    basis = np.linalg.svd(rows / units, full_matrices=False)[2][:3]
    possible = np.linalg.norm(moved @ basis.T, axis=1) > 0.999 * np.linalg.norm(moved, axis=1)
    assert 0.45 < possible.mean() < 0.55


@pytest.mark.parametrize(
    ("deviations", "redundant"),
    [((1,) * 5 + (0.2,) * 7, False), ((1,) * 5 + (0.01,) * 7, True), ((1,) * 7 + (0,) * 5, False)],
)
def test_five_of_twelve_directions_are_few_where_they_hold_all_but_a_hundredth(
    deviations, redundant
):
    """Five of twelve hold 95 % of the variance, or nearly all of it; seven are more than half."""
    assert is_redundant(states(12) * deviations) == redundant


@pytest.mark.parametrize("dimension", [1, 3, 17])
@pytest.mark.parametrize("rows", [1, 40])
@pytest.mark.parametrize("design", DIRECTIONS)
def test_every_design_keeps_the_contract(design, rows, dimension):
    directions = design_of(design, 7)
    bank, numbers = directions.around(states(dimension))(rows, np.random.default_rng(0))
    assert bank.shape[1] == dimension
    assert numbers.shape == (rows, directions.count(dimension))
    assert np.allclose(np.linalg.norm(bank, axis=1), 1)
    assert numbers.min() >= 0
    assert numbers.max() < len(bank)
    again = directions.around(states(dimension))(rows, np.random.default_rng(0))
    assert np.array_equal(bank, again[0])
    assert np.array_equal(numbers, again[1])


@pytest.mark.parametrize("design", DIRECTIONS)
def test_the_mean_square_of_a_derivative_is_the_jacobians(design):
    """E over directions of d |J u|^2 is |J|_F^2: what makes one weight fit every design."""
    jacobian = np.random.default_rng(1).standard_normal((3, 6))
    directions = design_of(design, 12)
    bank, numbers = directions.around(states(6))(600, np.random.default_rng(0))
    squares = 6 * ((bank[numbers] @ jacobian.T) ** 2).sum(axis=-1)
    assert squares.mean() == pytest.approx((jacobian**2).sum(), rel=0.05)


@pytest.mark.fault(276)
@pytest.mark.parametrize("design", ["sphere:40", "orthogonal:4", "adaptive:40", "basis"])
@pytest.mark.parametrize("spread", [{}, {1: 20.0}, {0: 1.0, 1: 2.0, 2: 1.0, 3: 1.0}])
def test_the_mean_square_is_the_jacobians_where_parts_move_alone(design, spread):
    random = np.random.default_rng(0)
    scales = measure_scales(random.standard_normal((2000, 4))).spread_by(spread)
    jacobian = random.standard_normal((2, 4)) / scales.deviation
    probes = PRESETS["standard"].complete(Probes.parse(f"{design},radius=0.3")).with_order(1)
    rows = random.standard_normal((2000, 4)).astype(np.float32)
    drawn = Surroundings.of(rows, probes, scales).sample(random)
    moved = drawn.displacements[drawn.numbers] @ jacobian.T
    squares = ((drawn.gains[drawn.numbers][..., None] * moved) ** 2).sum(axis=-1)
    whole = ((jacobian * scales.deviation) ** 2).sum()
    assert squares.mean() == pytest.approx(whole, rel=0.05)
    assert drawn.displacements.any(axis=1).all()


@pytest.mark.fault(85)
def test_a_state_is_never_probed_along_the_same_direction_twice():
    _, sphere = RandomSphere(50).around(states(4))(3000, np.random.default_rng(0))
    _, frames = OrthogonalFrames(50).around(states(4))(3000, np.random.default_rng(0))
    for numbers in (sphere, frames[:, :4]):
        assert all(len(set(row)) == len(row) for row in numbers.tolist())


def test_few_states_share_no_direction():
    """A thousand directions are twenty-five times as many as those of one state."""
    for design in (RandomSphere(40), AdaptiveDirections(40)):
        _, numbers = design.around(states(4))(25, np.random.default_rng(0))
        assert len(np.unique(numbers)) == 1000


def test_frames_prefer_no_side():
    """A forward difference tells one side of a kink: half of them must lie on each."""
    bank, numbers = OrthogonalFrames(2).around(states(3))(9000, np.random.default_rng(0))
    above = (bank.reshape(-1, 3, 3) > 0).mean(axis=0)
    assert above == pytest.approx(np.full((3, 3), 0.5), abs=0.06)
    assert len(np.unique(numbers)) > 0.95 * len(bank)


def test_states_have_directions_of_their_own_where_answers_are_kept():
    """Of those that are asked anew in a moment, some share them: drawing takes time."""
    rows = states(4).astype(np.float32)
    for spec, least in (("sphere:10", 2000), ("sphere:10,resample", 1000)):
        probes = PRESETS["standard"].complete(Probes.parse(f"{spec},radius=1")).with_order(1)
        drawn = Surroundings.of(rows, probes, measure_scales(rows))
        assert len(np.unique(drawn.sample(np.random.default_rng(0)).numbers)) >= least


@pytest.mark.parametrize("design", [RandomSphere(5000), OrthogonalFrames(8)])
def test_many_probes_of_few_states_are_all_different(design):
    for rows in (1, 3):
        _, numbers = design.around(states(5))(rows, np.random.default_rng(0))
        assert all(len(set(row)) == design.probes for row in numbers.tolist())


def test_a_whole_frame_is_orthonormal():
    bank, numbers = OrthogonalFrames(None).around(states(5))(9, np.random.default_rng(0))
    for frame in bank[numbers]:
        assert np.allclose(frame @ frame.T, np.eye(5), atol=1e-12)


@pytest.mark.parametrize("stencil", [FORWARD, CENTRAL])
def test_every_difference_is_exact_on_a_line_and_of_its_order_on_a_parabola(stencil):
    def difference(f, x, h):
        values = [f(x + offset * h) for offset in stencil.offsets]
        return (np.dot(stencil.weights, values) + stencil.centre * f(x)) / h

    assert difference(lambda x: 3 * x + 1, 0.7, 0.5) == pytest.approx(3)
    truncation = difference(lambda x: x**2, 0.7, 0.5) - 1.4
    assert truncation == pytest.approx(0 if stencil is CENTRAL else 0.5)


@pytest.mark.parametrize(
    "spec",
    [
        "sphere:10",
        "adaptive:7,central",
        "sphere:10,labels",
        "orthogonal:4,central",
        "basis",
        "jacobian",
        "sphere:3,resample,radius=0.1,raw",
        "sphere:50,per_step=all",
        "basis,central,whitened,per_step=2",
        "orthogonal:all,central",
        "fresh",
        "fresh:20,labels,radius=0.1..1",
        "10,both,central,radius=wide",
    ],
)
def test_a_spec_reads_back(spec):
    probes = Probes.parse(spec)
    assert Probes.parse(probes.describe()) == probes


def test_short_specs():
    assert Probes.parse(0) is None
    assert Probes.parse("none") is None
    assert Probes.parse(10) == Probes.parse("10") == Probes.parse("adaptive:10")
    assert Probes.parse("10,central") == Probes.parse("adaptive:10,central")
    assert Probes.parse("sphere") == Probes.parse("sphere:10")
    assert Probes.parse("fresh") == Probes.parse("10,resample,radius=wide")
    few = Probes.parse("fresh:3,differences")
    assert few == Probes.parse("3,differences,resample,radius=wide")
    matches = [Probes.parse("fresh").with_order(order).match for order in (1, 2)]
    assert matches == ["labels", "both"]


@pytest.mark.parametrize(
    ("spec", "stencil"),
    [("10,labels", FORWARD), ("10,both", FORWARD), ("10,radius=0.1..1", FORWARD), ("10", None),
     ("10,both,central", CENTRAL)],
)  # fmt: skip
def test_a_label_needs_no_other_side(spec, stencil):
    """Elsewhere a calibration finds whether both sides are asked, unless somebody says it."""
    assert Probes.parse(spec).with_order(1, usual=None).stencil is stencil


@pytest.mark.fault(84, 86)
@pytest.mark.parametrize(
    "spec",
    [-1, 2.0, True, "spere:3", "sphere:0", "sphere:x", "basis:3", "sphere:3,radius=0",
     "jacobian,central", "sphere:all", "sphere:3,radius=nan", "sphere:3,odd",
     "sphere:3,per_step=0", "sphere:3,radius", "", "fresh:0", "fresh,radius=2..1",
     "fresh,radius=1..", "fresh,radius=0..1", "fresh,radius=1..2..3", "fresh,radius=far",
     "jacobian,both"],
)  # fmt: skip
def test_a_wrong_spec_is_refused_with_an_example(spec):
    with pytest.raises(SettingError, match="next step"):
        Probes.parse(spec)


def test_predicted_queries():
    assert Probes.parse("basis,central").queries(10, 7, visits=99) == 140
    assert Probes.parse("jacobian").queries(10, 7, visits=99) == 0
    assert Probes.parse("sphere:4,forward,resample").queries(10, 7, visits=9) == 3 * 40


def test_a_system_at_rest_has_no_probes_of_no_length():
    """Where many states are one, what lies nearest is the same state."""
    time = np.arange(3000)
    settling = np.stack([0.9**time, 0.5**time], axis=1).round(6)
    states = (settling @ np.random.default_rng(0).standard_normal((2, 12))).astype(np.float32)
    assert is_redundant(states)
    bank, _ = AdaptiveDirections(10).around(states)(len(states), np.random.default_rng(1))
    assert np.linalg.norm(bank, axis=1).min() > 0.01
