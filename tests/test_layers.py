"""Imports run one way, and the face loads nothing heavy."""

import ast
import subprocess
import sys
from pathlib import Path

import fdtasil

# From the top of the house to its cellar; a room may import only what stands below it.
ORDER = [
    "cli",
    "inspection",
    "beside",
    "shell",
    "testing",
    "pipeline",
    "subject",
    "examination",
    "distilled",
    "report",
    "rounds",
    "training",
    "runstate",
    "runfolder",
    "lock",
    "interrupts",
    "configuration",
    "account",
    "figures",
    "calibration",
    "presets",
    "trainers",
    "events",
    "evaluation",
    "fit",
    "fitstate",
    "steps",
    "batches",
    "loss",
    "views",
    "minari_data",
    "datasets",
    "demonstrations",
    "answers",
    "derivatives",
    "scales",
    "student",
    "probes",
    "experts",
    "sb3",
    "rollouts",
    "recording",
    "behaviours",
    "environments",
    "onnx_files",
    "limits",
    "side_files",
    "progress",
    "storage",
    "compute",
    "seeding",
    "errors",
]
HOUSE = Path(fdtasil.__file__).parent


def _room(path: Path) -> str:
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def _imported_rooms(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            module = node.module or ""
            names = [f"fdtasil.{a.name}" for a in node.names] if module == "fdtasil" else [module]
        found |= {name.split(".")[1] for name in names if name.startswith("fdtasil.")}
    return found


def test_every_room_has_a_place():
    rooms = {_room(path) for path in HOUSE.rglob("*.py")} - {"__init__", "__main__"}
    assert rooms == set(ORDER)


def test_imports_run_downwards():
    for path in HOUSE.rglob("*.py"):
        room = _room(path)
        if room.startswith("__"):
            continue
        upwards = {r for r in _imported_rooms(path) if ORDER.index(r) < ORDER.index(room)}
        assert not upwards, f"{path.name} imports {upwards} from above"


def test_only_sb3_imports_stable_baselines3():
    for path in HOUSE.rglob("*.py"):
        if _room(path) != "sb3":
            assert "import stable_baselines3" not in path.read_text()
            assert "from stable_baselines3" not in path.read_text()


def test_the_face_is_light():
    heavy = ["stable_baselines3", "matplotlib", "onnx", "onnxruntime", "scipy.stats"]
    heavy += ["huggingface_hub"]
    code = f"import sys, fdtasil; print([m for m in {heavy} if m in sys.modules])"
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert shown.stdout.strip() == "[]"


def test_the_face_has_what_it_names():
    assert all(hasattr(fdtasil, name) for name in fdtasil.__all__)
