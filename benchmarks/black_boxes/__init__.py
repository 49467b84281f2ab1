"""Experts that can be asked but not differentiated, one maker a file, and a table of them."""

from .bang_bang import make_bang_bang
from .box import BlackBox, measure
from .float16 import make_float16
from .forest import make_forest
from .int8 import make_int8
from .mpc import make_mpc
from .served import make_http

__all__ = ["BLACK_BOXES", "BlackBox", "measure"]

_ALL = (
    BlackBox(
        "forest",
        "Boosted trees in ONNX that imitate a shipped expert: constant between jumps.",
        "HalfCheetah-v5",
        make_forest,
        needs=("lightgbm", "onnxmltools"),
    ),
    BlackBox(
        "int8",
        "A shipped expert statically quantised to int8: steps at every scale.",
        "Ant-v5",
        make_int8,
        needs=("onnxruntime",),
    ),
    BlackBox(
        "float16",
        "A shipped expert in half precision: differences at small radii are rounding.",
        "HalfCheetah-v5",
        make_float16,
        needs=("onnxruntime",),
    ),
    BlackBox(
        "bang_bang",
        "A swing-up law of full torque to either side, that catches with a saturated law.",
        "Pendulum-v1",
        make_bang_bang,
        horizon=200,
        # The law is about the swing-up, and that is a third of an episode: the rest is standing.
        demonstrations=10,
    ),
    BlackBox(
        "mpc",
        "Path-integral control that simulates 64 plans for each answer.",
        "Reacher-v5",
        make_mpc,
        horizon=50,
        slow=True,
    ),
    BlackBox(
        "http",
        "A shipped expert behind HTTP on this machine: nothing but its answers is to be had.",
        "Walker2d-v5",
        make_http,
        serves=True,
    ),
)
BLACK_BOXES: dict[str, BlackBox] = {box.name: box for box in _ALL}
