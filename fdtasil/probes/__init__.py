"""Where to probe the expert, how to difference it, and when to ask again.

Every design lowers to the same small thing: a bank of displacements and, for each state, the
numbers of the rows of the bank that it is probed along. Nothing else knows which design it was.
"""

from fdtasil.probes.adaptive import AdaptiveDirections, is_redundant
from fdtasil.probes.directions import (
    Directions,
    OrthogonalFrames,
    RandomSphere,
    StandardBasis,
)
from fdtasil.probes.source import DIRECTIONS, USUAL_COUNT, Probes
from fdtasil.probes.stencils import CENTRAL, EXACT, FORWARD, LABELS, STENCILS, Stencil

__all__ = [
    "CENTRAL",
    "DIRECTIONS",
    "EXACT",
    "FORWARD",
    "LABELS",
    "STENCILS",
    "USUAL_COUNT",
    "AdaptiveDirections",
    "Directions",
    "OrthogonalFrames",
    "Probes",
    "RandomSphere",
    "StandardBasis",
    "Stencil",
    "is_redundant",
]
