"""The shipped experts: what a wheel has of them, and how the others are fetched."""

import hashlib
import os
import shutil
import subprocess
import sys
import threading
import tomllib
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

import fdtasil

HOUSE = Path(fdtasil.__file__).parent
EXPERTS = HOUSE.parent / "experts"
MANIFEST = tomllib.loads((EXPERTS / "MANIFEST.toml").read_text())
SMALL, OTHER = "InvertedDoublePendulum-v5", "CartPole-v1-PPO"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The library as its wheel has it, away from the source tree: `(*arguments) -> process`."""
    place = tmp_path_factory.mktemp("installed")
    shutil.copytree(HOUSE, place / "fdtasil", ignore=shutil.ignore_patterns("__pycache__"))
    wheel = tomllib.loads((HOUSE.parent / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    for name in wheel["targets"]["wheel"]["only-include"]:
        if (HOUSE.parent / name).is_file():
            moved = place / wheel["targets"]["wheel"]["sources"]["experts"]
            moved.mkdir(exist_ok=True)
            shutil.copy(HOUSE.parent / name, moved)

    def run(*arguments, cwd):
        command = [sys.executable, "-m", "fdtasil", "experts", *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(place), "NO_PROXY": "127.0.0.1"}
        return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment)

    return run


@pytest.fixture
def served():
    """Serve with a handler: `(handler) -> address`."""
    servers = []

    def serve(handler):
        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), handler))
        threading.Thread(target=servers[-1].serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_port}"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


class Endless(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        try:
            while True:
                self.wfile.write(bytes(2**20))
        except OSError:
            pass

    def log_message(self, *_):
        pass


def is_whole(path: Path, name: str) -> bool:
    return hashlib.sha256(path.read_bytes()).hexdigest() == MANIFEST[name]["sha256"]


@pytest.mark.parametrize("name", MANIFEST)
def test_the_manifest_is_true(name):
    assert is_whole(EXPERTS / MANIFEST[name]["file"], name)


def test_a_source_tree_has_all_of_them(inside):
    shown = inside("experts")
    assert shown.returncode == 0, shown.stderr
    rows = {line.split()[0]: line.split()[1:] for line in shown.stdout.splitlines()[1:]}
    assert {name: row[:2] for name, row in rows.items()} == {
        name: [entry["environment"], "yes"] for name, entry in MANIFEST.items()
    }
    for name, row in rows.items():
        stated = [MANIFEST[name]["returns"][steps]["mean"] for steps in ("300", "1000")]
        assert list(map(float, row[2:])) == pytest.approx(stated, abs=0.051)


@pytest.mark.slow
def test_a_wheel_has_one_and_says_where_the_others_are(installed, tmp_path):
    rows = installed(cwd=tmp_path).stdout.splitlines()[1:]
    assert [row.split()[0] for row in rows if row.split()[2] == "yes"] == [SMALL]
    assert len(rows) == len(MANIFEST)
    done = installed("fetch", SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_whole(tmp_path / f"{SMALL}.onnx", SMALL)
    refused = installed("fetch", OTHER, cwd=tmp_path)
    assert refused.returncode == 1
    assert "--source" in refused.stderr
    assert installed("fetch", OTHER, "--source", EXPERTS, cwd=tmp_path).returncode == 0
    assert is_whole(tmp_path / f"{OTHER}.onnx", OTHER)


@pytest.mark.slow
@pytest.mark.parametrize("end", ["", "/"])
def test_others_come_from_an_address(installed, served, tmp_path, end):
    address = served(partial(Quiet, directory=EXPERTS)) + end
    done = installed("fetch", OTHER, "--source", address, "--out", "new/er", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_whole(tmp_path / "new" / "er" / f"{OTHER}.onnx", OTHER)


def test_what_is_there_is_not_written_over(inside, tmp_path):
    assert inside("experts", "fetch", OTHER, cwd=tmp_path).returncode == 0
    assert inside("experts", "fetch", OTHER, cwd=tmp_path).returncode == 0
    (tmp_path / f"{OTHER}.onnx").write_bytes(b"mine")
    refused = inside("experts", "fetch", OTHER, cwd=tmp_path)
    assert refused.returncode == 1
    assert "another file" in refused.stderr
    assert (tmp_path / f"{OTHER}.onnx").read_bytes() == b"mine"


@pytest.mark.fault(225)
def test_what_is_not_the_expert_is_not_written(inside, served, tmp_path):
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / f"{OTHER}.onnx").write_bytes(b"another")
    sources = {
        tmp_path / "source": "sha256",
        tmp_path: "can't be read",
        served(partial(Quiet, directory=tmp_path)): "404",
        served(Endless): "more than",
        "http://127.0.0.1:1": "can't be fetched",
        "http://me:word@[": "next step",
    }
    for source, problem in sources.items():
        refused = inside("experts", "fetch", OTHER, "--source", source, "--out", tmp_path / "new")
        assert refused.returncode == 1, source
        assert problem in refused.stderr
        assert "word" not in refused.stderr
        assert not (tmp_path / "new").exists()


def test_who_has_no_expert_is_told_of_those_that_come_along(inside, tmp_path):
    missing = inside("inspect", f"experts/{SMALL}.onnx", SMALL, cwd=tmp_path)
    assert missing.returncode == 1
    assert "`fdtasil experts`" in missing.stderr


@pytest.mark.parametrize(
    ("said", "hint"),
    [(["fetch"], "fetch NAME"), (["fetch", "Walker2d"], "Walker2d-v5"), (["list", OTHER], OTHER)],
)
def test_wrong_use_says_what_is_right(said, hint, inside, tmp_path):
    refused = inside("experts", *said, cwd=tmp_path)
    assert refused.returncode == 2
    assert hint in refused.stderr.partition("next step")[2]
