"""What holds for every size, scale and text that Hypothesis thinks of, not for examples only."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import GAIN, mlp_onnx
from hypothesis import given, settings
from hypothesis import strategies as st

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.experts.load import load_expert
from fdtasil.files.storage import sha256, verify, write_folder
from fdtasil.probes.answers import Answers, ask_probes
from fdtasil.probes.calibration import Calibration, Ladder, calibrate
from fdtasil.probes.directions import Jacobian, OrthogonalFrames
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import DIRECTIONS, Probes
from fdtasil.probes.stencils import CENTRAL, EXACT, FORWARD
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import torch_generator
from fdtasil.student.architectures import ACTIVATIONS, Mlp
from fdtasil.student.fit_state import FitState
from fdtasil.student.loss import TaylorLoss
from fdtasil.student.policy import Student


def few(examples):
    """Equal examples each time, and no time limit: other runs are busy on the same cores."""
    return settings(max_examples=examples, derandomize=True, deadline=None, database=None)


seeds = st.integers(0, 2**32 - 1)


def random_array(seed, shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


# --- finite differences


@pytest.mark.fault(66, 85, 87, 89, 90)
@pytest.mark.parametrize("design", ["basis", "orthogonal:all"])
@pytest.mark.parametrize("stencil", ["forward", "central"])
@few(25)
@given(
    sizes=st.tuples(st.integers(1, 40), st.integers(1, 6)),
    exponents=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    offset=st.floats(0, 1e3),
    seed=seeds,
)
def test_a_linear_experts_jacobian_is_exact(design, stencil, sizes, exponents, offset, seed):
    """Coordinates of scales from 0.001 to 1,000 that lie up to 1,000 away from zero.

    The relative error is that of the whitened Jacobian, whose norm the loss is made of. Student
    and expert are differenced at the same float32 points, so the steps that count are those
    between these; where the coordinates are not far away for their scale, the steps that were
    asked for are as good.
    """
    (n, m), random = sizes, np.random.default_rng(seed)
    scales = 10 ** random.uniform(min(exponents), max(exponents), n)
    centre = random.uniform(-offset, offset, n)
    matrix = random.standard_normal((n, m)) / scales[:, None]
    states = (centre + scales * random.standard_normal((50, n))).astype(np.float32)
    expert = load_expert(lambda rows: (rows.astype(np.float64) - centre) @ matrix)
    preset = PRESETS["standard"]
    probes = replace(preset, calibrated=False).complete(Probes.parse(f"{design},{stencil}"))
    found = measure_scales(states)
    around = Surroundings.of(states, probes, found)
    answers = ask_probes(expert, around, np.random.default_rng(0))
    assert np.isfinite(answers.values).all()
    live = np.flatnonzero(found.live)
    assert answers.numbers.shape == (50, len(live))
    asked = answers.displacements[answers.numbers]
    middle = states[:, None, :].astype(np.float64)
    after = (states[:, None, :] + asked).astype(np.float64)
    before = (states[:, None, :] - asked).astype(np.float64) if stencil == "central" else middle
    there = (
        answers.values[:, :, 1] if stencil == "central" else expert.ask(states, "label")[:, None]
    )
    changes = answers.values[:, :, 0].astype(np.float64) - there
    kinds = [after - before]
    if (np.abs(centre) <= 30 * scales).all():
        kinds.append(asked * sum(abs(offset) for offset in probes.stencil.offsets))
    for steps in kinds:
        whitened = steps[..., live] / found.deviation[live]
        jacobians = np.linalg.solve(whitened, changes)
        expected = matrix[live] * found.deviation[live, None]
        error = np.linalg.norm(jacobians - expected, axis=(1, 2)) / np.linalg.norm(expected)
        assert error.max() <= 1e-4


@pytest.fixture(scope="module")
def asked_in_chunks(tmp_path_factory):
    """An expert by the number of rows that it is asked at once."""
    path = mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx", sizes=(5, 32, 2))
    sources = {"onnx": path, "function": lambda rows: np.tanh((rows[:, None] * GAIN).sum(axis=2))}
    return lambda kind, chunk: load_expert(sources[kind], 5, 2, batch=chunk)


@pytest.mark.fault(92)
@pytest.mark.parametrize("kind", ["onnx", "function"])
@few(25)
@given(rows=st.integers(0, 300), chunk=st.integers(1, 400), seed=seeds)
def test_the_size_of_a_chunk_changes_no_byte(kind, rows, chunk, seed, asked_in_chunks):
    observations = 3 * random_array(seed, (rows, 5))
    whole, parts = (
        asked_in_chunks(kind, size).ask(observations, "probe") for size in (1024, chunk)
    )
    assert whole.tobytes() == parts.tobytes()
    assert whole.shape == (rows, 2)


@pytest.mark.fault(84, 85)
@pytest.mark.parametrize("design", DIRECTIONS)
@few(25)
@given(
    rows=st.integers(1, 40),
    dimension=st.integers(1, 30),
    count=st.integers(1, 70),
    moving=st.integers(1, 30),
    seed=seeds,
)
def test_probes_are_never_fewer_than_asked_for(design, rows, dimension, count, moving, seed):
    """Also more of them than coordinates, and where observations are functions of few things."""
    fixed = design in ("basis", "jacobian")
    directions = Probes.parse(design if fixed else f"{design}:{count}").directions
    moving = min(moving, dimension)
    states = random_array(seed, (60, moving)) @ random_array(seed + 1, (moving, dimension))
    bank, numbers = directions.around(states)(rows, np.random.default_rng(seed))
    assert numbers.shape == (rows, dimension if fixed else count)
    assert np.isfinite(bank).all()
    assert np.linalg.norm(bank, axis=1).min() > 0
    for row in numbers:
        assert len(set(row.tolist())) == len(row)
        if dimension > 1:  # in one dimension there are two directions only
            assert len(np.unique(bank[row], axis=0)) == len(row)


# --- files


networks = st.builds(
    Mlp,
    st.lists(st.integers(1, 9), max_size=3).map(tuple),
    st.sampled_from(sorted(ACTIVATIONS)),
)
sizes = st.tuples(st.integers(1, 9), st.integers(1, 4))
limits = st.one_of(st.just(np.inf), st.floats(0.1, 1e6))


def student_of(network, sizes, seed, limit):
    n, m = sizes
    bounds = np.full(m, -limit), np.full(m, limit)
    student = Student(network, random_array(seed, n), np.ones(n), *bounds, torch_generator(seed))
    return student.eval()


@few(20)
@given(network=networks, sizes=sizes, seed=seeds, limit=limits, note=st.text())
def test_a_student_reads_back(network, sizes, seed, limit, note):
    student = student_of(network, sizes, seed, limit)
    data = student.to_bytes({"note": note})
    again = Student.from_bytes(data)
    assert again.architecture == network
    assert (again.observation_size, again.action_size) == sizes
    assert again.to_bytes({"note": note}) == data
    rows = random_array(seed, (5, sizes[0]))
    assert np.array_equal(again.act(rows), student.act(rows))


@few(20)
@given(network=networks, sizes=sizes, seed=seeds, steps=st.integers(0, 5), logged=st.booleans())
def test_the_state_of_a_training_reads_back(network, sizes, seed, steps, logged):
    def begun():
        student = student_of(network, sizes, seed, 1.0)
        optimiser = torch.optim.AdamW(student.parameters())
        rows = torch.from_numpy(random_array(seed, (4, sizes[0])))
        state = FitState(student, optimiser)

        def go_on():
            optimiser.zero_grad()
            loss = student(rows).square().mean()
            loss.backward()
            optimiser.step()
            state.count(loss.detach().expand(len(TaylorLoss._fields)))

        return state, go_on

    (state, go_on), (other, other_goes_on) = begun(), begun()
    for _ in range(1 + steps):  # the moments of an optimiser begin with its first step
        go_on()
    if logged:
        state.log(0.5)
    data = state.to_bytes()
    other.restore(data)
    assert other.to_bytes() == data
    assert (other.step, other.history, other.stale) == (state.step, state.history, state.stale)
    go_on()
    other_goes_on()
    assert other.to_bytes() == state.to_bytes()


stencils = st.sampled_from([None, FORWARD, CENTRAL])
counts = st.integers(1, 10**6)
directions = st.one_of(
    st.builds(DIRECTIONS["adaptive"], counts),
    st.builds(DIRECTIONS["sphere"], counts),
    st.builds(DIRECTIONS["orthogonal"], counts),
    st.just(DIRECTIONS["basis"]()),
    st.just(OrthogonalFrames(None)),
)
distances = st.floats(0, exclude_min=True, allow_infinity=False, allow_nan=False)
ranges = st.tuples(distances, distances).map(lambda ends: tuple(sorted(ends)))
radii = st.none() | st.just("wide") | distances | ranges
sources = st.builds(
    Probes,
    directions,
    stencils,
    radius=radii,
    space=st.sampled_from([None, "whitened", "raw"]),
    resample=st.booleans(),
    per_step=st.none() | st.just("all") | counts,
    match=st.sampled_from([None, "differences", "labels", "both"]),
) | st.builds(Probes, st.just(Jacobian()), st.just(EXACT) | st.none(), radius=radii)


@few(200)
@given(probes=sources)
def test_a_source_reads_back_from_what_it_is_called(probes):
    assert Probes.parse(probes.describe()) == probes


@few(20)
@given(
    sizes=st.tuples(st.integers(1, 30), st.integers(1, 9), st.integers(1, 4), st.integers(1, 5)),
    seed=seeds,
    probes=st.none() | sources,
    limit=limits,
    name=st.text(),
)
def test_demonstrations_read_back_with_and_without_answers(sizes, seed, probes, limit, name):
    count, n, m, k = sizes
    actions, number = random_array(seed, (count, m)), np.arange(count, dtype=np.int32)
    demonstrations = Demonstrations(
        random_array(seed, (count, n)), actions, number, number, actions,
        random_array(seed, count).astype(np.float64), number % 2 == 0,
    )  # fmt: skip
    answers = None
    if probes is not None:
        numbers = np.arange(count * k, dtype=np.int32).reshape(count, k)
        points = len(probes.stencil.offsets) if probes.stencil and not probes.exact else 2
        bank = random_array(seed, (count * k, n))
        values = random_array(seed, (count, k, points, m))
        answers = Answers(bank, numbers, values, 1.25)
    bound = np.full(m, limit, np.float32)
    dataset = Dataset(demonstrations, probes, answers, -bound, bound, name)
    data = dataset.to_bytes()
    again = Dataset.from_bytes(data)
    assert sha256(again.to_bytes()) == sha256(data)
    assert (again.probes, again.environment) == (probes, name)
    for ours, theirs in ((demonstrations, again.demonstrations), (answers, again.answers)):
        assert (ours is None) == (theirs is None)
        for field, array in vars(ours).items() if ours is not None else ():
            assert np.array_equal(array, getattr(theirs, field)), field
            assert np.asarray(array).dtype == np.asarray(getattr(theirs, field)).dtype


@few(10)
@given(seed=seeds, curve=st.floats(0.01, 30), rays=st.integers(1, 8), steps=st.integers(2, 10))
def test_a_calibration_reads_back(seed, curve, rays, steps):
    states = random_array(seed, (30, 5))
    expert = load_expert(lambda rows: np.sin(curve * rows @ GAIN.T))
    random = np.random.default_rng(seed)
    found = calibrate(expert, states, measure_scales(states), random, 0.3, Ladder(rays, steps))
    text = json.dumps(found.to_json(), allow_nan=False)
    again = Calibration.from_json(json.loads(text))
    assert again.to_json() == found.to_json()
    assert repr(again) == repr(found)  # a NaN does not equal itself


names = st.text("abcXYZ09-_ .äλ", min_size=1, max_size=12).filter(lambda t: t.strip(". ") == t)


@few(15)
@given(files=st.dictionaries(names, st.binary(max_size=300), max_size=4), deep=names)
def test_a_folder_reads_back(files, deep, tmp_path_factory):
    files = files | {f"{deep}-folder/file": b"deep"}
    folder = tmp_path_factory.mktemp("folder") / deep
    write_folder(folder, files)
    assert verify(folder) == files
