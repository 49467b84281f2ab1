"""Every trainer with every derivative source and stencil: one loop, one contract."""

import numpy as np
import pytest
import torch
from conftest import TOY, mlp_onnx

import fdtasil
from fdtasil.demonstrations.trainers import DAgger, Dart

TRAINERS = {
    "bc": "bc",
    "dagger": DAgger(updates=(1, 2)),
    "dagger, switch, student alone": DAgger(updates=(1, 2), beta=0.0, mix="switch"),
    "dart": Dart(updates=(1, 2), extra=2),
    "noise": "noise",
}
SOURCES = ["none", "basis", "sphere:3", "sphere:2,resample", "orthogonal:3", "fresh:2"]
CELLS = [
    (trainer, source if source == "none" else f"{source},{stencil}")
    for trainer in TRAINERS
    for source in SOURCES
    for stencil in ("forward", "central")
    if not (source == "none" and stencil == "central")
] + [(trainer, source) for trainer in TRAINERS for source in ("jacobian", "sphere:3,labels")]
EPOCHS = 5
QUICK = {
    "episodes": 4,
    "horizon": 10,
    "student": fdtasil.Mlp(8),
    "fit": fdtasil.Fit(epochs=EPOCHS),
    "evaluation_episodes": 1,
}


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


@pytest.mark.parametrize(("trainer", "source"), CELLS)
def test_every_cell_keeps_the_contract(trainer, source, expert):
    first, second = (
        fdtasil.distill(expert, TOY, source, trainer=TRAINERS[trainer], **QUICK) for _ in range(2)
    )
    states = first.demonstrations
    assert states.observations.shape == (40, 5)
    assert states.actions.shape == (40, 2)
    assert states.episode.tolist() == np.repeat(range(4), 10).tolist()
    assert len(first.history) == len(set(states.round.tolist()))
    numbers = [value for entry in first.history for value in entry.values()]
    assert np.isfinite(numbers).all()
    assert all(torch.isfinite(p).all() for p in first.student.state_dict().values())

    # To the row; the coordinate that never moves is not probed, and a basis is shorter by it.
    predicted = dict(first.report["predicted_queries"])
    if source.startswith("basis"):
        predicted["probe"] = predicted["probe"] * 4 // 5
    assert first.queries == predicted

    labels = fdtasil.load_expert(expert).ask(states.observations, "label")
    assert np.array_equal(states.actions, labels)
    assert first.student.to_bytes() == second.student.to_bytes()
    assert first.dataset.to_bytes() == second.dataset.to_bytes()
    assert first.evaluation == second.evaluation


@pytest.mark.parametrize("trainer", TRAINERS)
@pytest.mark.parametrize("source", ["sphere:2,central", "jacobian"])
def test_second_order_in_every_trainer(trainer, source, expert):
    quick = {**QUICK, "fit": fdtasil.Fit(epochs=EPOCHS, order=2)}
    result = fdtasil.distill(expert, TOY, source, trainer=TRAINERS[trainer], **quick)
    assert all(entry["curvature_error"] > 0 for entry in result.history)
    assert result.queries["probe"] == (160 if "sphere" in source else 0)


@pytest.mark.parametrize("trainer", TRAINERS)
def test_falls_are_masked_in_every_trainer(trainer, expert):
    walled = "toy_environments:toy/Walled-v0"
    quick = {**QUICK, "episodes": 8, "horizon": 40}
    result = fdtasil.distill(expert, walled, "sphere:2", trainer=TRAINERS[trainer], **quick)
    states = len(result.demonstrations)
    assert result.report["terminated_episodes"] > 0
    assert states < 8 * 40
    assert result.queries["act"] + result.queries["label"] >= states
    assert result.queries["probe"] == 2 * states
    assert all(result.queries[k] <= v for k, v in result.report["predicted_queries"].items())
