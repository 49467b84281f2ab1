"""Files are whole or not there, and errors keep their form."""

import errno
import os
import pickle
import tracemalloc

import numpy as np
import pytest
from conftest import QUICK, TOY

import fdtasil
from fdtasil import errors
from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import SettingError, StorageError
from fdtasil.files.reading import read_plain
from fdtasil.files.storage import sha256, to_json, verify, write_bytes, write_folder
from fdtasil.seeding import episode_seeds, generator, torch_generator

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, errors.FdtasilError)
]


@pytest.mark.parametrize("kind", KINDS)
def test_every_error_says_three_things_and_survives_pickling(kind):
    error = kind("found this", "expected that", "do so")
    assert str(error).splitlines() == [
        "found this",
        "  expected: expected that",
        "  next step: do so",
    ]
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert again.found == "found this"


def test_a_folder_reads_back(tmp_path):
    files = {"a.txt": b"a", "deep/b.bin": bytes(range(256))}
    write_folder(tmp_path / "run", files)
    assert verify(tmp_path / "run") == files


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EIO])
def test_a_failed_write_leaves_the_old_file_whole(call, code, tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_bytes(path, b"old")

    def fail(*arguments, **named):
        raise OSError(code, os.strerror(code))

    target = {"fsync": "os.fsync", "replace": "pathlib.Path.replace"}[call]
    monkeypatch.setattr(target, fail)
    with pytest.raises(StorageError, match="can't write"):
        write_bytes(path, b"new")
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_missing_or_changed_file_is_named(tmp_path):
    with pytest.raises(StorageError, match=r"manifest\.json"):
        verify(tmp_path)
    write_folder(tmp_path, {"a": b"1", "b": b"2"})
    (tmp_path / "b").write_bytes(b"3")
    with pytest.raises(StorageError, match="b changed after writing"):
        verify(tmp_path)
    (tmp_path / "b").unlink()
    with pytest.raises(StorageError, match="No such file"):
        verify(tmp_path)


@pytest.mark.parametrize("name", ["../outside", "/etc/hostname", "a/../../outside"])
def test_a_manifest_reaches_no_file_outside_of_its_folder(name, tmp_path):
    (tmp_path / "outside").write_bytes(b"1")
    (tmp_path / "run" / "a").mkdir(parents=True)
    (tmp_path / "run" / "manifest.json").write_bytes(to_json({name: sha256(b"1")}))
    with pytest.raises(StorageError, match="outside of the folder"):
        verify(tmp_path / "run")


@pytest.mark.parametrize("data", [b"", b"nonsense", b"PK\x03\x04"])
def test_other_bytes_are_no_demonstrations(data):
    with pytest.raises(StorageError, match="not demonstrations"):
        Dataset.from_bytes(data)


@pytest.mark.fault(83)
def test_streams_are_found_by_name():
    assert generator(0, "a", 1).random() == generator(0, "a", 1).random()
    values = [
        generator(seed, *path).random() for seed in (0, 1) for path in (("a",), ("b",), ("a", 1))
    ]
    assert len(set(values)) == 6
    assert torch_generator(0, "a").initial_seed() != torch_generator(0, "b").initial_seed()
    assert episode_seeds(0, "e", 2, 3) == episode_seeds(0, "e", 0, 9)[2:5]
    assert all(type(seed) is int for seed in episode_seeds(0, "e", 0, 3))


@pytest.mark.fault(82)
@pytest.mark.parametrize("seed", [-1, 2**32, 1.0, True, None, "0"])
def test_a_wrong_seed_is_refused(seed):
    with pytest.raises(SettingError, match="seed="):
        generator(seed, "a")


@pytest.mark.fault(82)
def test_a_numpy_integer_is_a_seed(linear):
    first = fdtasil.distill(linear, TOY, 1, **QUICK, seed=np.int64(3))
    assert type(first.settings["seed"]) is int
    second = fdtasil.distill(linear, TOY, 1, **QUICK, seed=3)
    assert first.student.to_bytes() == second.student.to_bytes()


def test_files_that_are_no_more_written_go(tmp_path):
    write_folder(tmp_path, {"kept": b"1", "figures/old.png": b"2"})
    (tmp_path / "notes.txt").write_text("the user's own")
    write_folder(tmp_path, {"kept": b"3"})
    assert verify(tmp_path) == {"kept": b"3"}
    assert not (tmp_path / "figures/old.png").exists()
    assert (tmp_path / "notes.txt").exists()


def test_a_manifest_of_somebody_else_removes_nothing(tmp_path):
    (tmp_path / "manifest.json").write_text('{"train.csv": "abc", "icons": []}')
    (tmp_path / "train.csv").write_text("1, 2")
    (tmp_path / "icons").mkdir()
    write_folder(tmp_path, {"kept": b"1"})
    assert (tmp_path / "train.csv").exists()
    assert verify(tmp_path) == {"kept": b"1"}


def test_a_file_that_was_changed_is_not_removed(tmp_path):
    write_folder(tmp_path, {"a": b"1", "b": b"2"})
    (tmp_path / "b").write_text("the user's own by now")
    write_folder(tmp_path, {"a": b"3"})
    assert (tmp_path / "b").exists()


@pytest.mark.fault(306)
def test_a_small_file_is_read_in_little_memory(tmp_path):
    """Not in as much as the largest may have, which many computers refuse."""
    (tmp_path / "small").write_bytes(b"x" * 100)
    tracemalloc.start()
    try:
        assert len(read_plain(tmp_path / "small")) == 100
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**20
