"""What a student's network looks like: between normalised observations and squashed actions."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Protocol

import torch
from torch import nn

from fdtasil.checks import check_count
from fdtasil.errors import SettingError

__all__ = ["ACTIVATIONS", "ARCHITECTURES", "Architecture", "Mlp", "architecture_of", "describe"]

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
        widths = self.hidden if isinstance(self.hidden, Iterable) else (self.hidden,)
        if isinstance(self.hidden, str):
            raise SettingError(f"hidden={self.hidden!r}", "positive integers", "write (256, 256)")
        object.__setattr__(self, "hidden", tuple(check_count("hidden", w) for w in widths))
        if self.activation not in ACTIVATIONS:
            raise SettingError(
                f"activation={self.activation!r}",
                f"one of {', '.join(ACTIVATIONS)}",
                'write for example activation="gelu"',
            )

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


def describe(architecture: Architecture) -> dict[str, Any]:
    """Return an architecture as plain JSON values, for `architecture_of`."""
    kind = next(name for name, made in ARCHITECTURES.items() if type(architecture) is made)
    named = {} if kind == _USUAL else {"architecture": kind}
    return {**named, **asdict(architecture)}  # pyright: ignore[reportArgumentType]


def architecture_of(fields: dict[str, Any]) -> Architecture:
    """Return the architecture that `describe` described.

    Raises:
        KeyError: If there is none of that name.
        TypeError: If it has other fields.
        SettingError: If they have values that can't be used.
    """
    fields = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
    return ARCHITECTURES[fields.pop("architecture", _USUAL)](**fields)


def _linear(inputs: int, outputs: int, random: torch.Generator) -> nn.Linear:
    """Return a layer with orthogonal weights, without touching torch's global generator."""
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
    nn.init.orthogonal_(layer.weight, generator=random)
    nn.init.zeros_(layer.bias)
    return layer
