"""Nothing is lost: kills, signals, full disks, two processes on one folder, damaged files."""

import errno
import itertools
import json
import os
import random
import shutil
import signal
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from conftest import QUICK, TOY, mlp_onnx
from nursery import Nursery
from test_resume import FILES, RUN, Stop, read, stop_at

import fdtasil
from fdtasil import Fit
from fdtasil.errors import FdtasilWarning, StorageError
from fdtasil.files.storage import verify
from fdtasil.run import folder as runfolder

pytestmark = pytest.mark.usefixtures("no_pictures")

SHORT = {**QUICK, "probes": 2, "fit": Fit(steps=3)}

CODE = """
from fdtasil.results import figures
from fdtasil.run import folder
folder.CHECKPOINT_SECONDS = 0.05
for name in ("training", "returns", "calibration"):
    setattr(figures, f"draw_{name}", lambda *drawn: b"no picture")

def run(expert, env, **arguments):
    try:
        fdtasil.distill(expert, env, progress=False, **arguments)
    except (KeyboardInterrupt, SystemExit) as error:
        code = getattr(error, "code", 130)
        print(code, *error.__notes__, file=sys.stderr, flush=True)
        return code
    return 0
"""


@pytest.fixture(scope="module")
def nursery(tmp_path_factory):
    made = Nursery(CODE, tmp_path_factory.mktemp("nursery") / "errors")
    yield made
    made.close()


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    return mlp_onnx(tmp_path_factory.mktemp("expert") / "e.onnx")


@pytest.fixture(scope="module")
def golden(nursery, expert, tmp_path_factory):
    """The files of a run that was left alone, and how long it takes."""
    folder = tmp_path_factory.mktemp("golden") / "run"
    started = time.monotonic()
    nursery.start(expert=expert, env=TOY, out=folder, **RUN)
    assert nursery.end() == 0
    return read(folder), time.monotonic() - started


def begun(folder):
    return any(folder.glob("checkpoints/*/*"))


def how(folder):
    """How a run goes on that was stopped at any moment."""
    return {"resume" if begun(folder) or (folder / "config.json").exists() else "out": folder}


def wait_for(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.fault(108, 115)
@pytest.mark.parametrize("kills", [4, pytest.param(200, marks=pytest.mark.torture)])
def test_kills_at_random_moments(kills, nursery, expert, golden, tmp_path, figure):
    """Kill a run again and again until it is through; then the next one.

    A machine may become busier or idler meanwhile: the last run is left alone in the end, and how
    long one takes is measured again.
    """
    expected, length = golden
    moments, killed, finished = random.Random(kills), 0, 0
    while killed < kills:
        folder = tmp_path / f"run-{finished}"
        for attempt in itertools.count():
            began, run = (
                time.monotonic(),
                nursery.start(expert=expert, env=TOY, **how(folder), **RUN),
            )
            if killed < kills and not nursery.ends_within(moments.uniform(0, length)):
                with suppress(ProcessLookupError):
                    os.kill(run, signal.SIGKILL)
            code = nursery.end()
            assert code in (0, -signal.SIGKILL), nursery.errors.read_text()
            if code == 0:
                length = length if attempt else time.monotonic() - began
                break
            killed += 1
        finished += 1
        assert read(folder) == expected
        assert not list(folder.glob("*.tmp")) + list(folder.glob(".*"))
    figure("kills at random moments", f"{killed} kills, {finished} runs ended with golden bytes")


@pytest.mark.slow
@pytest.mark.fault(80, 121)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_waits_for_a_checkpoint(number, code, nursery, expert, golden, tmp_path):
    folder = tmp_path / "run"
    run = nursery.start(expert=expert, env=TOY, out=folder, **RUN)
    wait_for(lambda: any(folder.glob("checkpoints/1/training-*")))
    sent = time.monotonic()
    os.kill(run, number)
    assert nursery.end() == code
    assert time.monotonic() - sent < 10
    said = nursery.errors.read_text().splitlines()[-1]
    assert said.startswith(f'{code} what is done is kept: go on with resume="{folder}"')
    assert said.endswith(f"(--resume {folder})")
    nursery.start(expert=expert, env=TOY, resume=folder, **RUN)
    assert nursery.end() == 0
    assert read(folder) == golden[0]


@pytest.mark.slow
@pytest.mark.fault(112)
@pytest.mark.parametrize("way", ["out", "resume"])
def test_a_folder_belongs_to_one_process(way, nursery, expert, golden, tmp_path):
    folder = tmp_path / "run"
    run = nursery.start(expert=expert, env=TOY, out=folder, **RUN)
    wait_for(lambda: begun(folder))
    os.kill(run, signal.SIGSTOP)
    try:
        with pytest.raises(StorageError, match=f"is written by process {run} on "):
            fdtasil.distill(expert, TOY, **{way: folder}, **RUN)
    finally:
        os.kill(run, signal.SIGCONT)
    assert nursery.end() == 0
    assert read(folder) == golden[0]


@pytest.mark.fault(112)
def test_the_lock_of_a_killed_process_is_taken_over(nursery, expert, tmp_path):
    run = nursery.start(expert=expert, env=TOY, out=tmp_path / "run", **RUN)
    wait_for(lambda: (tmp_path / "run" / ".lock").exists())
    os.kill(run, signal.SIGKILL)
    nursery.end()
    nursery.start(expert=expert, env=TOY, **how(tmp_path / "run"), **RUN)
    assert nursery.end() == 0


# --- writes that fail


CALLS = ("os.fsync", "os.open", "pathlib.Path.open", "pathlib.Path.replace", "pathlib.Path.mkdir")


class FailingWrites:
    """Makes the n-th call that writes fail, and all later ones if `forever`."""

    def __init__(self, monkeypatch, nth, code, *, forever):
        self.count, self.nth, self.code, self.forever = 0, nth, code, forever
        for name in CALLS:
            owner, _, method = name.rpartition(".")
            real = getattr(os if owner == "os" else Path, method)
            monkeypatch.setattr(name, self._wrap(real, method))

    def _wrap(self, real, method):
        def call(*arguments, **named):
            how = (arguments[1:2] or ("r",))[0] if method == "open" else "w"
            writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT
            reading = how in ("r", "rb") if isinstance(how, str) else not how & writing
            if reading:
                return real(*arguments, **named)
            self.count += 1
            if self.count == self.nth or (self.forever and self.count > self.nth):
                raise OSError(self.code, os.strerror(self.code))
            return real(*arguments, **named)

        return call


@pytest.fixture(scope="module")
def states(expert, tmp_path_factory):
    """The folders of two runs: before and after the writes that fail."""
    folders = [tmp_path_factory.mktemp("states") / "run" for _ in range(2)]
    for seed, folder in enumerate(folders):
        fdtasil.distill(expert, TOY, out=folder, seed=seed, **SHORT)
    return folders


@pytest.mark.fault(109)
@pytest.mark.filterwarnings("ignore:.* and another one that has not ended")
@pytest.mark.parametrize("every", [41, pytest.param(1, marks=pytest.mark.torture)])
@pytest.mark.parametrize("forever", [False, True])
@pytest.mark.filterwarnings("ignore:.*holds a finished run, which this one replaces")
def test_any_write_may_fail(every, forever, expert, states, tmp_path, monkeypatch, figure):
    """The n-th write fails for every n: the old run or the new one, never anything between."""
    monkeypatch.setattr(runfolder, "CHECKPOINT_SECONDS", 0.0)
    old, new = map(read, states)
    failed = 0
    for nth in itertools.count(1, every):
        folder = shutil.copytree(states[0], tmp_path / str(nth))
        with monkeypatch.context() as patched:
            writes = FailingWrites(patched, nth, errno.ENOSPC, forever=forever)
            try:
                fdtasil.distill(expert, TOY, out=folder, seed=1, **SHORT)
            except StorageError as error:
                failed += "can't write" in error.found and "free some space" in error.next_step
        fdtasil.Distilled.load(folder)
        assert read_as_loaded(folder) in (old, new), nth
        fdtasil.distill(expert, TOY, **how_again(folder), seed=1, **SHORT)
        assert read(folder) == new
        if writes.count < nth:
            break
    assert failed > 100 / every
    figure(
        f"every {every}. write failing{' for ever' if forever else ' once'}".replace(" 1.", ""),
        f"{failed} failures: the old run or the new one in all",
    )


def read_as_loaded(folder):
    found = verify(folder)
    return {name: found[name] for name in FILES}


def how_again(folder):
    return {"resume" if begun(folder) else "out": folder}


@pytest.mark.fault(110, 111)
@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("a-file", "choose a folder, not a file"),
        ("a-file/below", "choose a path that does not lead through a file"),
        ("x" * 300, "choose a shorter name"),
    ],
)
def test_a_place_that_can_not_be_written_is_found_at_once(where, said, tmp_path):
    (tmp_path / "a-file").write_text("")

    def never(observations):
        raise AssertionError("the expert was asked")

    with pytest.raises(StorageError, match=said):
        fdtasil.distill(never, TOY, out=tmp_path / where, **SHORT)


@pytest.mark.fault(110)
@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES])
def test_a_folder_without_permission_is_found_at_once(code, tmp_path, monkeypatch):
    FailingWrites(monkeypatch, 1, code, forever=True)

    def never(observations):
        raise AssertionError("the expert was asked")

    with pytest.raises(StorageError, match="choose a folder"):
        fdtasil.distill(never, TOY, out=tmp_path / "run", **SHORT)


@pytest.mark.fault(111)
def test_missing_parents_are_made(expert, tmp_path):
    fdtasil.distill(expert, TOY, out=tmp_path / "a" / "b" / "c", **SHORT)
    fdtasil.Distilled.load(tmp_path / "a" / "b" / "c")


# --- files that were changed


def mutate(data, random):
    """Return `data` with a bit flipped, or bytes overwritten, inserted, removed or cut off."""
    place, length = random.randrange(len(data)), random.randint(1, 8)
    noise = random.randbytes(length)
    kind = random.randrange(5)
    if kind == 0:
        flipped = bytes([data[place] ^ 1 << random.randrange(8)])
        return data[:place] + flipped + data[place + 1 :]
    if kind == 1:
        return data[:place] + noise + data[place + length :]
    if kind == 2:
        return data[:place] + noise + data[place:]
    if kind == 3:
        return data[:place] + data[place + length :]
    return data[:place]


@pytest.mark.fault(116)
@pytest.mark.parametrize("count", [100, pytest.param(2000, marks=pytest.mark.torture)])
def test_every_mutated_file_of_ours_is_detected(count, expert, tmp_path, figure):
    fdtasil.distill(expert, TOY, out=tmp_path, **SHORT)
    files = [path for path in sorted(tmp_path.rglob("*")) if path.is_file()]
    card = b'  "README.md"'  # which may be completed by hand, so that its hash says nothing
    files.remove(tmp_path / "README.md")
    assert len(files) > 7
    random_, mutated = random.Random(0), 0
    while mutated < count:
        path = random_.choice(files)
        whole = path.read_bytes()
        changed = mutate(whole, random_)
        before, after = (
            [line for line in data.split(b"\n") if not line.startswith(card)]
            for data in (whole, changed)
        )
        if before == after:
            continue
        mutated += 1
        path.write_bytes(changed)
        with pytest.raises(StorageError):
            fdtasil.Distilled.load(tmp_path)
        path.write_bytes(whole)
    fdtasil.Distilled.load(tmp_path)
    figure("mutated files of a run", f"{mutated} of {mutated} detected")


@pytest.mark.fault(117)
def test_checkpoints_hold_what_plain_readers_read(expert, tmp_path):
    """safetensors, arrays without pickles, JSON: read back here by other code than ours."""
    from safetensors.numpy import load_file

    def stop(event):
        if event.round == 1:
            raise Stop

    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path, callback=stop, **RUN)
    readers = {
        ".safetensors": load_file,
        ".npz": np.load,
        ".json": lambda p: json.loads(p.read_text()),
    }
    files = [path for path in (tmp_path / "checkpoints").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == set(readers)
    assert all(len(readers[path.suffix](path)) for path in files)


@pytest.mark.fault(114)
def test_other_versions_are_said(expert, tmp_path):
    with pytest.raises(Stop):
        fdtasil.distill(expert, TOY, out=tmp_path, callback=stop_at(1), **RUN)
    path = tmp_path / "checkpoints" / "config.json"
    config = json.loads(path.read_text())
    config["versions"]["torch"] = "1.0"
    path.write_text(json.dumps(config))
    with pytest.warns(FdtasilWarning, match=r"bytes may differ: versions\.torch was '1\.0'"):
        fdtasil.distill(expert, TOY, resume=tmp_path, **RUN)


@pytest.mark.fault(122)
def test_a_clock_that_jumps_changes_nothing(expert, states, tmp_path, monkeypatch):
    moments = itertools.cycle([0.0, 4e9, 1e9])
    monkeypatch.setattr(time, "time", lambda: next(moments))
    fdtasil.distill(expert, TOY, out=tmp_path / "run", seed=0, **SHORT)
    assert read(tmp_path / "run") == read(states[0])
