"""A student as C99: no malloc, no file, no library but libm; one function on float arrays."""

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

from fdtasil.files.compiled import answers_of, compiler
from fdtasil.student.agreement import check_agreement
from fdtasil.student.plain import PlainPolicy

__all__ = ["FLOAT", "Layers", "c_header", "c_memory", "c_source", "check_parity", "comment_lines"]

_BEND = {
    "elu": "x > 0.0f ? x : expm1f(x)",
    "gelu": "0.5f * x * (1.0f + erff(x * 0.70710678f))",
    "relu": "x < 0.0f ? 0.0f : x",
    "silu": "x * (0.5f + 0.5f * tanhf(0.5f * x))",
    "tanh": "tanhf(x)",
}
_A_LINE = 8  # numbers
_WIDE = 92  # letters of a comment's line
_TYPES = {np.dtype(np.float32): "float", np.dtype(np.int8): "signed char"}


@dataclass(frozen=True)
class Layers:
    """How a file holds the weights of its layers, and multiplies by them.

    Attributes:
        arrays: Number of a layer, (outputs, inputs) weights -> what is written of them, by name:
            the first arguments of the function.
        function: The widest input's width -> the C function `linear`.
        scratch: The same width -> bytes of static memory that this function has.
        agreement: How far compiled answers may be from the policy's, in halves of an action's
            range.
    """

    arrays: Callable[[int, np.ndarray], Mapping[str, np.ndarray]]
    function: Callable[[int], str]
    scratch: Callable[[int], int]
    agreement: float


def c_header(policy: PlainPolicy, order: str = "") -> str:
    """Return the declarations of a student's C file.

    Args:
        policy: The student.
        order: What stands where in an observation, if somebody knows.
    """
    n, m = len(policy.mean), len(policy.centre)
    told = f"\n   Observation: {_plainly(order)}. " if order else " "
    return (
        f"/* Written by fdtasil.{told}*/\n"
        "#ifndef STUDENT_H\n#define STUDENT_H\n\n"
        f"#define STUDENT_OBSERVATIONS {n}\n#define STUDENT_ACTIONS {m}\n\n"
        '#ifdef __cplusplus\nextern "C" {\n#endif\n'
        f"/* {_answer(policy)}\n"
        "   Not reentrant: its buffers are static. */\n"
        "void student(const float observation[STUDENT_OBSERVATIONS],\n"
        "             float action[STUDENT_ACTIONS]);\n"
        "#ifdef __cplusplus\n}\n#endif\n\n"
        "#endif\n"
    )


def _answer(policy: PlainPolicy) -> str:
    """Return what the function answers, for a comment."""
    if not policy.choices:
        return "Raw observation -> action in the environment's units."
    scores = {column for start, stop, _ in policy.choices for column in range(start, stop)}
    numbers = [f"action[{column}]" for column in range(len(policy.half)) if column not in scores]
    told = (
        f"{first} + the place of the largest of action[{start}] to action[{stop - 1}]"
        for start, stop, first in policy.choices
    )
    mixed = f" {_plainly(', '.join(numbers))} in the environment's units, and" if numbers else ""
    return f"Raw observation ->{mixed} scores, in place of actions. What is chosen:\n   " + (
        ";\n   ".join(told) + "."
    )


def c_memory(policy: PlainPolicy, layers: Layers | None = None) -> tuple[int, int]:
    """Return how many bytes a student's C file has of constants, and of static memory."""
    layers = layers or FLOAT
    return _memory(policy, _constants(policy, _held(policy, layers)), layers)


def c_source(policy: PlainPolicy, about: Mapping[str, str], layers: Layers | None = None) -> str:
    """Return the C file of a student, which `-DSTUDENT_MAIN` makes a program of lines.

    Args:
        policy: The student.
        about: Lines of the comment at the top, by name.
        layers: How weights are held; left out, as float32.
    """
    layers = layers or FLOAT
    widths, held = _widths(policy), _held(policy, layers)
    plain = _constants(policy, held)
    digest = hashlib.sha256(b"".join(array.tobytes() for array in plain.values())).hexdigest()
    buffers, (constants, memory) = _buffers(policy), _memory(policy, plain, layers)
    comment = {
        **about,
        "layers": " -> ".join(map(str, widths)) + f", {policy.activation}",
        "constants": f"{constants:,} bytes",
        "memory": f"{memory:,} bytes, static",
        "sha256": f"{digest} of the constants",
    }
    lines = "\n".join(f"   {name}: {_plainly(text)}" for name, text in comment.items())
    calls = (_call(number, len(held) - 1, names) for number, names in enumerate(held))
    return "\n".join(
        [
            f"/* Written by fdtasil. C99, -lm.\n{lines}\n*/",
            c_header(policy).partition("*/\n")[2],
            "#include <math.h>\n",
            *(_array(name, array) for name, array in plain.items()),
            *(f"static float {name}[{max(widths)}];\n" for name in buffers),
            *([_BEND_TEXT.format(_BEND[policy.activation])] if len(held) > 1 else []),
            layers.function(max(widths[:-1])),
            "void student(const float observation[STUDENT_OBSERVATIONS],\n"
            "             float action[STUDENT_ACTIONS])\n{",
            "    int i;\n    float raw[STUDENT_ACTIONS];",
            "    for (i = 0; i < STUDENT_OBSERVATIONS; i++)",
            "        first[i] = (observation[i] - mean[i]) / scale[i];",
            *(
                call.format(inputs=a, outputs=b)
                for call, a, b in zip(calls, widths, widths[1:], strict=False)
            ),
            "    for (i = 0; i < STUDENT_ACTIONS; i++)",
            "        action[i] = centre[i]\n"
            "            + half[i] * (bounded[i] > 0.0f ? tanhf(raw[i]) : raw[i]);",
            *([] if policy.cut is None else [_CUT]),
            "}\n",
            _MAIN,
        ]
    )


def _widths(policy: PlainPolicy) -> list[int]:
    return [len(policy.mean), *(len(biases) for _, biases in policy.layers)]


def _buffers(policy: PlainPolicy) -> list[str]:
    """Return the names of those, each as wide as the widest layer, that values pass through."""
    return ["first", "second"] if len(policy.layers) > 1 else ["first"]


def _held(policy: PlainPolicy, layers: Layers) -> list[Mapping[str, np.ndarray]]:
    return [layers.arrays(number, weights) for number, (weights, _) in enumerate(policy.layers)]


def _constants(policy: PlainPolicy, held: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {"mean": policy.mean, "scale": policy.scale}
    for number, (_, biases) in enumerate(policy.layers):
        arrays |= {**held[number], f"b{number}": biases}
    arrays |= {"bounded": policy.bounded, "centre": policy.centre, "half": policy.half}
    if policy.cut is not None:
        arrays["low"], arrays["high"] = policy.cut
    return {name: _plain(array) for name, array in arrays.items()}


def _memory(
    policy: PlainPolicy, constants: Mapping[str, np.ndarray], layers: Layers
) -> tuple[int, int]:
    widths = _widths(policy)
    buffers = len(_buffers(policy)) * max(widths) * np.dtype(np.float32).itemsize
    held = sum(array.nbytes for array in constants.values())
    return held, buffers + layers.scratch(max(widths[:-1]))


def _plain(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, array.dtype if array.dtype in _TYPES else np.float32).ravel()


def _plainly(text: str) -> str:
    """Return a text that ends no comment, whole, in as many lines as it takes."""
    plain = "".join(c if c.isprintable() else "?" for c in text).replace("*", "?")
    return "\n     ".join(comment_lines(plain))


def comment_lines(text: str) -> list[str]:
    """Return a text as lines of a comment; no name of it is broken, however long it is."""
    return wrap(text, _WIDE, break_long_words=False, break_on_hyphens=False)


def _array(name: str, values: np.ndarray) -> str:
    numbers = [_number(value) for value in values]
    rows = [", ".join(numbers[i : i + _A_LINE]) for i in range(0, len(numbers), _A_LINE)]
    kind = _TYPES[values.dtype]
    return f"static const {kind} {name}[{len(values)}] = {{\n" + ",\n".join(rows) + "};\n"


def _number(value: np.generic) -> str:
    if isinstance(value, np.integer):
        return str(value)
    text = f"{float(value):.9g}"  # reads back as the same float32
    if np.isinf(value):  # the bound that an action does not have
        return text.replace("inf", "INFINITY")
    return text + ("f" if set(text) & set(".e") else ".0f")


def _call(number: int, last: int, names: Iterable[str]) -> str:
    source, target = ("first", "second") if number % 2 == 0 else ("second", "first")
    if number == last:
        target = "raw"
    given = f"{', '.join(names)}, b{number}, {source}, {target}, {{inputs}}, {{outputs}}"
    line = f"    linear({given});"
    return line if number == last else f"{line}\n    bend({target}, {{outputs}});"


_BEND_TEXT = """static void bend(float *values, int count)
{{
    int i;
    for (i = 0; i < count; i++) {{
        const float x = values[i];
        values[i] = {};
    }}
}}
"""
# Four sums side by side: a processor need not wait for one before it adds the next.
_LINEAR = """static void linear(const float *weights, const float *biases, const float *input,
                   float *output, int inputs, int outputs)
{
    int i, j;
    for (i = 0; i < outputs; i++) {
        const float *row = weights + i * inputs;
        float a = biases[i], b = 0.0f, c = 0.0f, d = 0.0f;
        for (j = 0; j + 3 < inputs; j += 4) {
            a += row[j] * input[j];
            b += row[j + 1] * input[j + 1];
            c += row[j + 2] * input[j + 2];
            d += row[j + 3] * input[j + 3];
        }
        for (; j < inputs; j++)
            a += row[j] * input[j];
        output[i] = (a + b) + (c + d);
    }
}
"""
# What is no number stays none.
_CUT = """    for (i = 0; i < STUDENT_ACTIONS; i++)
        action[i] = action[i] < low[i] ? low[i] : action[i] > high[i] ? high[i] : action[i];"""
FLOAT = Layers(
    lambda number, weights: {f"w{number}": weights}, lambda widest: _LINEAR, lambda widest: 0, 1e-5
)
"""Weights as they are."""
_MAIN = """#ifdef STUDENT_MAIN
#include <stdio.h>
/* Skips blanks; returns the character behind them, which is still to be read. */
static int ahead(void)
{
    int c;
    do
        c = getchar();
    while (c == ' ' || c == '\\t' || c == '\\r');
    return ungetc(c, stdin);
}
/* Reads a line of numbers for each observation, and writes a line of actions. */
int main(void)
{
    float observation[STUDENT_OBSERVATIONS], action[STUDENT_ACTIONS], value;
    int i, line;
    for (line = 1; ahead() != EOF; line++) {
        for (i = 0; ahead() != '\\n' && ahead() != EOF; i++) {
            if (scanf("%f", &value) != 1)
                break;
            if (i < STUDENT_OBSERVATIONS)
                observation[i] = value;
        }
        if (i == 0 && ahead() == '\\n') {
            getchar();
            continue;
        }
        if (i != STUDENT_OBSERVATIONS || (ahead() != '\\n' && ahead() != EOF)) {
            fprintf(stderr, "line %d: expected %d numbers with blanks between\\n", line,
                    STUDENT_OBSERVATIONS);
            return 2;
        }
        getchar();
        student(observation, action);
        for (i = 0; i < STUDENT_ACTIONS; i++)
            printf("%.9g%c", (double)action[i], i + 1 < STUDENT_ACTIONS ? ' ' : '\\n');
        fflush(stdout);
    }
    return 0;
}
#endif
"""


def check_parity(
    source: str, policy: PlainPolicy, states: np.ndarray, agreement: float = FLOAT.agreement
) -> None:
    """Compile a student's own C file and compare it with the student, where there is a compiler.

    Args:
        source: The file.
        policy: Whose answers it must give.
        states: (B, n) observations.
        agreement: How far they may be apart, in halves of an action's range.

    Raises:
        ExportError: If it can't be compiled, or its answers differ.
    """
    if compiler() is None:
        return
    answers = answers_of(source, "STUDENT_MAIN", states)
    check_agreement("C", answers, policy, states, agreement)
