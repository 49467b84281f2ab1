"""Every row of every table keeps its contract: whoever adds one has these tests at once."""

import numpy as np
import pytest
import torch
from conftest import QUICK, TOY

import fdtasil
from fdtasil.demonstrations.trainers import TRAINERS
from fdtasil.errors import SettingError
from fdtasil.files.onnx.export import export_module
from fdtasil.files.onnx.graph import LAYERS, can_write
from fdtasil.probes.source import DIRECTIONS, Probes
from fdtasil.results.figures import FIGURES, _cumulative_steps
from fdtasil.student.architectures import ACTIVATIONS, ARCHITECTURES, Mlp
from fdtasil.student.exports import EXPORTS
from fdtasil.student.policy import Student

ROWS = np.random.default_rng(0).standard_normal((64, 5)).astype(np.float32)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_a_probe_design_is_written_as_it_is_read(name):
    probes = Probes.parse(name)
    assert Probes.parse(probes.describe()) == probes
    states, random = ROWS.astype(np.float64), np.random.default_rng(0)
    bank, numbers = probes.directions.around(states)(7, random)
    assert bank.shape[1] == 5
    assert numbers.shape == (7, probes.directions.count(5))
    assert numbers.dtype == np.int32
    assert 0 <= numbers.min() <= numbers.max() < len(bank)
    # A step moves the coordinates that it moves by one unit each, root mean square.
    lengths = probes.directions.reach(5) * np.linalg.norm(bank, axis=1)
    moved = np.count_nonzero(bank, axis=1) ** 0.5
    assert lengths.mean() == pytest.approx(moved.mean(), rel=0.05)


@pytest.mark.parametrize("name", TRAINERS)
def test_a_trainer_spends_the_episodes_that_it_is_given(name, linear):
    trainer = TRAINERS[name]()
    assert trainer.name == name
    assert sum(trainer.rounds(7)) == 7
    result = fdtasil.distill(linear, TOY, 0, trainer=name, **QUICK)
    acted = result.queries["act"] + result.queries["label"]
    assert acted == sum(trainer.queries(QUICK["episodes"], QUICK["horizon"]).values())


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_an_architecture_is_read_back_and_exported(name, tmp_path):
    ones = np.ones(5, np.float32)
    bounds = np.array([-2.0, -np.inf]), np.array([2.0, 1.0])
    random = torch.Generator().manual_seed(0)
    student = Student(ARCHITECTURES[name](), 0 * ones, ones, *bounds, random)
    answers = student.act(ROWS)
    again = Student.from_bytes(student.to_bytes())
    assert again.architecture == student.architecture
    assert np.array_equal(again.act(ROWS), answers)
    (tmp_path / "s.onnx").write_bytes(export_module(student, ROWS, {}))
    expert = fdtasil.load_expert(tmp_path / "s.onnx", 5, 2)
    assert np.allclose(expert.ask(ROWS, "act"), answers, atol=1e-5)
    assert np.abs(answers[:, 0]).max() <= 2


@pytest.mark.parametrize("suffix", EXPORTS)
def test_a_target_is_chosen_by_its_suffix(suffix, quick, tmp_path):
    if suffix == ".tflite":
        pytest.importorskip("ai_edge_litert", reason="needs fdtasil[litert]")
    path = quick.export(tmp_path / f"policy{suffix}")
    assert path.read_bytes() == quick.export_bytes(f"another{suffix}")


def test_a_target_that_nobody_writes_is_refused(quick, tmp_path):
    with pytest.raises(SettingError, match=r"'.*policy\.exe'.*"):
        quick.export(tmp_path / "policy.exe")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_every_figure_is_a_picture_in_the_folder(quick, tmp_path):
    folder = quick.save(tmp_path / "run") / "figures"
    assert {path.stem for path in folder.iterdir()} == set(FIGURES)
    for name, draw in FIGURES.items():
        picture = draw(quick)
        assert picture is not None
        assert picture.startswith(b"\x89PNG")
        assert (folder / f"{name}.png").read_bytes()[:8] == picture[:8]


SPECIAL = {  # layers that need arguments, and settings that change what a layer computes
    "Linear": lambda: torch.nn.Linear(5, 3),
    "Linear without bias": lambda: torch.nn.Linear(5, 3, bias=False),
    "Sequential": lambda: torch.nn.Sequential(torch.nn.Tanh(), torch.nn.ReLU()),
    "GELU, tanh": lambda: torch.nn.GELU("tanh"),
    "ELU, alpha": lambda: torch.nn.ELU(0.3),
    "CELU, alpha": lambda: torch.nn.CELU(0.3),
    "LeakyReLU, slope": lambda: torch.nn.LeakyReLU(0.2),
    "Hardtanh, bounds": lambda: torch.nn.Hardtanh(-0.5, 0.25),
    "Softplus, beta": lambda: torch.nn.Softplus(beta=3.0),
}
PLAIN = {kind.__name__: kind for kind in LAYERS if kind.__name__ not in SPECIAL}


@pytest.mark.parametrize("name", [*PLAIN, *SPECIAL])
def test_a_layer_has_the_graph_of_what_it_computes(name, tmp_path):
    with torch.random.fork_rng():  # its weights are drawn from torch's own generator
        layer = {**PLAIN, **SPECIAL}[name]()
    assert can_write(layer)
    rows = np.concatenate([ROWS, 10 * ROWS])
    (tmp_path / "l.onnx").write_bytes(export_module(layer, rows, {"what": name}))
    expert = fdtasil.load_expert(tmp_path / "l.onnx", 5)
    with torch.no_grad():
        answers = layer(torch.from_numpy(rows)).numpy()
    assert np.allclose(expert.ask(rows, "act"), answers, atol=1e-5)
    assert expert.module is not None, "the graph of a layer has a torch twin"


def test_a_layer_without_a_graph_is_left_to_the_exporter():
    class Odd(torch.nn.Module):
        def forward(self, x):
            return torch.sin(x[:, :2])

    assert not can_write(torch.nn.Sequential(torch.nn.Tanh(), Odd()))
    assert len(export_module(Odd(), ROWS, {})) > 100


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_students_own_graph_is_small_and_can_be_quantised(activation, tmp_path):
    import onnx
    from onnxruntime.quantization import quantize_dynamic

    ones, bound = np.ones(5, np.float32), np.ones(2)
    student = Student(Mlp((16, 16), activation), 0 * ones, ones, -bound, bound, torch.Generator())
    plain, small = tmp_path / "s.onnx", tmp_path / "int8.onnx"
    plain.write_bytes(export_module(student, ROWS, {}))
    model = onnx.load(plain)
    onnx.checker.check_model(model, full_check=True)
    assert not model.graph.value_info
    assert sum(node.op_type == "Gemm" for node in model.graph.node) == 3
    # Processors without VNNI add pairs of products in 16 bits, which eight-bit weights overflow.
    quantize_dynamic(plain, small, reduce_range=True)
    answers = fdtasil.load_expert(small, 5, 2).ask(ROWS, "act")
    assert np.abs(answers - student.act(ROWS)).max() < 0.1


def test_steps_are_counted_on_over_rounds_of_any_length():
    entries = [(0, 10), (0, 20), (1, 50), (2, 20), (2, 100), (3, 100)]
    history = [{"round": number, "step": step} for number, step in entries]
    assert _cumulative_steps(history) == [10, 20, 70, 90, 170, 270]
