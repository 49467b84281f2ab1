"""Data that can't be trained on, training that breaks, arguments that are misspelt."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import QUICK, TOY

import fdtasil
from fdtasil import Fit, Mlp
from fdtasil.errors import ExpertError, FitError, SettingError

WHOLE = {"student": Mlp(8), "fit": Fit(steps=40)}

pytestmark = pytest.mark.usefixtures("no_pictures")


def changed(dataset, **arrays):
    """The dataset with other arrays of its demonstrations."""
    return replace(dataset, demonstrations=replace(dataset.demonstrations, **arrays))


def spoilt(array, value, row=3):
    copy = array.copy()
    copy[row] = value
    return copy


@pytest.fixture
def refused(nothing_is_trained):
    """What is said of a dataset that is refused before a training begins."""

    def found(dataset):
        with pytest.raises(SettingError, match="demonstrations whose") as error:
            fdtasil.distill(dataset=dataset, **WHOLE)
        assert len(str(error.value).splitlines()) <= 6
        return error.value.found

    return found


# --- given data


@pytest.mark.fault(94)
@pytest.mark.parametrize("episodes", [0, -1, 1.5, True, "2"])
def test_no_episodes_are_refused_before_anything_is_asked(episodes):
    def never(rows):
        raise AssertionError("asked")

    with pytest.raises(SettingError, match=f"episodes={episodes!r}"):
        fdtasil.distill(never, TOY, 1, **{**QUICK, "episodes": episodes})


@pytest.mark.fault(94)
@pytest.mark.parametrize("kind", ["dataset", "file"])
def test_demonstrations_without_a_state_are_refused(kind, quick, tmp_path, refused):
    none = {name: array[:0] for name, array in vars(quick.demonstrations).items()}
    dataset = replace(changed(quick.dataset, **none), answers=None, probes=None)
    (tmp_path / "demonstrations.npz").write_bytes(dataset.to_bytes())
    source = dataset if kind == "dataset" else tmp_path
    assert refused(source).endswith("observations have the shape (0, 5)")


@pytest.mark.fault(99)
@pytest.mark.parametrize("name", ["actions", "taken", "observations", "episode", "rewards"])
def test_demonstrations_of_shapes_that_would_broadcast_are_refused(name, quick, refused):
    array = getattr(quick.demonstrations, name)
    for wrong in (array[:-1], array[..., None], array.reshape(-1)[:40] if array.ndim > 1 else 0):
        if isinstance(wrong, np.ndarray):
            found = refused(changed(quick.dataset, **{name: wrong}))
            assert "have the shape" in found


@pytest.mark.fault(99)
def test_an_expert_that_answers_a_vector_is_learnt_from_as_a_column():
    """(N,) against a student's (N, 1) would be compared each with each."""

    def swing(rows):
        return np.clip(-8 * np.arctan2(rows[:, 1], rows[:, 0]) - 2 * rows[:, 2], -2, 2)

    runs = [
        fdtasil.distill(law, "Pendulum-v1", 1, **QUICK)
        for law in (swing, lambda rows: swing(rows)[:, None])
    ]
    assert runs[0].demonstrations.actions.shape == (len(runs[0].demonstrations), 1)
    assert runs[0].student.to_bytes() == runs[1].student.to_bytes()


@pytest.mark.fault(100)
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["observations", "actions"])
def test_given_data_that_is_not_finite_is_refused_before_training(name, value, quick, refused):
    array = getattr(quick.demonstrations, name)
    found = refused(changed(quick.dataset, **{name: spoilt(array, value)}))
    assert found.endswith(f"{name} are not finite in 1 of 40 rows, the first of them row 3")


@pytest.mark.fault(100)
@pytest.mark.parametrize("name", ["values", "displacements"])
def test_given_answers_that_are_not_finite_are_refused(name, quick, refused):
    array = getattr(quick.answers, name)
    answers = replace(quick.answers, **{name: spoilt(array, np.nan)})
    assert name in refused(replace(quick.dataset, answers=answers))


@pytest.mark.fault(97)
@pytest.mark.parametrize("horizon", [1, 2])
@pytest.mark.parametrize("trainer", ["bc", "dagger", "dart"])
def test_one_state_can_be_learnt(horizon, trainer, linear):
    run = {**QUICK, "horizon": horizon, "evaluation_episodes": 1, "trainer": trainer}
    result = fdtasil.distill(linear, TOY, 3, **{**run, "episodes": 1 if trainer == "bc" else 2})
    assert np.isfinite([list(entry.values()) for entry in result.history]).all()
    assert all(torch.isfinite(weights).all() for weights in result.student.parameters())
    assert len(result.export_bytes("student.onnx")) > 100


@pytest.mark.fault(97)
def test_one_given_state_can_be_learnt(quick, linear):
    one = {name: array[:1] for name, array in vars(quick.demonstrations).items()}
    single = replace(changed(quick.dataset, **one), answers=None, probes=None)
    for expert, probes in ((None, 0), (linear, 3)):
        result = fdtasil.distill(expert, dataset=single, probes=probes, **WHOLE)
        assert np.isfinite(result.history[-1]["loss"])


# --- training


def tensors_of(folder):
    """Every tensor of every checkpoint and student's file in a run's folder."""
    for path in folder.rglob("*.safetensors"):
        for name, tensor in safetensors.torch.load(path.read_bytes()).items():
            if not name.endswith(("low", "high")):  # bounds may be infinite
                yield f"{path.name}:{name}", tensor


@pytest.mark.fault(100, 101)
@pytest.mark.parametrize("batch_size", [5, 40])
@pytest.mark.parametrize("rate", [1e20, 1e38])
def test_a_training_that_diverges_leaves_no_number_that_is_not_finite(
    rate, batch_size, linear, tmp_path, monkeypatch
):
    """Checkpoints are taken at every epoch here, the history looks at each hundredth step."""
    monkeypatch.setattr("fdtasil.run.folder.CHECKPOINT_SECONDS", 0.0)
    entries = []
    fit = Fit(steps=300, batch_size=batch_size, learning_rate=rate)
    run = {**QUICK, "fit": fit}
    with pytest.raises(FitError, match=r"at step|after step") as error:
        fdtasil.distill(linear, TOY, 3, out=tmp_path, callback=entries.append, **run)
    assert len(str(error.value).splitlines()) <= 6
    assert "lower learning_rate" in error.value.next_step
    assert not list(tmp_path.rglob("student*"))
    tensors = list(tensors_of(tmp_path))
    assert all(torch.isfinite(tensor).all() for _, tensor in tensors), tensors
    numbers = [value for event in entries for value in event.entry.values()]
    assert np.isfinite(numbers).all()


@pytest.mark.fault(101)
def test_a_student_that_was_spoilt_is_not_saved(quick, tmp_path):
    result = copy.deepcopy(quick)
    with torch.no_grad():
        next(result.student.parameters())[0, 0] = torch.nan
    with pytest.raises(fdtasil.FdtasilError, match="not finite"):
        result.save(tmp_path / "run")
    with pytest.raises(fdtasil.FdtasilError, match="not finite"):
        result.to_onnx(tmp_path / "student.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.fault(106)
@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB. GPU 0 has"),
            "Tried to allocate 2.00 MiB",
        ),
        (RuntimeError("CUDA error: out of memory\nSearch for"), "CUDA error: out of memory"),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when"), "CUDA error: CUBLAS_STATUS"),
    ],
)
def test_a_full_gpu_leaves_a_run_that_goes_on_elsewhere(
    error, said, linear, tmp_path, monkeypatch
):
    def full(*arguments, **named):
        raise error

    run = {**QUICK, "probes": 4}
    with monkeypatch.context() as patch:
        patch.setattr("fdtasil.run.training.fit", full)
        patch.setattr("fdtasil.run.pipeline.pick_device", lambda name: torch.device("cpu"))
        with pytest.raises(FitError, match=f"no GPU memory left: {said}") as raised:
            fdtasil.distill(linear, TOY, out=tmp_path, device="cuda", **run)
    assert any("resume=" in note for note in raised.value.__notes__)
    with pytest.warns(fdtasil.FdtasilWarning, match="device was 'cuda', is 'cpu'"):
        resumed = fdtasil.distill(linear, TOY, resume=tmp_path, **run)
    whole = fdtasil.distill(linear, TOY, **run)
    assert resumed.student.to_bytes() == whole.student.to_bytes()


@pytest.mark.slow
@pytest.mark.fault(100)
@pytest.mark.parametrize(
    ("moment", "newest"),
    [
        ("the questions of the second round", "1/recorded-0"),
        ("training", "1/training-*"),
        ("the evaluation", "1/trained-0"),
    ],
)
@pytest.mark.usefixtures("many_checkpoints")
def test_an_expert_that_fails_late_leaves_a_run_that_goes_on(moment, newest, linear, tmp_path):
    run = {**QUICK, "trainer": "dagger", "episodes": 3, "probes": "sphere:4,resample"}
    run["fit"] = Fit(steps=75)
    asked, trained = 0, []

    def expert(rows):
        nonlocal asked
        asked += len(rows)
        return linear(rows)

    def note(event):
        if event.kind == "round":
            trained.append(asked)

    golden = fdtasil.distill(expert, TOY, out=tmp_path / "golden", callback=note, **run)
    after = {
        "the questions of the second round": trained[0] + 60,  # 40 of them act
        "training": trained[1] - 60,
        "the evaluation": trained[1] + 10,
    }[moment]
    good, asked = expert, 0

    def failing(rows):
        answers = good(rows)
        return answers * np.nan if asked > after else answers

    failing.__name__ = "expert"
    with pytest.raises(ExpertError, match="expert is not finite on"):
        fdtasil.distill(failing, TOY, out=tmp_path / "run", **run)
    kept = sorted((tmp_path / "run/checkpoints").glob("*/*"), key=lambda p: p.stat().st_mtime)
    assert kept[-1].match(newest)
    assert all(torch.isfinite(tensor).all() for _, tensor in tensors_of(tmp_path))
    result = fdtasil.distill(expert, TOY, resume=tmp_path / "run", **run)
    assert result.student.to_bytes() == golden.student.to_bytes()
    progress = (tmp_path / "run" / "progress.csv").read_bytes()
    assert progress == (tmp_path / "golden" / "progress.csv").read_bytes()
    assert "nan" not in progress.decode()
    json.loads((tmp_path / "run" / "report.json").read_bytes(), parse_constant=pytest.fail)


# --- arguments


@pytest.mark.fault(107)
def test_a_misspelt_argument_is_named_and_nothing_is_asked():
    def never(rows):
        raise AssertionError("asked")

    with pytest.raises(TypeError, match="unexpected keyword argument 'radiuss'"):
        fdtasil.distill(never, TOY, radiuss=0.1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'episode'"):
        fdtasil.evaluate(never, never, TOY, episode=3)
    with pytest.raises(TypeError, match="unexpected keyword argument 'bata'"):
        fdtasil.DAgger(bata=0.3)


@pytest.mark.fault(107)
@pytest.mark.parametrize(
    ("wrong", "known"),
    [
        ({"probes": "sphere:3,radiuss=0.1"}, "radius="),
        ({"probes": "spere:3"}, "sphere"),
        ({"trainer": "dager"}, "dagger"),
        ({"preset": "standart"}, "standard"),
        ({"device": "cqu"}, "cpu"),
    ],
)
def test_a_misspelt_word_is_shown_the_known_ones(wrong, known):
    def never(rows):
        raise AssertionError("asked")

    with pytest.raises(SettingError) as error:
        fdtasil.distill(never, TOY, **{"probes": 1, **QUICK, **wrong})
    (word,) = wrong.values()
    assert word in error.value.found
    assert known in str(error.value)


@pytest.mark.fault(107)
def test_a_misspelt_setting_of_an_object_is_shown_the_known_ones():
    with pytest.raises(SettingError, match="activation='gellu'") as error:
        Mlp(16, "gellu")
    assert "gelu" in error.value.expected
    with pytest.raises(TypeError, match="unexpected keyword argument 'stepz'"):
        Fit(stepz=3)
