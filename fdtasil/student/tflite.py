"""A student as a TensorFlow Lite model: for LiteRT, and for TensorFlow Lite Micro on a board.

ai-edge-litert is imported inside the functions: it is an extra, and `import fdtasil` stays light.
It brings the format's tables, which are filled here, and an interpreter to try the file in.
"""

import json
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from fdtasil.errors import ExportError, first_line
from fdtasil.student.agreement import check_agreement
from fdtasil.student.plain import PlainPolicy

__all__ = ["tflite_model"]

_BENDS = {"elu": "ELU", "gelu": "GELU", "relu": "RELU", "tanh": "TANH"}


def tflite_model(policy: PlainPolicy, states: np.ndarray, about: Mapping[str, str]) -> bytes:
    """Return a student's file, after comparing its answers with the student's.

    Args:
        policy: The student.
        states: (B, n) observations.
        about: What the file says of itself, as its description.

    Raises:
        ExportError: If ai-edge-litert is missing, or the file answers otherwise.
    """
    try:
        litert = import_module("ai_edge_litert.interpreter")
        schema = import_module("ai_edge_litert.schema_py_generated")
    except ImportError as error:
        raise ExportError(
            f"ai_edge_litert can't be imported: {first_line(error)}",
            "ai-edge-litert, for .tflite",
            'pip install "fdtasil[litert]", or export the student as .onnx or .c',
        ) from error
    data = _written(_Graph(schema), policy, about)
    plain = litert.OpResolverType.BUILTIN_WITHOUT_DEFAULT_DELEGATES  # others print what they are
    interpreter = litert.Interpreter(
        model_content=data, num_threads=1, experimental_op_resolver_type=plain
    )
    given = interpreter.get_input_details()[0]["index"]
    interpreter.resize_tensor_input(given, states.shape)
    interpreter.allocate_tensors()
    interpreter.set_tensor(given, np.asarray(states, np.float32))
    interpreter.invoke()
    answers = interpreter.get_tensor(interpreter.get_output_details()[0]["index"])
    check_agreement(".tflite", answers, policy, states)
    return data


def _written(graph: "_Graph", policy: PlainPolicy, about: Mapping[str, str]) -> bytes:
    given = value = graph.tensor("obs", (1, len(policy.mean)))
    value = graph.apply("SUB", [value, graph.constant("mean", policy.mean)])
    value = graph.apply("DIV", [value, graph.constant("scale", policy.scale)])
    for number, (weights, biases) in enumerate(policy.layers):
        held = graph.constant(f"w{number}", weights), graph.constant(f"b{number}", biases)
        value = graph.apply("FULLY_CONNECTED", [value, *held], len(biases))
        if number < len(policy.layers) - 1:
            value = _bent(graph, policy.activation, value)
    if policy.bounded.any():
        squashed = graph.apply("TANH", [value])
        if not policy.bounded.all():
            squashed = _mixed(graph, policy.bounded, squashed, value)
        value = squashed
    value = graph.apply("MUL", [value, graph.constant("half", policy.half)])
    value = graph.apply("ADD", [value, graph.constant("centre", policy.centre)])
    if policy.cut is not None:
        low, high = policy.cut  # in this order what is no number stays none
        value = graph.apply("MAXIMUM", [graph.constant("low", low), value])
        value = graph.apply("MINIMUM", [graph.constant("high", high), value])
    graph.rename(value, "scores" if policy.choices else "actions")
    return graph.model(given, value, json.dumps(dict(about)))


def _bent(graph: "_Graph", activation: str, value: int) -> int:
    if activation == "silu":
        return graph.apply("MUL", [value, graph.apply("LOGISTIC", [value])])
    return graph.apply(_BENDS[activation], [value])


def _mixed(graph: "_Graph", bounded: np.ndarray, squashed: int, raw: int) -> int:
    """Return the bounded of the one and the unbounded of the other."""
    kept = [
        graph.apply("MUL", [value, graph.constant(name, mask)])
        for name, value, mask in (("bounded", squashed, bounded), ("unbounded", raw, ~bounded))
    ]
    return graph.apply("ADD", kept)


class _Graph:
    """A model that grows by an operator at a time; values are known by their number."""

    def __init__(self, schema: Any) -> None:
        self._schema = schema
        self._tensors: list[Any] = []
        self._operators: list[Any] = []
        self._codes: list[str] = []
        self._buffers: list[Any] = [schema.BufferT()]  # the first is that of what is computed

    def tensor(self, name: str, shape: Sequence[int], buffer: int = 0) -> int:
        tensor = self._schema.TensorT()
        tensor.name, tensor.shape, tensor.buffer = name, list(shape), buffer
        tensor.type = self._schema.TensorType.FLOAT32
        self._tensors.append(tensor)
        return len(self._tensors) - 1

    def constant(self, name: str, values: np.ndarray) -> int:
        buffer = self._schema.BufferT()
        buffer.data = np.frombuffer(np.asarray(values, "<f4").tobytes(), np.uint8)
        self._buffers.append(buffer)
        return self.tensor(name, values.shape, len(self._buffers) - 1)

    def apply(self, code: str, inputs: Sequence[int], width: int | None = None) -> int:
        """Return what an operator makes of values, as wide as the first if left out."""
        if code not in self._codes:
            self._codes.append(code)
        before = self._tensors[inputs[0]].shape
        made = self.tensor(f"{code.lower()}{len(self._operators)}", (1, width or before[-1]))
        operator = self._schema.OperatorT()
        operator.opcodeIndex = self._codes.index(code)
        operator.inputs, operator.outputs = list(inputs), [made]
        self._operators.append(operator)
        return made

    def rename(self, number: int, name: str) -> None:
        self._tensors[number].name = name

    def model(self, given: int, made: int, description: str) -> bytes:
        schema = self._schema
        part, model = schema.SubGraphT(), schema.ModelT()
        part.tensors, part.operators = self._tensors, self._operators
        part.inputs, part.outputs, part.name = [given], [made], "policy"
        model.version, model.description = 3, description
        model.subgraphs, model.buffers = [part], self._buffers
        model.operatorCodes = [self._code(name) for name in self._codes]
        builder = import_module("flatbuffers").Builder(1024)
        builder.Finish(model.Pack(builder), file_identifier=b"TFL3")
        return bytes(builder.Output())

    def _code(self, name: str) -> Any:
        code = self._schema.OperatorCodeT()
        code.builtinCode = getattr(self._schema.BuiltinOperator, name)
        code.deprecatedBuiltinCode = min(code.builtinCode, 127)
        code.version = 1
        return code
