"""Distil a black-box controller into a small torch policy that reacts as it does.

import fdtasil

result = fdtasil.distill("experts/HalfCheetah-v5.onnx", "HalfCheetah-v5", probes=10)
print(result.evaluation)
result.to_onnx("student.onnx")
"""

from fdtasil.distilled import Distilled
from fdtasil.errors import FdtasilError, FdtasilWarning
from fdtasil.evaluation import Evaluation
from fdtasil.experts import Expert, load_expert
from fdtasil.pipeline import distill, evaluate
from fdtasil.probes import Probes
from fdtasil.student import Student

__version__ = "0.1.0"

__all__ = [
    "Distilled",
    "Evaluation",
    "Expert",
    "FdtasilError",
    "FdtasilWarning",
    "Probes",
    "Student",
    "__version__",
    "distill",
    "evaluate",
    "load_expert",
]
