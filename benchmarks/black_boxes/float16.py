"""A shipped expert in half precision."""

from pathlib import Path

from .box import SHIPPED


def make_float16(folder: Path, environment: str = "HalfCheetah-v5") -> Path:
    """Convert a shipped expert to float16 inside; observations and actions stay float32.

    Args:
        folder: Where the file goes.
        environment: Which shipped expert.

    Returns:
        The path of the file.
    """
    import onnx
    from onnxruntime.transformers.float16 import convert_float_to_float16

    model = onnx.load(SHIPPED / f"{environment}.onnx")
    path = folder / "float16.onnx"
    onnx.save(convert_float_to_float16(model, keep_io_types=True), path)
    return path
