"""The trained experts that benchmarks distil: this project's, and the paper's where they are."""

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

__all__ = ["CONTROLLERS", "Controller", "available", "planner"]

HERE = Path(__file__).parent.parent
OWN, PAPER = HERE / "experts", HERE.parent / "shared" / "experts"


@dataclass(frozen=True)
class Controller:
    """A trained expert and its environment.

    Attributes:
        path: Its ONNX file.
        environment: Gymnasium id.
    """

    path: Path
    environment: str

    def open(self) -> tuple[Path, str]:
        """Return path and environment id, with the id's module importable."""
        if ":" in self.environment and str(self.path.parent) not in sys.path:
            sys.path.append(str(self.path.parent))
        return self.path, self.environment


CONTROLLERS = {
    "paper/HalfCheetah": Controller(PAPER / "HalfCheetah-v3.onnx", "HalfCheetah-v5"),
    "paper/Walker2d": Controller(PAPER / "Walker2d-v3.onnx", "Walker2d-v5"),
    "paper/Ant": Controller(PAPER / "Ant-v3.onnx", "paper_envs:paper/Ant-v0"),
    "paper/Humanoid": Controller(PAPER / "Humanoid-v3.onnx", "paper_envs:paper/Humanoid-v0"),
    **{
        name: Controller(OWN / f"{name}.onnx", name)
        for name in ("HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5", "Swimmer-v5")
    },
    "Reacher-v5": Controller(OWN / "Reacher-v5.onnx", "Reacher-v5"),
}
"""By the name that results and figures use; `paper/` marks the experts of the TaSIL paper."""
_COMMANDED = ("Reacher-v5",)


def available(*names: str) -> list[str]:
    """Return those of the names whose files are here; without names all that move on their own."""
    chosen = names or [name for name in CONTROLLERS if name not in _COMMANDED]
    return [name for name in chosen if CONTROLLERS[name].path.exists()]


def planner() -> ModuleType:
    """Return `examples/constrained_cart_pole.py`: a plant, and a planner with hard limits."""
    examples = str(HERE / "examples")
    if examples not in sys.path:
        sys.path.append(examples)
    return import_module("constrained_cart_pole")
