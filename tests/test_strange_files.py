"""Files and folders that somebody else made: nothing is written elsewhere, nothing is lost."""

import errno
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from toy_environments import Integrator

import fdtasil
from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import ExpertError, FdtasilError, FdtasilWarning, SettingError, StorageError
from fdtasil.files.lock import locked
from fdtasil.files.names import inside
from fdtasil.files.plain import from_plain, to_plain
from fdtasil.files.storage import COMING, sha256, to_json, verify, write_bytes, write_folder
from fdtasil.results import figures
from fdtasil.results.evaluation import Evaluation
from fdtasil.run import pipeline
from fdtasil.shell.distill import _remembered
from fdtasil.student.view import View

pytestmark = pytest.mark.usefixtures("no_pictures")

SHORT = {**QUICK, "fit": fdtasil.Fit(steps=3), "evaluation_episodes": 0, "progress": False}
unix = pytest.mark.skipif(os.name != "posix", reason="named pipes, links, devices")


class Stop(Exception):
    """Ends a run where a test wants it."""


def stop(event):
    raise Stop


def snapshot(folder):
    """Every file below a folder, by name; links by what they say."""
    return {
        str(path.relative_to(folder)): os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


@pytest.fixture
def run(quick_folder, tmp_path):
    """A finished run's folder, to be spoilt."""
    return shutil.copytree(quick_folder, tmp_path / "run")


@pytest.fixture
def never():
    def expert(observations):
        raise AssertionError("the expert was asked")

    return expert


# --- names, links


@pytest.mark.fault(124)
@unix
@pytest.mark.parametrize("second", ["symbolic", "hard"])
@pytest.mark.parametrize("way", ["save", "out", "resume"])
def test_a_lock_that_leads_elsewhere_is_not_written(second, way, run, quick, linear, tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    (run / ".lock").symlink_to(notes) if second == "symbolic" else os.link(notes, run / ".lock")
    ways = {"save": lambda: quick.save(run)}
    for name in ("out", "resume"):
        ways[name] = lambda name=name: fdtasil.distill(linear, TOY, 3, **QUICK, **{name: run})
    with pytest.raises(StorageError, match=r"\.lock"):
        ways[way]()
    assert notes.read_text() == "mine"


@pytest.mark.fault(125)
@pytest.mark.parametrize("name", ["../conftest.py", "/conftest.py", "a/../../conftest.py", ".."])
def test_what_is_coming_goes_nowhere_else(name, run, quick, tmp_path):
    (tmp_path / "conftest.py").write_text("mine")
    (run / "conftest.py").write_text("theirs")
    (run / COMING).mkdir()
    (run / COMING / "manifest.json").write_bytes(to_json({name: ""}))
    before = snapshot(tmp_path)
    for way in (lambda: quick.save(run), lambda: fdtasil.Distilled.load(run)):
        with pytest.raises(StorageError, match="outside of the folder"):
            way()
    assert snapshot(tmp_path) == before


@pytest.mark.fault(125)
@unix
@pytest.mark.parametrize(
    "link", ["figures", "config.json", "manifest.json", "checkpoints", COMING]
)
def test_links_in_a_run_folder_are_refused(link, run, quick, linear, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "training.png").write_text("mine")
    place = run / link
    if place.is_dir():
        shutil.rmtree(place)
    elif place.exists():
        place.rename(elsewhere / link)
    place.symlink_to(elsewhere / link if (elsewhere / link).exists() else elsewhere)
    before = snapshot(tmp_path)
    for way in (
        lambda: quick.save(run),
        lambda: fdtasil.distill(linear, TOY, 3, **QUICK, resume=run),
        lambda: fdtasil.distill(linear, TOY, 3, **QUICK, out=run),
    ):
        with pytest.raises(StorageError, match="is a link"):
            way()
    if link != "checkpoints":  # which a finished run has none of
        with pytest.raises(StorageError):
            fdtasil.Distilled.load(run)
    assert snapshot(tmp_path) == before


@pytest.mark.fault(125)
@unix
def test_what_an_old_manifest_names_behind_a_link_is_not_removed(tmp_path):
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "run"
    elsewhere.mkdir()
    (elsewhere / ".bashrc").write_text("mine")
    folder.mkdir()
    (folder / "x").symlink_to(elsewhere)
    (folder / "manifest.json").write_bytes(to_json({"x/.bashrc": sha256(b"mine")}))
    write_folder(folder, {"a": b"1"})
    assert (elsewhere / ".bashrc").read_text() == "mine"
    with pytest.raises(StorageError, match="is a link"):
        write_folder(folder, {"x/.bashrc": b"theirs"})
    assert (elsewhere / ".bashrc").read_text() == "mine"


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/..", "/a", "a\0", "a\\b", "c:a", "\x1b[2J", "a\n"]
)
def test_names_that_are_no_names_of_files_inside(name, tmp_path):
    with pytest.raises(StorageError, match="outside of the folder"):
        inside(tmp_path, name)


@pytest.mark.fault(124)
@pytest.mark.parametrize("member", ["../a.npy", "/a.npy", "observations.txt", "a\0.npy"])
def test_names_in_an_npz_are_looked_at(member, quick):
    target = io.BytesIO(quick.dataset.to_bytes())
    with zipfile.ZipFile(target, "a") as archive:
        archive.writestr(member, b"\x93NUMPY")
    with pytest.raises(StorageError, match="not demonstrations"):
        Dataset.from_bytes(target.getvalue())


# --- HDF5


@pytest.fixture
def minari_root(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def external_storage(group, secret):
    del group["observations"]
    group.create_dataset("observations", (4, 5), np.float32, external=[(str(secret), 0, 80)])


def external_link(group, secret):
    import h5py

    with h5py.File(secret, "w") as file:
        file["data"] = np.zeros((4, 5), np.float32)
    del group["observations"]
    group["observations"] = h5py.ExternalLink(str(secret), "/data")


def soft_link(group, secret):
    import h5py

    del group["observations"]
    group["observations"] = h5py.SoftLink("/episode_0/actions")


def virtual(group, secret):
    import h5py

    with h5py.File(secret, "w") as file:
        file["data"] = np.zeros((4, 5), np.float32)
    layout = h5py.VirtualLayout((4, 5), np.float32)
    layout[:] = h5py.VirtualSource(str(secret), "data", (4, 5))
    del group["observations"]
    group.create_virtual_dataset("observations", layout)


def unpacking(group, secret):
    del group["observations"]
    group.create_dataset("observations", (10**9, 5), np.float32, chunks=(10**6, 5), compression=9)


@pytest.mark.fault(126)
@pytest.mark.parametrize("trick", [external_storage, external_link, soft_link, virtual, unpacking])
def test_an_hdf5_file_reads_no_other_file(trick, quick, minari_root, tmp_path):
    h5py = pytest.importorskip("h5py")
    fdtasil.to_minari(quick.dataset, "toy/theirs-v0")
    secret = tmp_path / "secret"
    secret.write_bytes(b"secret " * 20)
    with h5py.File(minari_root / "toy/theirs-v0/data/main_data.hdf5", "a") as file:
        trick(file["episode_0"], secret)
    with pytest.raises(StorageError, match="not the Minari dataset"):
        fdtasil.from_minari("toy/theirs-v0")


@pytest.mark.fault(126)
@pytest.mark.parametrize("key", ["observation_space", "action_space"])
def test_a_dataset_can_not_have_an_environment_made(key, quick, minari_root):
    fdtasil.to_minari(quick.dataset, "toy/theirs-v0")
    path = minari_root / "toy/theirs-v0/data/metadata.json"
    metadata = json.loads(path.read_text())
    del metadata[key]
    metadata["env_spec"] = json.dumps({"id": "X-v0", "entry_point": "attacker:X"})
    path.write_text(json.dumps(metadata))
    with pytest.raises(StorageError, match="spaces"):
        fdtasil.from_minari("toy/theirs-v0")


@pytest.mark.fault(126)
@pytest.mark.parametrize("name", ["{}/x-v0", "../x-v0", "toy/no version", "new/space/x"])
def test_a_failed_to_minari_leaves_nothing_behind(name, quick, minari_root, tmp_path):
    minari_root.mkdir()
    before = set(tmp_path.rglob("*"))
    with pytest.raises(StorageError):
        fdtasil.to_minari(quick.dataset, name.format(tmp_path))
    assert set(tmp_path.rglob("*")) == before


# --- folders of others


def own_checkpoints(folder):
    (folder / "checkpoints" / "1").mkdir(parents=True)
    (folder / "checkpoints" / "1" / "model.pt").write_text("mine")


def flat_checkpoints(folder):
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "model.pt").write_text("mine")


def empty_checkpoints(folder):
    (folder / "checkpoints").mkdir(parents=True)


def own_names(folder):
    folder.mkdir()
    for name in ("config.json", "report.json", "manifest.json"):
        (folder / name).write_text('{"train.csv": "abc"}')


def own_notes(folder):
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")


def own_coming(folder):
    (folder / COMING).mkdir(parents=True)
    (folder / COMING / "notes.txt").write_text("mine")


def hidden(folder):
    folder.mkdir()
    (folder / ".notes.txt.1.abcdef.tmp").write_text("mine")


OWN = [
    own_checkpoints,
    flat_checkpoints,
    empty_checkpoints,
    own_names,
    own_notes,
    own_coming,
    hidden,
]


@pytest.mark.fault(127)
@pytest.mark.parametrize("fill", OWN)
def test_a_folder_that_is_no_runs_is_never_written_into(fill, never, quick, tmp_path):
    """The next step of the error, typed as it stands, deletes nothing and works."""
    folder = tmp_path / "proj"
    fill(folder)
    before = snapshot(folder), set(folder.rglob("*"))
    for way in (
        lambda: fdtasil.distill(never, TOY, 2, out=folder, **SHORT),
        lambda: quick.save(folder),
    ):
        with pytest.raises(StorageError, match="proj holds ") as caught:
            way()
        assert (snapshot(folder), set(folder.rglob("*"))) == before
    other = caught.value.next_step.partition('out="')[2].partition('"')[0]
    quick.save(other)
    assert fdtasil.Distilled.load(other).queries == quick.queries
    assert before[0].items() <= snapshot(folder).items()


@pytest.mark.fault(127)
@pytest.mark.parametrize("fill", OWN)
def test_a_shell_writes_into_no_folder_of_others(fill, inside, tmp_path):
    expert, folder = mlp_onnx(tmp_path / "e.onnx"), tmp_path / "proj"
    fill(folder)
    before = snapshot(folder)
    shown = inside("distill", expert, TOY, "--out", folder, "--episodes", 1)
    assert shown.returncode == 1
    assert "proj holds " in shown.stderr
    assert snapshot(folder) == before


@pytest.mark.fault(127)
def test_own_checkpoints_beside_a_finished_run_stay(run, quick, never):
    flat = run / "checkpoints" / "model.pt"
    flat.parent.mkdir()
    flat.write_text("mine")
    with pytest.raises(StorageError, match="checkpoints/ that is no run's"):
        fdtasil.distill(never, TOY, 2, out=run, **SHORT)
    with pytest.raises(StorageError, match="checkpoints/ that is no run's"):
        quick.save(run)
    assert flat.read_text() == "mine"


@pytest.mark.fault(127)
def test_an_unfinished_run_is_not_deleted_either(linear, tmp_path):
    with pytest.raises(Stop):
        fdtasil.distill(linear, TOY, 2, out=tmp_path / "run", callback=stop, **QUICK)
    with pytest.raises(SettingError, match="a run that has not ended") as caught:
        fdtasil.distill(linear, TOY, 2, out=tmp_path / "run", **QUICK)
    assert "remove" not in str(caught.value)


@pytest.mark.parametrize("state", ["missing", "empty", "finished", "finished before formats"])
def test_folders_that_may_be_written(state, quick, tmp_path):
    folder = tmp_path / "run"
    if state == "empty":
        folder.mkdir()
    if state.startswith("finished"):
        quick.save(folder)
        (folder / "notes.txt").write_text("the user's own, who knows that it is a run's")
    if state == "finished before formats":
        before_formats(folder)
    quick.save(folder)
    assert fdtasil.Distilled.load(folder).settings == quick.settings


# --- formats


def before_formats(folder, **changes):
    """Make a finished run of the time before there were formats, or of another time."""
    files = verify(folder)
    config = json.loads(files["config.json"])
    del config["format"], config["made_by"]
    write_folder(folder, {**files, "config.json": to_json({**config, **changes})})


@pytest.mark.fault(128)
def test_a_finished_run_of_the_time_before_formats_is_read(run, quick):
    before_formats(run)
    assert fdtasil.Distilled.load(run).settings == quick.settings


@pytest.mark.fault(128)
@pytest.mark.parametrize("number", [2, 10**30, "1", True, -1])
def test_a_finished_run_of_another_format_is_named(number, run):
    before_formats(run, format=number)
    with pytest.raises(StorageError, match=r"written by (a newer|an older) fdtasil: format"):
        fdtasil.Distilled.load(run)


@pytest.mark.fault(128)
@pytest.mark.parametrize(
    ("number", "found"), [(None, "an older fdtasil: no format"), (2, "a newer fdtasil: format 2")]
)
def test_an_unfinished_run_of_another_format_is_named(number, found, linear, tmp_path):
    with pytest.raises(Stop):
        fdtasil.distill(linear, TOY, 2, out=tmp_path, callback=stop, **QUICK)
    path = tmp_path / "checkpoints" / "config.json"
    config = json.loads(path.read_text())
    assert config["format"] == 1
    del config["format"], config["made_by"]
    path.write_bytes(to_json(config | ({} if number is None else {"format": number})))
    for way in ({"resume": tmp_path}, {"out": tmp_path}):
        with pytest.raises(StorageError, match=r"written by|holds") as caught:
            fdtasil.distill(linear, TOY, 2, **way, **QUICK)
        if "resume" in way:
            assert found in str(caught.value)


@pytest.mark.fault(128)
def test_the_experts_file_may_lie_elsewhere(tmp_path):
    here = mlp_onnx(tmp_path / "e.onnx")
    with pytest.raises(Stop):
        fdtasil.distill(here, TOY, 2, out=tmp_path / "run", callback=stop, **QUICK)
    (tmp_path / "there").mkdir()
    there = here.rename(tmp_path / "there" / "other.onnx")
    result = fdtasil.distill(there, TOY, 2, resume=tmp_path / "run", **QUICK)
    whole = fdtasil.distill(there, TOY, 2, **QUICK)
    assert result.student.to_bytes() == whole.student.to_bytes()
    changed = mlp_onnx(tmp_path / "changed.onnx", scale=0.9)
    with pytest.raises(SettingError, match="expert_sha256"):
        fdtasil.distill(changed, TOY, 2, resume=tmp_path / "run", **QUICK)


# --- what was trained is not lost


@pytest.mark.fault(129)
def test_a_picture_that_can_not_be_drawn_loses_nothing(linear, tmp_path, monkeypatch):
    def latex(result):
        raise RuntimeError("latex was not found")

    monkeypatch.setitem(figures.FIGURES, "training", latex)
    with pytest.warns(FdtasilWarning, match=r"training\.png is left out: .* latex"):
        result = fdtasil.distill(linear, TOY, 2, out=tmp_path / "run", **QUICK)
    again = fdtasil.Distilled.load(tmp_path / "run")
    assert again.student.to_bytes() == result.student.to_bytes()
    assert "latex" in again.report["warnings"][-1]
    assert (tmp_path / "run" / "student.onnx").exists()
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.fault(129)
def test_weights_are_there_before_anything_is_drawn(quick, tmp_path, monkeypatch):
    """Also where drawing ends the process."""
    seen = []

    def look(result):
        seen.append(fdtasil.Distilled.load(tmp_path / "run").student.to_bytes())
        raise KeyboardInterrupt

    monkeypatch.setitem(figures.FIGURES, "training", look)
    with pytest.raises(KeyboardInterrupt):
        quick.save(tmp_path / "run")
    assert seen == [quick.student.to_bytes()]
    assert fdtasil.Distilled.load(tmp_path / "run").queries == quick.queries


@pytest.mark.fault(130)
def test_infinite_numbers_are_null_in_the_report(quick, tmp_path):
    from dataclasses import replace

    broken = replace(quick.evaluation, student_returns=(1.0, np.inf), student_return=np.inf)
    report = {**quick.report, "evaluation": broken.to_json()}
    result = replace(quick, evaluation=broken, report=report)
    with pytest.warns(FdtasilWarning, match=r"evaluation\.student_return"):
        result.save(tmp_path / "run")
    again = fdtasil.Distilled.load(tmp_path / "run")
    assert np.isnan(again.evaluation.student_return)
    assert again.evaluation.student_returns[0] == 1.0
    assert "null" in again.report["warnings"][-1]
    assert (
        json.loads((tmp_path / "run/report.json").read_text())["evaluation"]["student_return"]
        is None
    )
    str(again.evaluation)


def test_plain_values_of_other_types_are_refused(quick):
    plain = to_plain(quick.evaluation)
    assert from_plain(Evaluation, plain) == quick.evaluation
    for name, value in {"episodes": "2", "horizon": True, "ci95": [1], "survival": []}.items():
        with pytest.raises(TypeError):
            from_plain(Evaluation, {**plain, name: value})


class Unclosable(Integrator):
    def close(self):
        raise OSError("the simulator is gone")


@pytest.mark.fault(131)
def test_an_environment_that_can_not_be_closed_loses_nothing(linear, tmp_path):
    with pytest.warns(FdtasilWarning, match="simulator is gone"):
        result = fdtasil.distill(
            linear,
            lambda: gymnasium.wrappers.TimeLimit(Unclosable(), 20),
            2,
            out=tmp_path / "run",
            **QUICK,
        )
    assert result.evaluation is not None
    assert fdtasil.Distilled.load(tmp_path / "run").queries == result.queries


@pytest.mark.fault(131)
def test_an_error_is_not_hidden_by_an_environment_that_can_not_be_closed(tmp_path):
    def expert(observations):
        raise KeyError("mine")

    with (
        pytest.warns(FdtasilWarning, match="simulator is gone"),
        pytest.raises(FdtasilError, match="mine"),
    ):
        fdtasil.distill(expert, lambda: gymnasium.wrappers.TimeLimit(Unclosable(), 20), 2, **QUICK)


# --- saves side by side, other folders, devices


@pytest.mark.fault(132)
def test_save_waits_for_another_save(quick, tmp_path):
    script = f"""
import time
from pathlib import Path
from fdtasil.files.lock import locked
with locked(Path({str(tmp_path / "run")!r})):
    print("held", flush=True)
    time.sleep(0.7)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        began = time.monotonic()
        quick.save(tmp_path / "run")
        assert time.monotonic() - began > 0.2
    assert fdtasil.Distilled.load(tmp_path / "run").queries == quick.queries
    assert not (tmp_path / "run" / ".lock").exists()


@pytest.mark.fault(132)
def test_a_reader_in_the_middle_of_a_move_reads_again(tmp_path, monkeypatch):
    """The move goes on by one file between each two reads."""
    folder = tmp_path / "run"
    write_folder(folder, {"a": b"1", "b": b"1"})
    coming, steps = folder / COMING, []
    new = {"a": b"2", "b": b"2"}
    manifest = {name: sha256(data) for name, data in new.items()}
    real = fdtasil.files.storage.read_plain

    def read(path, *arguments, **named):
        if not steps:
            for name, data in new.items():
                write_bytes(coming / name, data)
            write_bytes(coming / "manifest.json", to_json(manifest))
            steps.extend(["a", "b", "manifest.json"])
        data = real(path, *arguments, **named)
        if steps[0] is not None:
            (coming / steps[0]).replace(folder / steps[0])
            steps[:] = steps[1:] or [None]
        return data

    monkeypatch.setattr("fdtasil.files.storage.read_plain", read)
    assert verify(folder) == new


SAVER = """
import sys, warnings
from pathlib import Path
import torch
torch.set_num_threads(1)
import fdtasil
from fdtasil.results import figures
figures.FIGURES.clear()
own, folder = map(Path, sys.argv[1:])
result = fdtasil.Distilled.load(own)
print("ready", flush=True)
for line in sys.stdin:
    try:
        result.save(folder)
        print("saved", flush=True)
    except Exception as error:
        print(type(error).__name__, str(error).splitlines()[0], flush=True)
"""
READER = """
import sys, time
from pathlib import Path
import fdtasil
folder, count = Path(sys.argv[1]), int(sys.argv[2])
fdtasil.Distilled.load(folder)
print("ready", flush=True)
sys.stdin.readline()
for _ in range(count):
    try:
        fdtasil.Distilled.load(folder)
        print("read", flush=True)
    except Exception as error:
        print(type(error).__name__, str(error).splitlines()[0], flush=True)
    time.sleep(0.01)
"""


def child(script, *arguments):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
    return subprocess.Popen([sys.executable, "-c", script, *map(str, arguments)], **pipes)


@pytest.mark.slow
@pytest.mark.fault(132)
@pytest.mark.parametrize(
    ("pairs", "reads"), [(3, 20), pytest.param(300, 1000, marks=pytest.mark.torture)]
)
def test_simultaneous_saves_and_reads(pairs, reads, quick, linear, tmp_path, figure):
    other = fdtasil.distill(linear, TOY, 3, seed=1, **QUICK)
    owns = [quick.save(tmp_path / "a"), other.save(tmp_path / "b")]
    folder = quick.save(tmp_path / "run")
    whole = {quick.student.to_bytes(), other.student.to_bytes()}
    savers = [child(SAVER, own, folder) for own in owns]
    reader = child(READER, folder, reads)
    processes = [*savers, reader]
    try:
        assert [one.stdout.readline() for one in processes] == ["ready\n"] * 3
        reader.stdin.write("go\n")
        outcomes = []
        for _ in range(pairs):
            for one in savers:
                one.stdin.write("go\n")
            outcomes += [one.stdout.readline().strip() for one in savers]
            assert fdtasil.Distilled.load(folder).student.to_bytes() in whole
        found = [reader.stdout.readline().strip() for _ in range(reads)]
    finally:
        for one in processes:
            one.kill()
            one.communicate()
    assert set(outcomes) == {"saved"}
    assert set(found) == {"read"}
    assert sorted(path.name for path in folder.iterdir() if path.name.startswith(".")) == []
    figure(f"{pairs} pairs of simultaneous saves", "all saved, 0 unreadable")
    figure(f"{reads} reads beside saves", "0 false alarms")


class Wanderer(Integrator):
    """Changes the working folder, as some simulators do."""

    def reset(self, **options):
        Path("elsewhere").mkdir(exist_ok=True)
        os.chdir("elsewhere")
        return super().reset(**options)


@pytest.mark.fault(133)
def test_an_environment_that_changes_the_working_folder(linear, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = fdtasil.distill(
        linear, lambda: gymnasium.wrappers.TimeLimit(Wanderer(), 20), 2, out="run", **QUICK
    )
    assert Path.cwd() != tmp_path
    assert fdtasil.Distilled.load(tmp_path / "run").queries == result.queries
    assert not list(tmp_path.rglob(".lock"))
    assert len(list(tmp_path.rglob("manifest.json"))) == 1


@pytest.mark.fault(133)
@unix
@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "a link to a pipe"])
def test_an_export_replaces_no_special_file(kind, quick, tmp_path):
    import socket

    path = tmp_path / "x.onnx"
    listener = socket.socket(socket.AF_UNIX)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        listener.bind(str(path))
    else:
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to(tmp_path / "pipe")
    before = path.lstat().st_mode, path.lstat().st_ino
    for way in (quick.to_onnx, quick.export):
        with pytest.raises(StorageError, match="can't write") as caught:
            way(path)
        assert "choose another name" in caught.value.next_step
    assert (path.lstat().st_mode, path.lstat().st_ino) == before
    listener.close()


@pytest.mark.fault(133)
@unix
def test_a_device_is_written_through(quick, tmp_path):
    before = os.stat("/dev/null").st_mode
    quick.to_onnx("/dev/null")
    (tmp_path / "x.onnx").symlink_to("/dev/null")
    quick.export(tmp_path / "x.onnx")
    assert (tmp_path / "x.onnx").is_symlink()
    assert os.stat("/dev/null").st_mode == before
    with pytest.raises(StorageError, match="can't write /dev/full"):
        quick.to_onnx("/dev/full")


@pytest.mark.fault(133)
@unix
def test_an_export_to_a_link_writes_what_it_leads_to(quick, tmp_path):
    (tmp_path / "x.onnx").symlink_to(tmp_path / "y.onnx")
    quick.to_onnx(tmp_path / "x.onnx")
    assert (tmp_path / "x.onnx").is_symlink()
    assert (tmp_path / "y.onnx").stat().st_size > 100


# --- pickles of results


def sines(rows):
    return np.sin(rows[:, :2])


@pytest.mark.fault(134)
@pytest.mark.parametrize("seen", [None, [0, 2], sines])
def test_a_view_survives_pickling(seen):
    rows = np.random.default_rng(0).standard_normal((8, 5)).astype(np.float32)
    view = View.of(seen, rows)
    again = pickle.loads(pickle.dumps(view))
    assert np.array_equal(again.look(rows), view.look(rows))
    assert (again.columns, again.size) == (view.columns, view.size)


@pytest.mark.fault(134)
def test_a_result_survives_pickling(quick, linear):
    again = pickle.loads(pickle.dumps(quick))
    assert again.student.to_bytes() == quick.student.to_bytes()
    assert again.export_bytes("x.onnx") == quick.export_bytes("x.onnx")
    assert pickle.loads(pickle.dumps(quick.dataset)).to_bytes() == quick.dataset.to_bytes()
    function = fdtasil.distill(
        linear, TOY, "sphere:2,forward", student_obs=lambda rows: rows[:, :2] * 1.0, **SHORT
    )
    again = pickle.loads(pickle.dumps(function))
    assert again.student.to_bytes() == function.student.to_bytes()
    with pytest.raises(SettingError, match="the function <lambda>"):
        again.export_bytes("x.onnx")


def _in_a_pool(seed):
    torch.set_num_threads(1)
    return fdtasil.distill(lambda rows: rows @ GAIN.T, TOY, 2, seed=seed, **SHORT)


@pytest.mark.fault(134)
@pytest.mark.torture
def test_a_run_in_a_process_pool_is_not_lost():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        found = pool.submit(_in_a_pool, 3).result(120)
    assert found.student.to_bytes() == _in_a_pool(3).student.to_bytes()


# --- readers


DEEP = b"[" * 10**5


@pytest.mark.fault(135)
@pytest.mark.parametrize("name", ["config.json", "report.json", "manifest.json"])
@pytest.mark.parametrize(
    "data", [DEEP, b"[]", b"null", b'{"a":' * 10**4, b"\xff", b"1" * 5000, b""]
)
def test_json_of_a_run_that_is_none(name, data, run):
    files = verify(run)
    if name == "manifest.json":
        (run / name).write_bytes(data)
    else:
        write_folder(run, {**files, name: data})
    with pytest.raises(StorageError) as caught:
        fdtasil.Distilled.load(run)
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.fault(135)
@pytest.mark.parametrize(
    "data", [DEEP, b"[]", b"null", b'{"env": 3}', b'{"hidden": "a"}', b'{"x": 1}', b"\xff"]
)
def test_arguments_of_a_shell_that_are_none(data, tmp_path):
    (tmp_path / "command.json").write_bytes(data)
    with pytest.raises(FdtasilError):
        _remembered(tmp_path)


def header(shape, kind="<f4"):
    target = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        target, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return target.getvalue()


def npz(members, *, compressed=False):
    target = io.BytesIO()
    how = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(target, "w", how) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return target.getvalue()


@pytest.mark.fault(136)
@pytest.mark.parametrize(
    "data",
    [
        npz({"observations": header((10**12, 5))}),
        npz({"observations": header((10**12, 0))}),
        npz({"observations": header((2**31, 2**31, 0))}),
        npz({"observations": header((-1, 5))}),
        npz({"observations": header((1,) * 40)}),
        npz({"observations": header((1,), "|O") + b"x" * 8}),
        npz({"observations": header((1, 1), "|V1000000000")}),
        npz({"observations": bytes(2**28)}, compressed=True),
        npz({str(number): b"" for number in range(100)}),
    ],
)
def test_an_npz_claims_more_than_it_has(data):
    import tracemalloc

    tracemalloc.start()
    with pytest.raises(StorageError, match="not demonstrations"):
        Dataset.from_bytes(data)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


@pytest.mark.fault(136)
@pytest.mark.parametrize(
    "hidden", [[10**9], [16, 10**6], 10**9, [16] * 10**5, [-1], ["a"], {}, None]
)
def test_a_student_is_no_larger_than_its_weights(hidden, quick):
    from fdtasil.files.tensors import tensors_from_bytes, tensors_to_bytes
    from fdtasil.student.policy import Student

    tensors, about = tensors_from_bytes(quick.student.to_bytes(), "fdtasil", "weights")
    about["student"]["hidden"] = hidden
    with pytest.raises(StorageError, match="not a student's weights"):
        Student.from_bytes(tensors_to_bytes(tensors, about, "fdtasil"))


@pytest.mark.fault(136)
def test_numbers_of_displacements_that_are_not_there(quick, tmp_path):
    from dataclasses import replace

    answers = replace(quick.answers, numbers=quick.answers.numbers + 10**6)
    path = tmp_path / "demonstrations.npz"
    path.write_bytes(replace(quick.dataset, answers=answers).to_bytes())
    with pytest.raises(SettingError, match="displacements"):
        fdtasil.distill(dataset=path, fit=fdtasil.Fit(steps=1))


@pytest.mark.fault(136)
def test_arrays_of_other_types_become_ours_or_are_refused(quick):
    plain = dict(np.load(io.BytesIO(quick.dataset.to_bytes())))

    def read(**changes):
        target = io.BytesIO()
        np.savez_compressed(target, **{**plain, **changes})
        return Dataset.from_bytes(target.getvalue())

    wide = read(
        observations=np.asfortranarray(plain["observations"], ">f8"),
        episode=plain["episode"].astype(np.int64),
        terminated=plain["terminated"].astype(np.uint8),
    )
    assert wide.to_bytes() == quick.dataset.to_bytes()
    for name, value in {
        "episode": plain["episode"] + 0.5,
        "round": plain["round"].astype(np.int64) + 2**40,
        "terminated": plain["terminated"] + 3,
        "gains": -plain["gains"],
        "observations": plain["observations"].astype(complex),
        "about": np.frombuffer(DEEP, np.uint8),
    }.items():
        with pytest.raises(StorageError, match="not demonstrations"):
            read(**{name: value})


# --- the hub


def no_hash(name):
    from huggingface_hub.hf_api import BlobLfsInfo, RepoSibling

    large = BlobLfsInfo(size=3, sha256="", pointer_size=130)
    return {
        "not listed": {},
        "no hash": {"e.onnx": RepoSibling(rfilename="e.onnx", size=3)},
        "an empty hash": {"e.onnx": RepoSibling(rfilename="e.onnx", size=3, blob_id="")},
        "a store without one": {
            "e.onnx": RepoSibling(rfilename="e.onnx", size=3, blob_id="x", lfs=large)
        },
    }[name]


@pytest.mark.fault(140)
@pytest.mark.parametrize("name", ["not listed", "no hash", "an empty hash", "a store without one"])
def test_a_file_of_the_hub_without_a_hash_is_not_kept(name, tmp_path, monkeypatch):
    pytest.importorskip("huggingface_hub")
    from fdtasil.experts import hub

    def never(uri):
        raise AssertionError("downloaded")

    commit = "a" * 40
    monkeypatch.setenv("HF_ASSETS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(hub, "look_up", lambda uri: (uri, no_hash(name)))
    monkeypatch.setattr(hub, "download", never)
    with pytest.raises(ExpertError, match=r"no hash of e\.onnx"):
        fdtasil.load_expert(f"hf://org/repo/e.onnx@{commit}")
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


@pytest.mark.fault(140)
@pytest.mark.parametrize(
    "uri", ["hf://../../e.onnx", "hf://org/../e.onnx", "hf://org/repo/../e.onnx"]
)
def test_a_file_of_the_hub_has_a_name_of_its_own(uri):
    with pytest.raises(ExpertError, match=r"hf://org/repo/"):
        fdtasil.load_expert(uri)


# --- what is no plain file


@pytest.mark.fault(137)
@unix
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "name", ["manifest.json", "config.json", "demonstrations.npz", ".lock", "command.json"]
)
def test_a_pipe_in_a_run_folder_is_not_waited_for(kind, name, run, quick, tmp_path):
    def spoil(path):
        path.unlink(missing_ok=True)
        try:
            os.mkfifo(path) if kind == "pipe" else os.mknod(path, 0o20666, os.makedev(1, 5))
        except PermissionError:
            pytest.skip("only root makes devices")

    spoil(run / name)
    ways = {".lock": lambda: quick.save(run), "command.json": lambda: _remembered(run)}
    with pytest.raises(FdtasilError):
        ways.get(name, lambda: fdtasil.Distilled.load(run))()
    data = tmp_path / "demonstrations.npz"
    spoil(data)
    with pytest.raises(FdtasilError, match=r"plain file"):
        fdtasil.distill(dataset=data)
    for file in ("expert.onnx", "agent.zip"):
        spoil(tmp_path / file)
        with pytest.raises(FdtasilError, match=r"plain file|can't be read"):
            fdtasil.load_expert(tmp_path / file)


WINDOWS = """
import os, signal, sys
import gymnasium, onnx, onnxruntime, scipy.stats, torch, matplotlib.figure, matplotlib.backends
import torch._dynamo, stable_baselines3, cloudpickle, mujoco  # they know what they run on
sys.modules["fcntl"] = None
sys.modules["resource"] = None
os_only = "pwrite pread fork killpg getuid mkfifo setsid sched_getaffinity fchmod getpgid uname"
for name in [*os_only.split(), "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"]:
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGSTOP", "SIGALRM", "setitimer", "pthread_sigmask"):
    if hasattr(signal, name):
        delattr(signal, name)
import fdtasil
fit = fdtasil.Fit(steps=2)
options = dict(episodes=1, horizon=5, evaluation_episodes=2, fit=fit, student=fdtasil.Mlp(4))
options["progress"] = False
result = fdtasil.distill(
    lambda rows: -rows[:, :1], "Pendulum-v1", 2, force=True, out="run", **options
)
result.save("again")
result.save("again")
fdtasil.distill(dataset="run", out="other", student=fdtasil.Mlp(4), fit=fit)
print(fdtasil.Distilled.load("again").queries == result.queries, os.listdir("run").count(".lock"))
"""


@pytest.mark.fault(138)
@pytest.mark.torture
@pytest.mark.filterwarnings("ignore")
def test_it_runs_without_what_only_unix_has(tmp_path):
    shown = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WINDOWS],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert shown.stdout.split() == ["True", "0"], shown.stderr


@pytest.mark.fault(109)
def test_a_lock_is_held_on_a_full_disk(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with locked(tmp_path / "run"):
        assert (tmp_path / "run" / ".lock").exists()
    assert not (tmp_path / "run").exists()


def test_the_pipeline_names_the_folder_absolutely():
    assert pipeline._folder_of("run", None) == Path.cwd() / "run"


@pytest.mark.fault(141)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_keeps_no_lock_of_a_dead_parent(tmp_path):
    """Joblib's and torch's workers are such children, and may outlive a run that was killed."""
    code = f"""
import os, time
from pathlib import Path
from fdtasil.files.lock import locked
with locked(Path({str(tmp_path / "run")!r})):
    if os.fork() == 0:
        print(os.getpid(), flush=True)  # by the child, which then has let go
        time.sleep(60)
        os._exit(0)
    os._exit(1)  # killed
"""
    done = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    child = int(done.stdout.readline())
    done.wait()
    try:
        os.kill(child, 0)  # it lives
        with locked(tmp_path / "run"):
            pass
    finally:
        os.kill(child, 9)
