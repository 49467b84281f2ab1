"""Writing a torch policy as one ONNX file, and comparing the two."""

import copy
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
import torch

from fdtasil.compute import in_turn, usual_modes
from fdtasil.errors import ExportError, first_line
from fdtasil.files.onnx.graph import OPSET, can_write, write_model
from fdtasil.files.onnx.session import open_session, run_session

if TYPE_CHECKING:
    import onnx

__all__ = ["check_finite", "export_module", "silenced"]


def check_finite(module: torch.nn.Module) -> None:
    """Refuse weights that are not finite; an infinite one may hide behind a tanh.

    Raises:
        ExportError: If there is one.
    """
    if not all(torch.isfinite(weights).all() for weights in module.parameters()):
        raise ExportError(
            f"{type(module).__name__} has weights that are not finite",
            "finite numbers",
            "train it again: it did not learn what it answers",
        )


# Of the largest action: what two ways to compute the same may differ by, and by rounding at most.
_AGREEMENT, _MOST_ROUNDING = 1e-5, 1e-3


def export_module(
    module: torch.nn.Module, observations: np.ndarray, metadata: Mapping[str, str]
) -> bytes:
    """Write a torch policy as one self-contained ONNX file, and compare the two.

    Known layers are written node by node; for others torch's exporter traces the module.

    The graph has one input `obs` (batch, n), one output `actions` (batch, m), both float32, and
    a free batch. Equal modules give equal bytes.

    Args:
        module: (B, n) -> (B, m) float32, put into evaluation mode while it is exported.
        observations: (B, n) float32 real states to compare on; B at least 2.
        metadata: Text entries of the file's `metadata_props`.

    Returns:
        The file's bytes.

    Raises:
        ExportError: If the export fails, an answer is not finite, or the file's answers differ
            from torch's by more than 1e-5 (relative to the largest action, if that is over 1) and
            by more than float32 rounds.
    """
    import onnx

    example = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
    training = module.training
    module.eval()
    try:
        with usual_modes(), torch.no_grad():
            expected = module(example).numpy()
        model = (
            write_model(module, example.shape[1], expected.shape[1])
            if can_write(module)
            else _traced(module, example)
        )
    finally:
        module.train(training)
    onnx.helper.set_model_props(model, dict(metadata))
    session = open_session(model, "the export")
    answers = run_session(session, "actions", example.numpy())
    check_finite(module)
    difference = float(np.abs(answers - expected).max())
    largest = max(1.0, float(np.abs(expected).max()))
    near = difference <= _AGREEMENT * largest  # not so for NaN
    if not near and not difference <= _rounding(module, example, expected, largest):
        raise ExportError(
            f"the ONNX file and torch differ by {difference:.1e} on {len(example)} states",
            "at most 1e-5 of the actions, and what float32 rounds, on finite answers",
            "check the module for layers that behave differently in training, or for NaN weights",
        )
    return model.SerializeToString(deterministic=True)


def _rounding(
    module: torch.nn.Module, example: torch.Tensor, expected: np.ndarray, largest: float
) -> float:
    """Return how far apart two float32 answers may be, by how far one is from float64's.

    Steep policies, whose layers have large values, lose more than the last digits: there torch
    itself is as far from the truth as the file is.
    """
    try:
        exact = copy.deepcopy(module).double().eval()
        with usual_modes(), torch.no_grad():
            truth = exact(example.double()).numpy()
    except Exception:  # it can't be copied, or keeps to float32
        return 0.0
    return min(4 * float(np.abs(truth - expected).max()), _MOST_ROUNDING * largest)


def _traced(module: torch.nn.Module, example: torch.Tensor) -> "onnx.ModelProto":
    if find_spec("onnxscript") is None:
        raise ExportError(
            f"{type(module).__name__} has layers that only torch's exporter can write",
            "the package onnxscript, which it needs",
            'pip install "fdtasil[export]"',
        )
    try:
        with in_turn(), usual_modes(), silenced():
            program = torch.onnx.export(
                module,
                (example[:2],),
                dynamo=True,
                external_data=False,
                opset_version=OPSET,
                input_names=["obs"],
                output_names=["actions"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                verbose=False,
            )
        assert program is not None  # for the type checker: dynamo=True always returns one
        model = program.model_proto
    except Exception as error:
        raise ExportError(
            f"torch can't export {type(module).__name__}: {first_line(error)}",
            "a module made of operations that ONNX has",
            "replace the operation named above",
        ) from error
    # The exporter writes stack traces with folder names of this machine into every node.
    for part in (*model.graph.node, model.graph, *model.functions):
        del part.metadata_props[:]
        part.doc_string = ""
    # Shapes of initialisers, which onnxruntime's quantisation trips over, and of the rest.
    del model.graph.value_info[:]
    return model


@contextmanager
def silenced() -> Iterator[None]:
    """Keep the remarks of the onnx tools about their own internals away from the user."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
