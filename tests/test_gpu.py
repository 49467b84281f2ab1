"""Training on a GPU: the same students as on the CPU, without a round trip for each step."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY
from toy_tasks import linear_task, new_student, stream

import fdtasil
from fdtasil.errors import FitError
from fdtasil.student.fit import Fit, Hooks, fit
from fdtasil.student.loss import Minibatch, ProbeBatch, TaylorLoss
from fdtasil.student.step import gradient_step

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

DEVICES = ("cuda", "cpu")
SPECS = [
    None,
    "4",
    "basis,central",
    "orthogonal:6",
    "sphere:2,resample",
    "sphere:3,labels",
    "fresh:2",
]


def train(spec, device="cuda", resume=None, checkpoint=lambda state: None, **changes):
    demonstrations, probes, ask = linear_task(states=230, spec=spec)
    student = new_student().to(device)
    settings = Fit(**{"steps": 300, **changes})
    hooks = Hooks(checkpoint=checkpoint)
    history = fit(
        student, demonstrations, probes, ask, settings, stream, hooks=hooks, resume=resume
    )
    return student, history


@pytest.mark.parametrize("spec", SPECS)
def test_the_gpu_trains_the_student_that_the_cpu_trains(spec):
    (ours, history), (theirs, expected) = train(spec), train(spec, "cpu")
    assert [entry["step"] for entry in history] == [entry["step"] for entry in expected]
    for entry, other in zip(history, expected, strict=True):
        assert list(entry.values()) == pytest.approx(list(other.values()), rel=0.05, abs=2e-3)
    rows = np.random.default_rng(1).standard_normal((50, 6)).astype(np.float32)
    assert np.abs(ours.act(rows) - theirs.act(rows)).max() < 0.05


@pytest.mark.parametrize("spec", ["4", "sphere:2,resample"])
def test_equal_seeds_give_equal_weights_also_when_resumed(spec):
    kept = {}

    def keep(state):
        if state.step == 150:
            kept["state"] = state.to_bytes()

    whole, history = train(spec, checkpoint=keep)
    again, _ = train(spec)
    resumed, rest = train(spec, resume=kept["state"])
    assert whole.to_bytes() == again.to_bytes() == resumed.to_bytes()
    assert rest == history


@pytest.mark.parametrize("devices", [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_training_goes_on_elsewhere(devices):
    kept = {}

    def keep(state):
        if state.step == 150:
            kept["state"] = state.to_bytes()

    whole, _ = train("4", devices[0], checkpoint=keep)
    moved, history = train("4", devices[1], resume=kept["state"])
    assert [entry["step"] for entry in history] == [100, 200, 300]
    rows = np.random.default_rng(1).standard_normal((50, 6)).astype(np.float32)
    assert np.abs(whole.act(rows) - moved.act(rows)).max() < 0.05


@pytest.mark.parametrize("spec", [None, "4"])
def test_a_step_waits_for_nothing(spec):
    """The loss is read once in a hundred steps; set-up and recording apart, nothing else is."""
    waits = {}
    for steps in (500, 1500):
        torch.cuda.set_sync_debug_mode("warn")
        try:
            with warnings.catch_warnings(record=True, action="always") as caught:
                train(spec, steps=steps)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        waits[steps] = sum("synchron" in str(warning.message) for warning in caught)
    assert 10 <= waits[1500] - waits[500] <= 60


def test_a_replayed_step_is_the_step_itself():
    """Two shapes of a minibatch, in turn, against the same steps launched one by one."""
    for ours, theirs in zip(stepwise("cuda"), stepwise("cpu"), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def stepwise(launched):
    """Losses and weights after twenty steps on the GPU, launched as on some device."""
    student = new_student().to("cuda")
    optimiser = torch.optim.AdamW(student.parameters(), fused=True, capturable=True)
    loss = partial(loss_of, student)
    step = gradient_step(student, optimiser, loss, 1.0, torch.device(launched))
    losses = [step(batch, 1e-2 / (1 + number)) for number, batch in enumerate(minibatches())]
    return torch.stack(losses), *student.parameters()


def minibatches():
    random = torch.Generator().manual_seed(0)
    for number in range(20):
        rows = 10 + (number > 9)  # the second shape comes up when the first is recorded
        draws = [torch.randn(rows, size, generator=random).to("cuda") for size in (6, 2)]
        gains = torch.full((rows, 1), 1.0 + (number > 14), device="cuda")
        around = ProbeBatch(draws[0][:, None], draws[1][:, None, None], gains)
        yield Minibatch(*draws, around)


def loss_of(student, batch):
    error = (student(batch.observations) - batch.actions).norm(dim=1).mean()
    return TaylorLoss(*[batch.probes.gains.mean() * error] * len(TaylorLoss._fields))


class Expert(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.from_numpy(GAIN))

    def forward(self, observations):
        """(B, 5) -> (B, 2)."""
        return torch.tanh(observations @ self.gain.T)


@pytest.mark.parametrize(
    "setting",
    [
        {"probes": 0},
        {"probes": 5},
        {"probes": 5, "trainer": "dagger"},
        {"probes": "jacobian"},
        {"probes": "jacobian", "fit": Fit(steps=40, order=2)},
        {"probes": "basis,central", "fit": Fit(steps=40, order=2)},
        {"probes": "sphere:2,resample"},
        {"probes": "fresh"},
        {"probes": 5, "fit": Fit(steps=40, validation=0.5, patience=1)},
    ],
    ids=str,
)
def test_a_run_on_the_gpu_gives_a_student_for_the_cpu(setting):
    run = {**QUICK, "device": "cuda", "progress": False, **setting}
    result = fdtasil.distill(Expert(), TOY, **run)
    assert {weights.device.type for weights in result.student.parameters()} == {"cpu"}
    assert np.isfinite(result.evaluation.normalized_return)
    assert result.settings["device"] == "cuda"


def test_a_module_is_asked_anew_on_the_gpu(monkeypatch):
    """Its own answers travel once for a run; the rest comes from a twin that is compared first."""
    asked, answer = [], Expert.forward

    def forward(self, observations):
        asked.append((observations.device.type, len(observations)))
        return answer(self, observations)

    monkeypatch.setattr(Expert, "forward", forward)
    run = {**QUICK, "progress": False, "probes": "fresh,radius=0.2..2", "fit": Fit(steps=200)}
    results = {device: fdtasil.distill(Expert(), TOY, device=device, **run) for device in DEVICES}
    rows = {device: sum(n for kind, n in asked if kind == device) for device in DEVICES}
    assert rows["cuda"] > 10 * results["cuda"].dataset.answers.values[..., 0].size
    queries = {device: result.report["queries"]["probe"] for device, result in results.items()}
    assert queries["cuda"] == queries["cpu"]
    states = results["cpu"].dataset.demonstrations.observations
    ours, theirs = (results[device].student.act(states) for device in DEVICES)
    assert np.abs(ours - theirs).max() < 0.05


@pytest.mark.fault(100)
def test_a_loss_that_is_not_finite_stops_the_training_on_the_gpu():
    with pytest.raises(FitError, match="finite"):
        train("4", learning_rate=1e38)


@pytest.mark.fault(106)
def test_a_gpu_that_is_full_is_named_before_the_expert_is_asked():
    asked = []
    torch.cuda.set_per_process_memory_fraction(1e-9)
    torch.cuda.empty_cache()
    try:
        with pytest.raises(FitError, match="no GPU memory left"):
            fdtasil.distill(asked.append, TOY, 5, device="cuda", progress=False, **QUICK)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    assert asked == []
