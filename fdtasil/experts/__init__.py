"""What a black box is: something that answers observations with actions, and is counted."""

from fdtasil.experts.expert import Expert, Purpose
from fdtasil.experts.gate import Finding, check_expert, examine_expert
from fdtasil.experts.kinds import ExpertLike, load_expert
from fdtasil.experts.twin import torch_twin

__all__ = [
    "Expert",
    "ExpertLike",
    "Finding",
    "Purpose",
    "check_expert",
    "examine_expert",
    "load_expert",
    "torch_twin",
]
