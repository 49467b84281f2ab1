"""Odd arguments of every public function: each works, or ends in an error that says what to do."""

import inspect
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil import DAgger, Dart, Fit, Log, Mlp
from fdtasil.errors import ExpertError, FdtasilError, SettingError
from fdtasil.experts.hub.requests import patience

pytestmark = pytest.mark.usefixtures("no_pictures")


def linear(rows):
    return rows @ GAIN.T


class Rude:
    def __repr__(self):
        raise RuntimeError("no text")


TINY = {
    "episodes": 1,
    "horizon": 3,
    "evaluation_episodes": 0,
    "student": Mlp(4),
    "fit": Fit(steps=1),
}
CALLS = {
    "distill": lambda **k: fdtasil.distill(
        **{"expert": linear, "env": TOY, "probes": 0, **TINY, **k}
    ),
    "evaluate": lambda **k: fdtasil.evaluate(
        **{"policy": linear, "expert": linear, "env": TOY, "episodes": 1, "horizon": 3, **k}
    ),
    "load_expert": lambda **k: fdtasil.load_expert(**{"source": linear, **k}),
    "Log": lambda folder="x", formats="csv": Log(folder, formats),
    **{kind.__name__: kind for kind in (Fit, Mlp, DAgger, Dart)},
}
TABLE = [
    (name, parameter)
    for name in CALLS
    for parameter in inspect.signature(getattr(fdtasil, name)).parameters
]
ODD = [
    *(
        None,
        True,
        "1e-3",
        "100",
        "",
        "no/such",
        "x\0y",
        b"ab",
        -1,
        0,
        1.5,
        np.nan,
        np.inf,
        10**400,
    ),
    *(1j, [], {}, (1, 2), {"a": 1}, object(), Rude(), Rude, np.array([64, 64]), np.array(3)),
    *(np.array("a"), np.ma.masked, np.datetime64("2020-01-01"), torch.tensor(2), range(0)),
]


@pytest.mark.fault(185)
@pytest.mark.parametrize(("name", "parameter"), TABLE)
def test_every_odd_value_works_or_is_refused(name, parameter, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for value in ODD:
        refused: list[FdtasilError] = []
        try:
            CALLS[name](**{parameter: value})
        except FdtasilError as error:
            refused.append(error)
        assert all(len(str(error).splitlines()) <= 6 for error in refused)


@pytest.mark.fault(185)
@pytest.mark.parametrize(
    ("call", "next_step"),
    [
        (lambda: Fit(learning_rate="1e-3"), "write learning_rate=0.001, a number and no text"),
        (lambda: Fit(weight="0.5"), "write weight=0.5, a number and no text"),
        (lambda: Fit(steps="100"), "write steps=100, a number and no text"),
        (lambda: Mlp(hidden="64"), "write for example hidden="),
        (lambda: Mlp(hidden=True), "write for example hidden="),
        (lambda: fdtasil.distill(linear, TOY, 0, max_queries="100"), "write max_queries=100, "),
        (lambda: fdtasil.distill(linear, TOY, 0, trainer=None), 'trainer="dagger"'),
        (lambda: fdtasil.distill(linear, TOY, 0, student=(64, 64)), "fdtasil.Mlp((64, 64))"),
        (lambda: fdtasil.distill(linear, TOY, 0, fit={"steps": 3}), "fdtasil.Fit(steps=4000)"),
        (lambda: fdtasil.distill(linear, TOY, 0, force="False"), "write force=True, or leave it"),
        (lambda: fdtasil.distill(linear, TOY, 0, callback=Log), "fdtasil.Log("),
        (lambda: fdtasil.distill(dataset=(np.ones((3, 5)), np.ones((3, 2)))), "from_arrays("),
    ],
)
def test_what_was_meant_is_said(call, next_step):
    with pytest.raises(SettingError) as error:
        call()
    assert next_step in error.value.next_step


@pytest.mark.fault(185)
def test_what_can_only_mean_one_thing_is_taken():
    assert Mlp(np.array([64, 32])) == Mlp((64, 32))
    assert Mlp(np.array(64)) == Mlp(64)
    assert DAgger([1, 5, 20, 30]) == DAgger()
    found = fdtasil.distill(linear, TOY, 0, **{**TINY, "episodes": 2, "trainer": DAgger})
    assert found.report["trainer"] == "dagger"


@pytest.mark.fault(186)
@pytest.mark.parametrize(
    "call",
    [
        lambda: Fit(learning_rate=0),
        lambda: Fit(steps=0),
        lambda: Fit(epochs=0),
        lambda: Mlp((64, True)),
        lambda: fdtasil.distill(linear, TOY, 0, student_obs=[True, False], **TINY),
        lambda: fdtasil.distill(linear, TOY, 0, student_obs=True, **TINY),
        lambda: fdtasil.distill(linear, TOY, 0, student_obs=[0, 5], **TINY),
        lambda: fdtasil.distill(linear, TOY, 0, student_obs=[1, 0, 1], **TINY),
        lambda: fdtasil.distill(linear, TOY, 0, student_obs=["0"], **TINY),
    ],
)
def test_what_trains_nothing_or_something_else_is_refused(call, nothing_is_trained):
    with pytest.raises(SettingError):
        call()
    assert Fit(weight=0).weight == 0


@pytest.mark.fault(186)
@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda a: np.ma.masked_greater(a, 0), "masked"),
        (lambda a: a.astype(str), "it returned values of <U32"),
        (lambda a: a.astype("M8[s]"), "it returned values of datetime64"),
        (lambda a: a.astype(str).astype(object), "it returned texts"),
        (lambda a: a + 0j, "complex"),
    ],
)
def test_answers_that_only_look_like_numbers_are_refused(change, found):
    with pytest.raises(ExpertError, match=found):
        fdtasil.distill(lambda rows: change(linear(rows)), TOY, 0, **TINY)


@pytest.mark.fault(187)
@pytest.mark.parametrize(
    ("where", "change", "found"),
    [
        ("low", lambda a: a * np.nan, "has the bounds nan to 1"),
        ("low", lambda a: a + 5, "has the bounds 4 to 1"),
        ("high", lambda a: -a, "has the bounds -1 to -1"),
        ("observations", lambda a: np.ma.masked_greater(a, 0), "observations are masked"),
        ("actions", lambda a: a.astype(str), "actions are an array of <U"),
        ("taken", lambda a: a * np.inf, "taken are not finite"),
        ("rewards", lambda a: a * np.nan, "rewards are not finite"),
        ("terminated", lambda a: a.astype(str), "terminated are an array of <U"),
        ("episode", list, "episode are list"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_given_data_that_mean_nothing_are_refused(where, change, found, quick, nothing_is_trained):
    data = quick.dataset
    if where in ("low", "high"):
        data = replace(data, **{where: change(getattr(data, where))})
    else:
        states = data.demonstrations
        states = replace(states, **{where: change(getattr(states, where))})
        data = replace(data, demonstrations=states)
    with pytest.raises(SettingError, match=found):
        fdtasil.distill(dataset=data, probes=0)


@pytest.mark.fault(188)
@pytest.mark.parametrize("probes", ["sphere:100000000", 10**8, "orthogonal:100000000"])
@pytest.mark.filterwarnings("ignore:the expert takes")
def test_answers_beyond_the_machines_memory_are_refused_before_they_are_asked(probes):
    asked = []

    def expert(rows):
        asked.append(len(rows))
        return linear(rows)

    run = {**QUICK, "evaluation_episodes": 0}
    found = r"memory: they need [\d.e+]+ GiB, and at most half of [\d.e+]+ GiB are used"
    with pytest.raises(SettingError, match=found):
        fdtasil.distill(expert, TOY, f"{probes},radius=0.3,forward", **run)
    assert sum(asked) < 10_000  # the gate, and the demonstrations


@pytest.mark.fault(189)
@pytest.mark.parametrize("value", ["abc", "-1", "nan"])
def test_a_patience_that_is_no_number_is_named(value, monkeypatch):
    monkeypatch.setenv("HF_HUB_DOWNLOAD_TIMEOUT", value)
    with pytest.raises(SettingError, match="HF_HUB_DOWNLOAD_TIMEOUT is"):
        patience()


@pytest.mark.slow
@pytest.mark.fault(190)
@pytest.mark.parametrize("words", [("--help",), ("distill", "--help"), ("nonsense",)])
def test_who_reads_may_stop_reading(words):
    """As `fdtasil ... | head` does."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = subprocess.run(
            [sys.executable, "-m", "fdtasil", *words],
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == (2 if words == ("nonsense",) else 141)
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr


@pytest.mark.fault(191)
@pytest.mark.torture
def test_few_descriptors_end_in_an_error_of_ours(tmp_path):
    """In a process that has loaded everything, and a fork of it for each number of them."""
    code = """
import os, resource, sys, torch
torch.set_num_threads(1)
import fdtasil
from conftest import QUICK, TOY
from test_arguments import linear
fdtasil.distill(linear, TOY, 0, **QUICK, progress=False)
for limit in (4, 6, 9):
    if os.fork():
        assert os.wait()[1] == 0, limit
        continue
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
    out, code = f"{sys.argv[1]}/{limit}", 0
    try:
        fdtasil.distill(linear, TOY, 0, **QUICK, progress=False, out=out)
    except fdtasil.FdtasilError as error:
        print(limit, error.next_step, flush=True)
    except BaseException as error:
        print(limit, repr(error), file=sys.stderr, flush=True)
        code = 1
    os._exit(code)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.path.dirname(__file__)},
    )
    assert done.returncode == 0, done.stderr
