"""Distil a black-box controller into a small torch policy that reacts as it does.

import fdtasil

result = fdtasil.distill("experts/HalfCheetah-v5.onnx", "HalfCheetah-v5", probes=10)
print(result.evaluation)
result.to_onnx("student.onnx")
"""

from fdtasil.datasets import Dataset
from fdtasil.distilled import Distilled
from fdtasil.errors import FdtasilError, FdtasilWarning
from fdtasil.evaluation import Evaluation
from fdtasil.events import Event
from fdtasil.experts import Expert, load_expert
from fdtasil.minari_data import from_minari, to_minari
from fdtasil.pipeline import distill, evaluate
from fdtasil.probes import Probes
from fdtasil.student import Student
from fdtasil.trainers import DAgger, Dart

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
