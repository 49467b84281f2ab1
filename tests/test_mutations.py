"""Every kind of file that is read, mutated at random: an error of ours or another content.

Run as a script, this is the child that reads them: it writes one line for each file, so that the
parent knows which one it died of.
"""

import copy
import io
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mutated_files import mutate

import fdtasil
from fdtasil.experts.silence import Silence

SECONDS = 90  # without a line, after which a child hangs; its start on a busy machine counts too
COUNT = 2000
MOST = 2**29  # bytes that reading one of these small files may take

VALUES = [
    *(None, True, False, -1, 0, 1, 10**30, 1e308, 0.5, "", "x", "\x1b[2J", "../x", "a" * 500),
    *([], {}, [[]], {"": None}, [None] * 9, ["x"] * 3),
]


class Reader:
    """One kind of file: the original, and what reads it."""

    def __init__(self, folder):
        self.folder = Path(folder)

    def mutated(self, data, random):
        return mutate(data, random)

    def run(self):
        return self.folder / "run"


def mutated_json(data, random):
    """Replace a value anywhere, drop it, or mutate bytes."""
    if random.integers(3) == 0:
        return mutate(data, random)
    root = [json.loads(data)]
    holder, key = root, 0
    while isinstance(holder[key], dict | list) and holder[key] and random.integers(6):
        inside = holder[key]
        keys = list(inside) if isinstance(inside, dict) else range(len(inside))
        holder, key = inside, keys[random.integers(len(keys))]
    kind = random.integers(8)
    if kind == 0 and isinstance(holder, dict):
        del holder[key]
    elif kind == 1:
        return json.dumps(root[0]).replace("1", "[" * 3000, 1).encode()
    else:
        holder[key] = copy.deepcopy(VALUES[random.integers(len(VALUES))])
    return json.dumps(root[0] if root else None, indent=2).encode() + b"\n"


def mutated_zip(data, random, how):
    """Mutate the file or one of its members, so that the zip itself stays whole."""
    if random.integers(3) == 0:
        return mutate(data, random)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[random.integers(len(members))]
    if random.integers(8) == 0:
        del members[name]
    elif random.integers(3) == 0 and name.endswith(".npy"):
        head = members[name][:128]  # the header alone: it claims shapes and types
        members[name] = mutate(head, random) + members[name][128:]
    else:
        members[name] = mutate(members[name], random)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", how) as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    return target.getvalue()


def mutated_tensors(data, random):
    """Mutate the file, or its header as JSON with a length that fits."""
    size = int.from_bytes(data[:8], "little")
    if random.integers(3) == 0:
        return mutate(data, random)
    header = json.loads(data[8 : 8 + size])
    if random.integers(2):
        about = header["__metadata__"]
        name = next(iter(about))
        about[name] = mutated_json(about[name].encode(), random).decode("utf-8", "replace")
        changed = json.dumps(header).encode()
    else:
        changed = mutated_json(json.dumps(header).encode(), random)
    return len(changed).to_bytes(8, "little") + changed + data[8 + size :]


class Npz(Reader):
    how = zipfile.ZIP_STORED

    def __init__(self, folder):
        super().__init__(folder)
        data = (self.run() / "demonstrations.npz").read_bytes()
        target = io.BytesIO()
        with (
            zipfile.ZipFile(io.BytesIO(data)) as old,
            zipfile.ZipFile(target, "w", self.how) as new,
        ):
            for name in old.namelist():
                new.writestr(name, old.read(name))
        self.data, self.path = target.getvalue(), self.folder / "mutated.npz"

    def read(self, random):
        self.path.write_bytes(mutated_zip(self.data, random, self.how))
        fdtasil.distill(
            dataset=self.path, fit=fdtasil.Fit(steps=1), student=fdtasil.Mlp(4), progress=False
        )


class CompressedNpz(Npz):
    how = zipfile.ZIP_DEFLATED


class Folder(Reader):
    """A file of a finished run; the manifest mostly says that nobody has changed it."""

    name = "report.json"
    change = staticmethod(mutated_json)

    def __init__(self, folder):
        super().__init__(folder)
        self.place = Path(tempfile.mkdtemp(dir=folder)) / "run"
        shutil.copytree(self.run(), self.place)
        self.data = (self.place / self.name).read_bytes()

    def read(self, random):
        from fdtasil.files.storage import sha256, to_json

        changed = self.change(self.data, random)
        (self.place / self.name).write_bytes(changed)
        manifest = json.loads((self.run() / "manifest.json").read_bytes())
        manifest[self.name] = sha256(changed)
        (self.place / "manifest.json").write_bytes(to_json(manifest))
        result = fdtasil.Distilled.load(self.place)
        result.student.predict(result.demonstrations.observations[:3])
        result.export_bytes("student.safetensors")
        str(result)
        result._metadata()


class Config(Folder):
    name = "config.json"


class Weights(Folder):
    name = "student.safetensors"
    change = staticmethod(mutated_tensors)


class Manifest(Folder):
    """The manifest itself, or one of files that are coming."""

    def read(self, random):
        from fdtasil.files.storage import COMING, write_folder

        data = (self.run() / "manifest.json").read_bytes()
        coming = self.place / COMING / "manifest.json"
        shutil.rmtree(self.place)
        shutil.copytree(self.run(), self.place)
        if random.integers(2):
            coming.parent.mkdir()
            coming.write_bytes(mutated_json(data, random))
        else:
            (self.place / "manifest.json").write_bytes(mutated_json(data, random))
        beside = sorted(path for path in self.folder.iterdir())
        try:
            if random.integers(2):
                write_folder(self.place, {"config.json": b"{}"})
            else:
                fdtasil.Distilled.load(self.place)
        finally:
            assert beside == sorted(path for path in self.folder.iterdir())


class Begun(Reader):
    """The configuration of an unfinished run."""

    def __init__(self, folder):
        super().__init__(folder)
        self.config = json.loads((self.folder / "begun/checkpoints/config.json").read_bytes())
        self.now = {k: v for k, v in self.config.items() if k not in ("format", "made_by")}
        self.place = Path(tempfile.mkdtemp(dir=folder))
        (self.place / "checkpoints").mkdir()

    def read(self, random):
        from fdtasil.run.folder import open_run_folder

        data = json.dumps(self.config).encode()
        (self.place / "checkpoints/config.json").write_bytes(mutated_json(data, random))
        with open_run_folder(self.place, self.now, resume=True):
            pass


class Command(Reader):
    def __init__(self, folder):
        super().__init__(folder)
        self.data = (self.folder / "command.json").read_bytes()
        self.place = Path(tempfile.mkdtemp(dir=folder))

    def read(self, random):
        from fdtasil.shell.call import distil
        from fdtasil.shell.distill import _remembered

        (self.place / "command.json").write_bytes(mutated_json(self.data, random))
        arguments = {**_remembered(self.place), "out": None, "resume": None, "max_queries": 1}
        if random.integers(4) == 0:
            distil(arguments, progress=False)  # asks too much: refused before anything is done


class Checkpoints(Reader):
    """Any file of any checkpoint, under a manifest that fits; the training goes on from it."""

    def __init__(self, folder):
        super().__init__(folder)
        self.stages = sorted((self.folder / "begun/checkpoints").glob("*/*/"))
        assert {path.name.partition("-")[0] for path in self.stages} >= {"added", "training"}

    def read(self, random):
        import torch

        from fdtasil.run import checkpoints
        from fdtasil.run.account import Account
        from fdtasil.student.fit_state import FitState
        from fdtasil.student.policy import Student

        place = self.stages[random.integers(len(self.stages))]
        files = {path.name: path.read_bytes() for path in place.iterdir()}
        del files["manifest.json"]
        name = sorted(files)[random.integers(len(files))]
        change = {
            ".json": mutated_json,
            ".npz": lambda data, random: mutated_zip(data, random, zipfile.ZIP_STORED),
            ".npy": mutate,
            ".safetensors": mutated_tensors,
        }[Path(name).suffix]
        files[name] = change(files[name], random)
        stage = getattr(checkpoints, place.name.partition("-")[0].upper())
        _, account = checkpoints._read_run(files)
        taken = Account({}, Silence(), [])
        taken.take_up(account)
        taken.to_json()
        content = stage.read(files)
        if stage is checkpoints.TRAINING:
            student = Student.from_bytes((self.run() / "student.safetensors").read_bytes())
            optimiser = torch.optim.AdamW(student.parameters(), fused=True)
            state = FitState(student, optimiser)
            state.restore(content.fit)
            student(torch.zeros(2, 5)).sum().backward()
            optimiser.step()
            if state._recent:
                torch.stack(state._recent).tolist()


class Minari(Reader):
    def __init__(self, folder):
        super().__init__(folder)
        os.environ["MINARI_DATASETS_PATH"] = str(Path(tempfile.mkdtemp(dir=folder)))
        place = Path(os.environ["MINARI_DATASETS_PATH"], "toy/mutated-v0")
        shutil.copytree(self.folder / "minari/toy/whole-v0", place)
        self.files = [place / "data/main_data.hdf5"] * 7 + [place / "data/metadata.json"]
        self.data = {path: path.read_bytes() for path in self.files}

    def read(self, random):
        path = self.files[random.integers(len(self.files))]
        change = mutated_json if path.suffix == ".json" else mutate
        path.write_bytes(change(self.data[path], random))
        try:
            fdtasil.from_minari("toy/mutated-v0")
        finally:
            path.write_bytes(self.data[path])


class Agent(Reader):
    def __init__(self, folder):
        super().__init__(folder)
        self.bases = [path.read_bytes() for path in sorted(self.folder.glob("*.zip"))]
        self.path = Path(tempfile.mkdtemp(dir=folder)) / "agent.zip"

    def read(self, random):
        import torch

        from fdtasil.experts.sb3.agent import read_agent

        data = self.bases[random.integers(len(self.bases))]
        if random.integers(3) == 0:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
            members["data"] = mutated_json(members["data"], random)
            target = io.BytesIO()
            with zipfile.ZipFile(target, "w") as archive:
                for name, content in members.items():
                    archive.writestr(name, content)
            self.path.write_bytes(target.getvalue())
        else:
            self.path.write_bytes(mutated_zip(data, random, zipfile.ZIP_STORED))
        agent = read_agent(self.path)
        agent.module(torch.zeros(2, agent.observation_size))


KINDS = {
    "npz": Npz,
    "npz, compressed": CompressedNpz,
    "checkpoints": Checkpoints,
    "config.json": Config,
    "config.json, unfinished": Begun,
    "report.json": Folder,
    "command.json": Command,
    "manifest.json": Manifest,
    "safetensors": Weights,
    "Minari HDF5": Minari,
    "agents": Agent,
}


@pytest.fixture(scope="module")
def originals(no_pictures, quick, tmp_path_factory):
    """A folder with one whole file of every kind."""
    from conftest import QUICK, TOY, mlp_onnx
    from sb3_agents import make_agent, save_agent

    from fdtasil.run.folder import RunFolder

    folder = tmp_path_factory.mktemp("originals")
    expert = mlp_onnx(folder / "e.onnx")
    run = {**QUICK, "probes": "sphere:2,forward", "progress": False}
    small = {**run, "student": fdtasil.Mlp(4), "fit": fdtasil.Fit(steps=120)}

    class Stop(Exception):
        pass

    def stop(event):
        if event.step >= 100:
            raise Stop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "due", property(lambda folder: folder._path is not None))
        fdtasil.distill(expert, TOY, out=folder / "run", **small)
        with pytest.raises(Stop):
            fdtasil.distill(expert, TOY, out=folder / "begun", callback=stop, **small)
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        with warnings.catch_warnings(action="ignore"):
            fdtasil.to_minari(quick.dataset, "toy/whole-v0")
    for name in ("SAC", "PPO"):
        save_agent(folder, make_agent(name), f"{name}.zip")
    arguments = {"expert": str(expert), "env": "Pendulum-v1", "probes": "10", "trust": None}
    arguments |= {"hidden": [8], "steps": 3, "seed": 1, "log_formats": [], "force": True}
    (folder / "command.json").write_text(json.dumps({"format": 1, **arguments}))
    return folder


def read_mutated(kind, folder, count):
    """Return how many of `count` files had which outcome; what must not be has its number."""
    outcomes, first = Counter(), 0
    while first < count:
        lines, ending = _child(kind, folder, first, count)
        outcomes.update(lines)
        first += len(lines)
        if first < count:
            outcomes[f"{ending} on file {first}"] += 1
            first += 1
    return outcomes


def _child(kind, folder, first, last):
    command = [sys.executable, __file__, kind, str(folder), str(first), str(last)]
    arrived = queue.SimpleQueue()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:

        def listen():
            for line in process.stdout:
                arrived.put(line.strip())
            arrived.put("")

        threading.Thread(target=listen, daemon=True).start()
        assert arrived.get(timeout=3 * SECONDS) == "ready", "its error is on standard error"
        lines, ending = [], "crash"
        try:
            while line := arrived.get(timeout=SECONDS):
                lines.append(line)
        except queue.Empty:
            ending = "hang"
        process.kill()
    return lines, ending


@pytest.mark.slow
@pytest.mark.fault(139)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_some_mutated_files_end_in_an_error_of_ours(kind, originals, monkeypatch):
    """In this process, since one of their own takes seconds to start."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", "")  # put back at the end
    reader, refused = KINDS[kind](originals), 0
    for number in range(10):
        try:
            reader.read(np.random.default_rng(number))
        except fdtasil.FdtasilError:
            refused += 1
    assert refused


@pytest.mark.fault(139)
@pytest.mark.torture
@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files_end_in_an_error_of_ours(kind, originals, figure):
    count = COUNT
    outcomes = read_mutated(kind, originals, count)
    bad = {name: n for name, n in outcomes.items() if name not in ("refused", "read")}
    assert not bad, bad
    assert outcomes["refused"] > count / 10
    figure(
        f"mutated files, {kind}",
        f"{outcomes['refused']} refused, {outcomes['read']} read, of {count}; 0 others",
    )


def _peak():
    """The most memory of this process since the last look, and begin anew."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    Path("/proc/self/clear_refs").write_text("5")
    return int(found[1]) * 1024


def main(kind, folder, first, last):
    import resource

    import torch

    torch.set_num_threads(1)
    fdtasil.distill  # loaded when it is named  # noqa: B018
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (2**35, most))
    unpickled = []
    sys.addaudithook(lambda event, _: unpickled.append(event) if "pickle" in event else None)
    reader = KINDS[kind](folder)
    warnings.simplefilter("ignore")
    print("ready", flush=True)
    for number in range(first, last):
        random = np.random.default_rng(number)
        before = _peak()
        unpickled.clear()
        try:
            reader.read(random)
            outcome = "read"
        except fdtasil.FdtasilError as error:
            text = str(error)
            outcome = "refused"
            if len(text.splitlines()) > 6 or not text.replace("\n", "").isprintable():
                outcome = f"a long or unprintable message of file {number}"
        except Exception as error:
            outcome = f"{type(error).__name__} on file {number}: {str(error)[:80]!r}"
        if (taken := _peak() - before) > MOST:
            outcome = f"{taken:,} bytes on file {number}"
        print(f"unpickled on file {number}" if unpickled else outcome, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
