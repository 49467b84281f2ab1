"""Imports run one way between the rooms, and the face loads nothing heavy."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import fdtasil

# The house, floor by floor from its roof: a room may import what stands below it, and itself.
FLOORS = [
    {"shell"},
    {"testing"},
    {"run"},
    {"results"},
    {"student"},
    {"demonstrations"},
    {"probes"},
    {"experts"},
    {"rollouts", "files"},
    {"seeding", "compute"},
    {"checks"},
    {"errors", "progress", "version"},
]
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
HOUSE = Path(fdtasil.__file__).parent
FILES = [path for path in HOUSE.rglob("*.py") if path.parent != HOUSE or path.stem[:2] != "__"]


def _room(path: Path) -> str:
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def _imports(path: Path) -> set[str]:
    """Return the modules of the house that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("fdtasil.")}


def test_every_room_has_its_floor():
    assert {_room(path) for path in FILES} == set(FLOOR)


def test_imports_run_downwards():
    for path in FILES:
        room = _room(path)
        for name in _imports(path):
            other = name.split(".")[1]
            if other != room and other in FLOOR:
                assert FLOOR[other] > FLOOR[room], f"{path.relative_to(HOUSE)} imports {name}"


def test_no_two_files_import_each_other_in_a_circle():
    names = {".".join(("fdtasil", *p.relative_to(HOUSE).with_suffix("").parts)): p for p in FILES}
    names = {name.removesuffix(".__init__"): path for name, path in names.items()}
    arrows = {name: (_imports(path) & names.keys()) - {name} for name, path in names.items()}
    while leaves := {name for name, below in arrows.items() if not below & arrows.keys()}:
        arrows = {name: below for name, below in arrows.items() if name not in leaves}
    assert not arrows, f"circles among {sorted(arrows)}"


def test_few_files_import_stable_baselines3():
    """It loads slowly, and only trust and logs need it."""
    found = {
        path.name
        for path in FILES
        if "import stable_baselines3" in path.read_text()
        or "from stable_baselines3" in path.read_text()
    }
    assert found == {"events.py", "into_sb3.py", "trusted.py"}


@pytest.mark.slow
def test_the_face_is_light():
    heavy = ["stable_baselines3", "matplotlib", "onnx", "onnxruntime", "scipy.stats"]
    heavy += ["huggingface_hub"]
    named = "import sys, fdtasil; fdtasil.distill"
    assert _loaded(named, heavy) == []
    assert _loaded("import sys, fdtasil", [*heavy, "numpy", "torch", "gymnasium", "tyro"]) == []
    start = "import sys; sys.argv[1:] = ['--help']; import fdtasil.shell.main as m; m.main()"
    assert _loaded(start, [*heavy, "numpy", "torch", "gymnasium", "tyro"]) == []


def _loaded(code: str, modules: list[str]) -> list[str]:
    """Return which modules are loaded after some code, run in a process of its own."""
    code = f"{code}; print(*(m for m in {modules} if m in sys.modules), sep=',')"
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return [name for name in shown.stdout.splitlines()[-1].split(",") if name]


@pytest.mark.slow
def test_it_runs_from_a_plain_checkout(tmp_path):
    """Without being installed, and without metadata that say which version it is."""
    shutil.copytree(HOUSE, tmp_path / "fdtasil", ignore=shutil.ignore_patterns("__pycache__"))
    code = """
import importlib.metadata as metadata
known = metadata.version
def version(name):
    if name == "fdtasil":
        raise metadata.PackageNotFoundError(name)
    return known(name)
metadata.version = version
import fdtasil
result = fdtasil.distill(
    lambda rows: -rows[:, :1], "Pendulum-v1", 0, episodes=1, horizon=5, evaluation_episodes=0,
    fit=fdtasil.Fit(steps=1), student=fdtasil.Mlp(4), out="run", force=True,
)
print(fdtasil.__file__, result.report["versions"]["fdtasil"])
"""
    shown = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    file, version = shown.stdout.split()
    assert Path(file).parent == tmp_path / "fdtasil"
    assert version == fdtasil.__version__


def test_the_face_has_what_it_names():
    assert all(hasattr(fdtasil, name) for name in fdtasil.__all__)


# What writes, removes or makes files, whatever it is called on.
WRITERS = {"write_text", "rmtree", "unlink", "rmdir", "mkdir", "makedirs", "touch", "open"}
WRITERS |= {"symlink_to", "hardlink_to", "mkfifo", "copyfile", "copytree", "mkstemp"}
ALLOWED = {
    ("experts/http_expert.py", "json.loads"),  # of an answer, whose size is bounded there
    ("experts/worker_process.py", "os.open"),  # nothing, in place of what it is not to read
    ("probes/answers.py", "Path('/sys/fs/cgroup/memory.max').read_text"),  # the kernel's own
    ("run/configuration.py", "json.loads"),  # of what it has just written
    ("results/moving_pictures.py", "file.read_bytes"),  # what ffmpeg has just written for it
    ("student/plain.py", "json.loads"),  # the program of a robot, which has numpy alone
    ("student/plain.py", "Path(path).read_bytes"),
    ("shell/main.py", "os.open"),  # nothing, in place of a pipe that was closed
}


def _calls(path: Path) -> set[str]:
    """Return what a file calls, with the name of what it is called on."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            function = node.func
            if isinstance(function, ast.Name):
                found.add(function.id)
            if isinstance(function, ast.Attribute):
                found.add(f"{ast.unparse(function.value)}.{function.attr}")
    return found


def test_one_room_reads_and_writes_files():
    """Paths are opened in `files` alone, which looks at names, links, kinds and sizes."""
    for path in FILES:
        name = str(path.relative_to(HOUSE))
        for call in _calls(path) if _room(path) != "files" else ():
            assert not _touches_files(call) or (name, call) in ALLOWED, f"{name} calls {call}"


def _touches_files(call: str) -> bool:
    owner, _, method = call.rpartition(".")
    if call in ("json.load", "json.loads", "np.load", "numpy.load"):
        return True  # of a file's bytes: `files.reading` and `files.arrays` bound them
    if method == "write_bytes":  # a function of ours has the same name
        return bool(owner)
    return method in WRITERS | {"read_bytes", "read_text"}
