"""Distil a black-box controller into a small torch policy that reacts as it does.

    import fdtasil

    result = fdtasil.distill("experts/HalfCheetah-v5.onnx", "HalfCheetah-v5", probes=10)
    print(result.evaluation)
    result.to_onnx("student.onnx")

The rooms, on the way of the data; a room imports only those above it and the ground:

    rollouts        who acts in an environment, and what is recorded
    files           the only room that reads and writes files; on one floor with rollouts
    experts         who is asked
    probes          where else the expert is asked
    demonstrations  what is learnt from
    student         who learns, and how
    results         what came of it
    run             the loop
    shell           the commands

On the ground: checks, seeding, compute, progress, errors, version. `fdtasil.testing` has
checks for experts and students of one's own.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from fdtasil.version import __version__

if TYPE_CHECKING:
    from fdtasil.demonstrations.dataset import Dataset
    from fdtasil.demonstrations.minari_data import from_minari, to_minari
    from fdtasil.demonstrations.plain_arrays import from_arrays
    from fdtasil.demonstrations.trainers import DAgger, Dart, NoisyExpert
    from fdtasil.errors import FdtasilError, FdtasilWarning
    from fdtasil.experts.expert import Expert
    from fdtasil.experts.load import load_expert
    from fdtasil.probes.gains import gains
    from fdtasil.probes.source import Probes
    from fdtasil.results.distilled import Distilled
    from fdtasil.results.evaluation import Evaluation
    from fdtasil.results.inspection import Inspection
    from fdtasil.rollouts.wanted import Environment
    from fdtasil.run.diagnosing import diagnose
    from fdtasil.run.evaluating import evaluate
    from fdtasil.run.events import Event, Log
    from fdtasil.run.film import render
    from fdtasil.run.inspecting import inspect
    from fdtasil.run.pipeline import distill
    from fdtasil.run.shrinking import shrink
    from fdtasil.student.architectures import Mlp
    from fdtasil.student.fit import Fit
    from fdtasil.student.history import History
    from fdtasil.student.policy import Student

__all__ = [
    "DAgger",
    "Dart",
    "Dataset",
    "Distilled",
    "Environment",
    "Evaluation",
    "Event",
    "Expert",
    "FdtasilError",
    "FdtasilWarning",
    "Fit",
    "History",
    "Inspection",
    "Log",
    "Mlp",
    "NoisyExpert",
    "Probes",
    "Student",
    "__version__",
    "diagnose",
    "distill",
    "evaluate",
    "from_arrays",
    "from_minari",
    "gains",
    "inspect",
    "load_expert",
    "render",
    "shrink",
    "to_minari",
]

# Loaded when they are first named: torch alone takes seconds, and `fdtasil --help` needs none.
_ROOMS = {
    "demonstrations.dataset": ("Dataset",),
    "demonstrations.minari_data": ("from_minari", "to_minari"),
    "demonstrations.plain_arrays": ("from_arrays",),
    "demonstrations.trainers": ("DAgger", "Dart", "NoisyExpert"),
    "errors": ("FdtasilError", "FdtasilWarning"),
    "experts.expert": ("Expert",),
    "experts.load": ("load_expert",),
    "probes.gains": ("gains",),
    "probes.source": ("Probes",),
    "results.distilled": ("Distilled",),
    "results.evaluation": ("Evaluation",),
    "results.inspection": ("Inspection",),
    "rollouts.wanted": ("Environment",),
    "run.diagnosing": ("diagnose",),
    "run.events": ("Event", "Log"),
    "run.film": ("render",),
    "run.evaluating": ("evaluate",),
    "run.inspecting": ("inspect",),
    "run.pipeline": ("distill",),
    "run.shrinking": ("shrink",),
    "student.architectures": ("Mlp",),
    "student.fit": ("Fit",),
    "student.history": ("History",),
    "student.policy": ("Student",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> object:
    if name in _HOME:
        found = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = found
        return found
    if not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
        return import_module(f"{__name__}.{name}")  # a room, or a file of the ground
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
