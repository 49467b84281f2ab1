"""A student's C with weights in eight bits: integer products, a quarter of the flash."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fdtasil.student.c_source import Layers
from fdtasil.student.plain import PlainPolicy

__all__ = ["INT8", "rounded"]

_MOST = 127  # of a weight
_LARGEST = 2**31 - 1  # that a sum may be


def rounded(policy: PlainPolicy) -> PlainPolicy:
    """Return a policy with the weights that its C file has in eight bits."""
    layers = []
    for weights, biases in policy.layers:
        whole, scales = _split(weights)
        layers.append((whole * scales[:, None], biases))
    return replace(policy, layers=layers)


def _split(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return int8 weights, and the (outputs,) scale of each row."""
    scales = np.abs(weights).max(axis=1) / np.float32(_MOST)
    scales = np.where(scales > 0, scales, np.float32(1))
    return np.rint(weights / scales[:, None]).astype(np.int8), scales


def _arrays(number: int, weights: np.ndarray) -> Mapping[str, np.ndarray]:
    whole, scales = _split(weights)
    return {f"w{number}": whole, f"s{number}": scales}


def _function(widest: int) -> str:
    return _LINEAR % {"widest": widest, "range": min(2**15 - 1, _LARGEST // (_MOST * widest))}


# An input in sixteen bits has the unit of its layer's largest; one that is no number stays none.
_LINEAR = """#include <stdint.h>

static short whole[%(widest)d];

static void linear(const signed char *weights, const float *scales, const float *biases,
                   const float *input, float *output, int inputs, int outputs)
{
    int i, j;
    float most = 0.0f, unit;
    for (j = 0; j < inputs; j++) {
        const float size = fabsf(input[j]);
        most = size <= most || most != most ? most : size;
    }
    unit = most > 1e-30f ? %(range)d.0f / most : 0.0f;
    for (j = 0; j < inputs; j++)
        whole[j] = (short)lrintf(unit * input[j]);
    unit = most / %(range)d.0f;
    for (i = 0; i < outputs; i++) {
        const signed char *row = weights + i * inputs;
        int32_t sum = 0;
        for (j = 0; j + 3 < inputs; j += 4)
            sum += (int32_t)row[j] * whole[j] + (int32_t)row[j + 1] * whole[j + 1]
                + (int32_t)row[j + 2] * whole[j + 2] + (int32_t)row[j + 3] * whole[j + 3];
        for (; j < inputs; j++)
            sum += (int32_t)row[j] * whole[j];
        output[i] = biases[i] + scales[i] * unit * (float)sum;
    }
}
"""
INT8 = Layers(_arrays, _function, lambda widest: 2 * widest, 1e-2)
"""Eight bits a weight, each output with a scale; sums in 32 bits."""
