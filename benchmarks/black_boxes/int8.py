"""A shipped expert, statically quantised to eight bits."""

from pathlib import Path

import numpy as np

from .box import SHIPPED
from .visits import shipped_expert, visited


def make_int8(
    folder: Path, environment: str = "Ant-v5", episodes: int = 10, horizon: int = 300
) -> Path:
    """Quantise a shipped expert with the ranges of its activations on states that it visits.

    Args:
        folder: Where the file goes.
        environment: Which shipped expert.
        episodes: Of the states whose activations set the ranges.
        horizon: Steps of an episode.

    Returns:
        The path of the file.
    """
    from onnxruntime.quantization import quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    expert = shipped_expert(environment)
    states = visited(expert, environment, episodes, horizon)
    prepared, path = folder / "prepared.onnx", folder / "int8.onnx"
    quant_pre_process(SHIPPED / f"{environment}.onnx", prepared, skip_symbolic_shape=True)
    # Signed on both sides: the other choice adds up in sixteen bits on processors without VNNI,
    # overflows there, and the same file would be another controller.
    quantize_static(prepared, path, _Batches(states, _input_name(prepared)))
    prepared.unlink()
    return path


def _input_name(path: Path) -> str:
    import onnx

    return onnx.load(path).graph.input[0].name


class _Batches:
    """What onnxruntime calls a calibration data reader: one batch after the other, then None."""

    def __init__(self, states: np.ndarray, name: str) -> None:
        self._batches = iter(np.array_split(states, max(1, len(states) // 256)))
        self._name = name

    def get_next(self) -> dict[str, np.ndarray] | None:
        batch = next(self._batches, None)
        return None if batch is None else {self._name: batch}
