"""Distil a black-box controller into a small torch policy that reacts as it does.

import fdtasil

result = fdtasil.distill("experts/HalfCheetah-v5.onnx", "HalfCheetah-v5", probes=10)
print(result.evaluation)
result.to_onnx("student.onnx")
"""

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.minari_data import from_minari, to_minari
from fdtasil.demonstrations.trainers import DAgger, Dart
from fdtasil.errors import FdtasilError, FdtasilWarning
from fdtasil.experts.expert import Expert
from fdtasil.experts.load import load_expert
from fdtasil.probes.source import Probes
from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation
from fdtasil.run.events import Event
from fdtasil.run.pipeline import distill, evaluate
from fdtasil.student.network import Student

__version__ = "0.1.0"

__all__ = [
    "DAgger",
    "Dart",
    "Dataset",
    "Distilled",
    "Evaluation",
    "Event",
    "Expert",
    "FdtasilError",
    "FdtasilWarning",
    "Probes",
    "Student",
    "__version__",
    "distill",
    "evaluate",
    "from_minari",
    "load_expert",
    "to_minari",
]
