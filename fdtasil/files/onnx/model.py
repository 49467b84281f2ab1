"""Reading an ONNX file with its weights: nothing outside its folder, no code of it is run."""

import io
import re
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from fdtasil.errors import ExpertError
from fdtasil.files.onnx.side_files import load_side_files, names_of_side_files
from fdtasil.files.reading import read_limited
from fdtasil.files.run_format import check_finished
from fdtasil.files.storage import sha256

if TYPE_CHECKING:
    import onnx

__all__ = ["read_model", "side_files"]

# Bytes, with the side files; a protobuf message can't have more than twice that.
_SIZE_LIMIT = 2**30

_ENDS = (".zip", ".onnx")  # which stable-baselines3 and users leave out
_IMPOSTORS = {
    b"<": ("an HTML or XML page", "download the file itself, not the page about it"),
    b"version https://git-lfs": ("a git-LFS pointer", "run `git lfs pull`"),
    b"\x80": (
        "a Python pickle",
        "export the controller to ONNX; pickles are never opened (statistics of a VecNormalize go "
        "to fdtasil export-sb3 --vecnormalize)",
    ),
    b"\x89HDF": ("an HDF5 file, as Keras writes", "load it with its own library, and wrap it"),
    b"\x1f\x8b": ("compressed by gzip", "unpack it first: gunzip"),
    b"{": ("a JSON text", "name the model itself"),
}
# What a zip is, by how one of its members is called.
_ZIPS = {
    "constants.pkl": ("a TorchScript file", "pass the module: torch.jit.load({path!r})"),
    "data.pkl": (
        "a file of torch.save, which is a pickle",
        "load it in your own code with torch.load, and pass the module",
    ),
    "policy.pth": (
        "the zip of a stable-baselines3 agent",
        "name it *.zip, or export it with `fdtasil export-sb3`",
    ),
    ".npy": ("an archive of numpy arrays", "pass demonstrations as dataset=, not as the expert"),
    ".weights.h5": ("a Keras file", "load it with its own library, and wrap it in a function"),
}
_ANY_ZIP = ("a zip", "unpack it, and name the ONNX file inside")


def read_model(path: Path) -> "tuple[onnx.ModelProto, str]":
    """Read an ONNX file with its weights, also where they lie in a side file.

    Nothing outside the model's own folder is read, no link to a side file is followed, and no code
    of the file is run.

    Returns:
        The model, and the sha256 of its file (followed by its side files, where it has any).

    Raises:
        ExpertError: If it is missing, not ONNX, over 1 GiB, or a side file of it can't be used.
    """
    import onnx

    path = Path(path)
    data = _read_bytes(path)
    for magic, (found, next_step) in _IMPOSTORS.items():
        if data.startswith(magic):
            raise ExpertError(f"{path} is {found}", "an ONNX model", next_step)
    if data.startswith(b"PK\x03\x04"):
        found, next_step = _kind_of_zip(data)
        raise ExpertError(f"{path} is {found}", "an ONNX model", next_step.format(path=str(path)))
    model = None
    try:
        model = onnx.load_model_from_string(data)
        data += load_side_files(model, path, _SIZE_LIMIT - len(data))
    except ExpertError:
        raise
    except Exception:  # damaged bytes may raise anything
        model = None
    if model is None or not model.graph.node:
        raise ExpertError(
            f"{path} is no whole ONNX model ({len(data):,} bytes)",
            "a file written by an ONNX exporter",
            "copy or export it again",
        )
    return model, sha256(data)


def _kind_of_zip(data: bytes) -> tuple[str, str]:
    """Return what a zip is, and the next step, by its members' names; nothing is unpacked."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()[:1000]
    except Exception:  # damaged bytes may raise anything
        return "a zip that was cut short", "copy or download it again"
    for end, kind in _ZIPS.items():
        if any(name.endswith(end) for name in names):
            return kind
    return _ANY_ZIP


def side_files(data: bytes) -> set[str]:
    """Return the side files that a model's bytes name, unchecked; none where they are no model."""
    import onnx

    try:
        return names_of_side_files(onnx.load_model_from_string(data))
    except Exception:  # `read_model` says what they are instead
        return set()


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        check_finished(path)
        names = sorted(p.name for end in _ENDS for p in path.glob(f"*{end}"))
        raise ExpertError(
            f"{path} is a folder (experts inside: {', '.join(names[:5]) or 'none'})",
            "an ONNX file, or the zip of an agent",
            "name the file itself",
        )
    beside = [p.name for p in (path.with_name(f"{path.name}{end}") for end in _ENDS) if p.exists()]
    hint = _ADDRESS if _NO_FILE.match(str(path)) else _MISSING
    if beside:
        hint = f"name it whole: {beside[0]}"
    return read_limited(path, _SIZE_LIMIT, "an ONNX file", hint)


# host:8000/act, ws:/host or module:function; a drive has one letter.
_NO_FILE = re.compile(r"[\w.-]{2,}:(/|\d+(/|$)|[A-Za-z_]\w*$)")
_MISSING = "check the path; `fdtasil experts` lists the shipped ones, and fetches them"
_ADDRESS = (
    "an address begins with http://, https:// or hf://; a function is passed in Python: "
    "fdtasil.distill(function, ...)"
)
