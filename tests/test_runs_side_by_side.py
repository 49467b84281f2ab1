"""Runs in threads of one process, and callers in modes of their own: equal bytes, nothing left."""

import logging
import threading
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from conftest import TOY, mlp_onnx

import fdtasil
from fdtasil.errors import FdtasilWarning

pytestmark = pytest.mark.usefixtures("no_pictures")

RUN = {
    "episodes": 2,
    "horizon": 20,
    "evaluation_episodes": 2,
    "student": fdtasil.Mlp(16),
    "fit": fdtasil.Fit(steps=40),
    "progress": False,
}
FILES = ("student.safetensors", "demonstrations.npz", "student.onnx")


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


def state_of_the_process():
    """Return what a run must leave as it was."""
    return (
        torch.get_num_threads(),
        torch.get_float32_matmul_precision(),
        torch.get_default_dtype(),
        torch.backends.mkldnn.enabled,
        torch.is_grad_enabled(),
        logging.root.manager.disable,
        torch.nn.Module.__call__,
        warnings.showwarning,
        list(warnings.filters),
    )


def files_of(folder):
    return [(folder / name).read_bytes() for name in FILES]


@pytest.mark.fault(195)
@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.torture)])
def test_runs_in_threads_have_the_bytes_that_they_have_alone(count, expert, tmp_path):
    alone = {}
    for seed in range(count):
        fdtasil.distill(expert, TOY, 3, seed=seed, out=tmp_path / f"alone {seed}", **RUN)
        alone[seed] = files_of(tmp_path / f"alone {seed}")
    errors, before = [], state_of_the_process()  # libraries change some of it when they are loaded

    def run(seed):
        try:
            fdtasil.distill(expert, TOY, 3, seed=seed, out=tmp_path / f"{seed}", **RUN)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(seed,)) for seed in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert all(files_of(tmp_path / f"{seed}") == alone[seed] for seed in range(count))
    assert state_of_the_process() == before


@pytest.mark.fault(196)
def test_a_warning_is_noted_by_the_run_that_it_is_of(expert):
    """One of two runs probes in the rounding of float32."""
    reports = {}

    def run(name, probes):
        reports[name] = fdtasil.distill(expert, TOY, probes, **RUN).report

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FdtasilWarning)
        threads = [
            threading.Thread(target=run, args=("rounded", "sphere:2,radius=3e-7")),
            threading.Thread(target=run, args=("plain", "sphere:2,radius=0.3")),
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert any("rounds away" in note for note in reports["rounded"]["warnings"])
    assert reports["plain"]["warnings"] == []


@pytest.mark.fault(197)
def test_a_run_inside_a_callback_does_not_wait_for_itself(expert):
    inner = []

    def callback(event):
        if event.kind == "round":
            inner.append(fdtasil.distill(expert, TOY, 2, **RUN))

    outer = fdtasil.distill(expert, TOY, 2, callback=callback, **RUN)
    assert inner[0].student.to_bytes() == outer.student.to_bytes()


MODES = {
    "no gradients": torch.no_grad,
    "inference": torch.inference_mode,
    "mixed precision": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "the device meta": lambda: torch.device("meta"),
}


@pytest.mark.slow
@pytest.mark.fault(198)
@pytest.mark.parametrize("probes", ["sphere:2", "jacobian"])
@pytest.mark.parametrize("mode", MODES)
def test_the_callers_modes_are_set_aside(mode, probes, expert, tmp_path):
    usual = fdtasil.distill(expert, TOY, probes, **RUN)
    with MODES[mode]():
        result = fdtasil.distill(expert, TOY, probes, out=tmp_path / "run", **RUN)
    assert result.student.to_bytes() == usual.student.to_bytes()
    assert result.dataset.to_bytes() == usual.dataset.to_bytes()
    assert result.evaluation == usual.evaluation


@pytest.mark.fault(198)
def test_the_callers_type_and_device_are_set_aside(expert, tmp_path):
    usual = fdtasil.distill(expert, TOY, "sphere:2", **RUN)
    before = state_of_the_process()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        result = fdtasil.distill(expert, TOY, "sphere:2", out=tmp_path / "run", **RUN)
        judged = fdtasil.evaluate(
            tmp_path / "run" / "student.onnx", expert, TOY, episodes=2, horizon=20
        )
        assert torch.get_default_dtype() == torch.float64
        assert torch.get_default_device().type == "meta"
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    assert state_of_the_process() == before
    assert result.student.to_bytes() == usual.student.to_bytes()
    assert np.allclose(judged.student_returns, usual.evaluation.student_returns, rtol=1e-4)


@pytest.mark.fault(199)
@pytest.mark.parametrize("blocked", [True, False])
def test_an_expert_can_be_opened_while_a_run_goes_on(blocked, expert):
    """Opening needs nothing that the process has only once, and so does asking."""
    opened = threading.Event()

    def callback(event):
        if event.kind == "entry":
            thread = threading.Thread(target=ask)
            thread.start()
            thread.join(timeout=20)

    def ask():
        with torch.no_grad() if blocked else nullcontext():
            fdtasil.load_expert(expert, 5, 2).ask(np.zeros((3, 5)), "act")
        opened.set()

    fdtasil.distill(expert, TOY, 2, callback=callback, **RUN)
    assert opened.is_set()
