"""A student in numpy alone, for one observation in microseconds and for machines without torch.

This file imports nothing else, and is a program by itself: `fdtasil export RUN student.py` writes
it out for a robot. There:

    from student import PlainPolicy

    policy = PlainPolicy.load("student.safetensors")
    action = policy(observation)  # (n,) -> (m,), or (B, n) -> (B, m)
    choice = policy.choose(observation)  # where actions are choices, of which those are scores
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

__all__ = ["PLAIN", "PlainPolicy", "choices_of", "cut_of", "middle_of"]


def _gelu(x: np.ndarray) -> np.ndarray:
    """Return x times the normal distribution function of x, to 2e-7 of x.

    With the error function of Abramowitz and Stegun, 7.1.26. In place: of one row, the calls
    take longer than the numbers.
    """
    size = np.abs(x)
    root = size * 0.7071067811865476
    t = 0.3275911 * root
    t += 1
    np.reciprocal(t, out=t)
    tail = 1.061405429 * t
    for coefficient in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail += coefficient
        tail *= t
    root *= root
    np.negative(root, out=root)
    tail *= np.exp(root, out=root)
    tail *= size
    tail *= 0.5
    return np.maximum(x, 0) - tail


def _silu(x: np.ndarray) -> np.ndarray:
    return x * (0.5 + 0.5 * np.tanh(0.5 * x))  # without an overflow


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


PLAIN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": _elu,
    "gelu": _gelu,
    "relu": _relu,
    "silu": _silu,
    "tanh": np.tanh,
}
"""Every activation by its name in `Mlp`."""


@dataclass(frozen=True)
class PlainPolicy:
    """Linear layers with an activation between them, normaliser and bounds included.

    Attributes:
        mean: (n,) subtracted from an observation.
        scale: (n,) that it is divided by.
        layers: Weights (outputs, inputs) and biases of each layer.
        activation: Its name in `PLAIN`.
        bounded: (m,) bool, the actions that are squashed.
        centre: (m,) middle of each action.
        half: (m,) half the range of each.
        choices: Start and end of the scores of each choice, and its first value; () where actions
            are numbers.
        cut: Where actions are cut off; see `cut_of`.
    """

    mean: np.ndarray
    scale: np.ndarray
    layers: Sequence[tuple[np.ndarray, np.ndarray]]
    activation: str
    bounded: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    choices: Sequence[tuple[int, int, int]] = ()
    cut: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def load(cls, path: str | Path = "student.safetensors") -> "PlainPolicy":
        """Read the weights that fdtasil wrote.

        Raises:
            ValueError: If they are none.
        """
        tensors, about = _safetensors(Path(path).read_bytes())
        names = sorted(
            {name.rpartition(".")[0] for name in tensors if name.startswith("network.")},
            key=lambda name: int(name.rpartition(".")[2]),
        )
        layers = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
        low, high = tensors["low"], tensors["high"]
        bounded = np.isfinite(low) & np.isfinite(high)
        centre, half = middle_of(low, high)  # those of infinite bounds are stored
        centre, half = tensors.get("_centre", centre), tensors.get("_half", half)
        bend = about["student"].get("activation", "gelu")
        if bend not in PLAIN:
            raise ValueError(f"the activation {bend!r}, where one of {', '.join(PLAIN)} is known")
        parts = about.get("spaces", {}).get("actions", [])
        plain = tensors["mean"], tensors["scale"], layers, bend, bounded, centre, half
        return cls(*plain, choices_of(parts), cut_of(low, high))

    def choose(self, observation: np.ndarray) -> np.ndarray:
        """(n,) or (B, n) raw observations -> (c,) or (B, c), the best of each choice.

        Raises:
            ValueError: If an observation is NaN, of which nothing is the best.
        """
        scores = self(observation)
        if np.isnan(scores).any():
            raise ValueError("scores that are NaN, where the best of them is asked for")
        best = [first + scores[..., a:b].argmax(axis=-1) for a, b, first in self.choices]
        return np.stack(best, axis=-1)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """(n,) or (B, n) raw observations -> (m,) or (B, m) float32 actions; scores of choices."""
        value = np.asarray(observation)
        if value.shape[-1:] != self.mean.shape:  # one number would be taken for all of them
            raise ValueError(f"observations of shape {value.shape}, not (..., {len(self.mean)})")
        value = (value - self.mean) / self.scale
        *hidden, (weights, biases) = self.layers
        bend = PLAIN[self.activation]
        for inner, offsets in hidden:
            value = value @ inner.T
            value += offsets
            value = bend(value)
        value = value @ weights.T + biases
        squashed = np.where(self.bounded, np.tanh(value), value)
        actions = (self.centre + self.half * squashed).astype(np.float32)
        return actions if self.cut is None else np.clip(actions, *self.cut)


def _safetensors(data: bytes) -> tuple[dict[str, np.ndarray], dict]:
    """Return the tensors of a file by name, and what it says of itself.

    Raises:
        ValueError: If it is no file of a student.
    """
    size = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8 : 8 + size])
        about = json.loads(header.pop("__metadata__")["fdtasil"])
        body, found = memoryview(data)[8 + size :], {}
        for name, entry in header.items():
            start, stop = entry["data_offsets"]
            kind = {"F32": np.float32, "BOOL": np.bool_}[entry["dtype"]]
            found[name] = np.frombuffer(body[start:stop], kind).reshape(entry["shape"])
        return found, about
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"not the weights of a student: {type(error).__name__}") from error


def choices_of(parts: Sequence[dict]) -> list[tuple[int, int, int]]:
    """Return start, end and first value of each choice of an action's parts."""
    found, start = [], 0
    for part in parts:
        for size, first in zip(part["sizes"], part["first"], strict=True):
            found.append((start, start + size, first))
            start += size
        if not part["sizes"]:
            start += int(np.prod(part["shape"]))
    return found


def middle_of(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (m,) float32 middle and half of the range of bounds; no numbers where one is none.

    The half is less where middle and half together would be rounded beyond a bound.
    """
    low, high = (bound.astype(np.float32).astype(np.float64) for bound in (low, high))
    with np.errstate(invalid="ignore"):
        centre = ((high + low) / 2).astype(np.float32)
        inside = np.minimum(high - centre, centre - low)
        half = inside.astype(np.float32)
        half = np.where(half > inside, np.nextafter(half, np.float32(0)), half)
        return centre, np.where(half > 0, half, ((high - low) / 2).astype(np.float32))


def cut_of(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the (m,) bounds that actions are cut off at; None where no bound stands alone.

    The tanh of an action with two bounds keeps to them by itself.
    """
    alone = np.isfinite(low) != np.isfinite(high)
    return (low, high) if alone.any() else None
