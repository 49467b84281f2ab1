"""What a student's network looks like: between normalised observations and squashed actions."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from fdtasil.checks import check_choice, check_count, spelt
from fdtasil.errors import SettingError, shown

__all__ = [
    "ACTIVATIONS",
    "ARCHITECTURES",
    "Architecture",
    "Mlp",
    "architecture_of",
    "check_architecture",
    "describe",
    "usual_architecture",
]

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,  # the exact one: the tanh approximation is five times slower on a CPU
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


class Architecture(Protocol):
    """A frozen dataclass of plain numbers and texts that builds a network without memory."""

    def build(self, observation_size: int, action_size: int, random: torch.Generator) -> nn.Module:
        """Return a network (B, n) -> (B, m) whose weights are drawn from `random` alone."""
        ...


@dataclass(frozen=True)
class Mlp:
    """Linear layers with an activation between them.

    Attributes:
        hidden: Width of each hidden layer, or of the only one; () for a linear policy.
        activation: One of elu, gelu, relu, silu, tanh.

    Raises:
        SettingError: If a width is not a positive integer, or the activation is unknown.

    Example:
        >>> Mlp(64).hidden, Mlp((64, 32), "relu").build(3, 1, torch.Generator())[1]
        ((64,), ReLU())
    """

    hidden: tuple[int, ...] | int = (512, 512)
    activation: str = "gelu"

    def __post_init__(self) -> None:
        given: object = self.hidden
        given = given.tolist() if isinstance(given, np.ndarray) else given
        if isinstance(given, str | bytes | Mapping):
            raise SettingError(
                spelt("hidden", given), "positive integers", "write for example hidden=(256, 256)"
            )
        widths = given if isinstance(given, Iterable) else (given,)
        try:
            object.__setattr__(self, "hidden", tuple(check_count("hidden", w) for w in widths))
        except TypeError as error:  # says that it can be iterated over, and can't
            example = "write for example hidden=(256, 256)"
            raise SettingError(spelt("hidden", given), "positive integers", example) from error
        check_choice("activation", self.activation, ACTIVATIONS)

    def build(
        self, observation_size: int, action_size: int, random: torch.Generator
    ) -> nn.Sequential:
        """See `Architecture.build`; orthogonal weights, zero biases."""
        assert isinstance(self.hidden, tuple)
        widths, layers = (observation_size, *self.hidden), list[nn.Module]()
        for inputs, outputs in pairwise(widths):
            layers += [_linear(inputs, outputs, random), ACTIVATIONS[self.activation]()]
        return nn.Sequential(*layers, _linear(widths[-1], action_size, random))


ARCHITECTURES: dict[str, Callable[..., Architecture]] = {"mlp": Mlp}
"""Every architecture by the name that files and configurations call it."""
_USUAL = "mlp"  # which the files of students do not name


def usual_architecture(*, anew: bool) -> Architecture:
    """Return the architecture where nobody says another.

    Args:
        anew: Whether the expert is asked anew: with as many answers as steps a network of its own
            size learns as well as a wide one, in half of the time.
    """
    return Mlp((256, 256)) if anew else Mlp()


PRESETS: dict[str, Architecture] = {"micro": Mlp((64, 64), "relu")}
"""Architectures by a name: for boards, whose runtimes have ReLU and 26 kB to spare."""


def check_architecture(student: object) -> Architecture:
    """Return the architecture that a caller means; a class of one is called.

    Raises:
        SettingError: If it is none that files can name.
    """
    if isinstance(student, str) and student in PRESETS:
        return PRESETS[student]
    made = student() if isinstance(student, type) and _is_known(student) else student
    if _is_known(type(made)):
        return made  # pyright: ignore[reportReturnType]
    kinds = [getattr(kind, "__name__", name) for name, kind in ARCHITECTURES.items()]
    known = ", ".join([*kinds, *(f'"{name}"' for name in PRESETS)])
    raise SettingError(
        spelt("student", student), known, "write for example student=fdtasil.Mlp((64, 64))"
    )


def _is_known(kind: type) -> bool:
    return any(kind is known for known in ARCHITECTURES.values())


def describe(architecture: Architecture) -> dict[str, Any]:
    """Return an architecture as plain JSON values, for `architecture_of`."""
    kind = next(name for name, made in ARCHITECTURES.items() if type(architecture) is made)
    named = {} if kind == _USUAL else {"architecture": kind}
    return {**named, **asdict(architecture)}  # pyright: ignore[reportArgumentType]


def architecture_of(fields: dict[str, Any]) -> Architecture:
    """Return the architecture that `describe` described.

    Raises:
        TypeError: If it has other fields.
        SettingError: If there is none of that name here, or they have values that can't be used.
    """
    fields = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
    name = fields.pop("architecture", _USUAL)
    if name not in ARCHITECTURES:
        raise SettingError(
            f"a student of the architecture {shown(name)!r}, which is not known here",
            f"one of {', '.join(ARCHITECTURES)}",
            "import the code that puts it into ARCHITECTURES first; its student.onnx needs none",
        )
    return ARCHITECTURES[name](**fields)


def _linear(inputs: int, outputs: int, random: torch.Generator) -> nn.Linear:
    """Return a layer with orthogonal weights, without touching torch's global generator."""
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
    nn.init.orthogonal_(layer.weight, generator=random)
    nn.init.zeros_(layer.bias)
    return layer
