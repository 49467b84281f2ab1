"""The policy that is kept: normalise, MLP, action bounds; its own files."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from numbers import Integral

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from fdtasil.errors import SettingError, StorageError

__all__ = ["ACTIVATIONS", "Student", "StudentShape", "check_shape"]

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,  # the exact one: the tanh approximation is five times slower on a CPU
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


_HEADER = "fdtasil"


@dataclass(frozen=True)
class StudentShape:
    """What a student's network looks like.

    Attributes:
        observation_size: n.
        action_size: m.
        hidden: Width of each hidden layer; empty for a linear policy.
        activation: One of `ACTIVATIONS`.
    """

    observation_size: int
    action_size: int
    hidden: tuple[int, ...]
    activation: str

    def __post_init__(self) -> None:
        check_shape(self.hidden, self.activation)


def check_shape(hidden: Sequence[int], activation: str) -> None:
    """Check what a caller says of a network.

    Raises:
        SettingError: If a width is not a positive integer, or the activation is unknown.
    """
    if activation not in ACTIVATIONS:
        raise SettingError(
            f"activation={activation!r}",
            f"one of {', '.join(ACTIVATIONS)}",
            'write for example activation="gelu"',
        )
    if not all(isinstance(width, Integral) and width > 0 for width in hidden):
        raise SettingError(f"hidden={hidden!r}", "positive integers", "write (256, 256)")


class Student(nn.Module):
    """A small deterministic policy on raw observations, in environment units.

    The normaliser and the action bounds are buffers: they are in the weights file and in the
    ONNX file, and nobody has to apply them outside.

    Args:
        shape: The network.
        mean: (n,) subtracted from observations.
        scale: (n,) divided by; positive.
        low: (m,) action bounds; the output of a bounded action is a scaled tanh.
        high: (m,) upper bounds; where a bound is infinite the output is linear.
        random: Draws the initial weights.
    """

    mean: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor
    _bounded: Tensor
    _centre: Tensor
    _half: Tensor

    def __init__(
        self,
        shape: StudentShape,
        mean: np.ndarray,
        scale: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        random: torch.Generator,
    ) -> None:
        super().__init__()
        self.shape = shape
        for name, value in {"mean": mean, "scale": scale, "low": low, "high": high}.items():
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float32)))
        self.network = _mlp(shape, random)
        bounded = np.isfinite(low) & np.isfinite(high)
        # Constants of the graph, from the bounds; safetensors has no use for them.
        centre = np.where(bounded, (np.where(bounded, high, 0) + np.where(bounded, low, 0)) / 2, 0)
        half = np.where(bounded, (np.where(bounded, high, 2) - np.where(bounded, low, 0)) / 2, 1)
        self._all_bounded = bool(bounded.all())
        self.register_buffer("_bounded", torch.from_numpy(bounded), persistent=False)
        self.register_buffer("_centre", torch.from_numpy(centre).float(), persistent=False)
        self.register_buffer("_half", torch.from_numpy(half).float(), persistent=False)

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) raw observations -> (B, m) actions in environment units."""
        raw = self.network((observations - self.mean) / self.scale)
        squashed = torch.tanh(raw)
        if not self._all_bounded:
            squashed = torch.where(self._bounded, squashed, raw)
        return self._centre + self._half * squashed

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Answer as a policy: (B, n) float32 -> (B, m) float32."""
        with torch.no_grad():
            batch = torch.from_numpy(np.ascontiguousarray(observations, np.float32))
            return self(batch.to(self.mean.device)).cpu().numpy()

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Answer as stable-baselines3's `predict` does.

        Args:
            observation: (n,) or (B, n) raw observations.
            state: Returned as it is; the student has no memory.
            episode_start: Not used.
            deterministic: Not used; the student always is.

        Returns:
            (m,) or (B, m) float32 actions in environment units, and `state`.

        Raises:
            SettingError: If the observations have another shape.
        """
        rows = np.asarray(observation, np.float32)
        n = self.shape.observation_size
        if rows.ndim not in (1, 2) or rows.shape[-1] != n:
            raise SettingError(
                f"observation of shape {rows.shape}",
                f"({n},) or (B, {n})",
                "pass raw observations",
            )
        actions = self.act(np.atleast_2d(rows))
        return (actions[0] if rows.ndim == 1 else actions), state

    def to_bytes(self, metadata: Mapping[str, str] | None = None) -> bytes:
        """Return the student as a safetensors file; equal students give equal bytes."""
        tensors = {name: tensor.cpu().contiguous() for name, tensor in self.state_dict().items()}
        about = {"student": asdict(self.shape), **(metadata or {})}
        # One entry: safetensors writes several in an order that differs from run to run.
        return safetensors.torch.save(tensors, {_HEADER: json.dumps(about)})

    @classmethod
    def from_bytes(cls, data: bytes) -> "Student":
        """Read what `to_bytes` wrote.

        Raises:
            StorageError: If it is not a student's file.
        """
        try:
            tensors = safetensors.torch.load(data)
            size = int.from_bytes(data[:8], "little")
            header = json.loads(data[8 : 8 + size])["__metadata__"][_HEADER]
            fields = json.loads(header)["student"]
            shape = StudentShape(**{**fields, "hidden": tuple(fields["hidden"])})
            bounds = {name: tensors[name].numpy() for name in ("mean", "scale", "low", "high")}
            student = cls(shape, **bounds, random=torch.Generator())
            student.load_state_dict(tensors)
        except (safetensors.SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as e:
            raise StorageError(
                f"not a student's weights: {type(e).__name__} {e}".splitlines()[0],
                "a student.safetensors written by fdtasil",
                "check the path, or save again",
            ) from e
        return student.eval()


def _mlp(shape: StudentShape, random: torch.Generator) -> nn.Sequential:
    widths = (shape.observation_size, *shape.hidden)
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [_linear(inputs, outputs, random), ACTIVATIONS[shape.activation]()]
    return nn.Sequential(*layers, _linear(widths[-1], shape.action_size, random))


def _linear(inputs: int, outputs: int, random: torch.Generator) -> nn.Linear:
    """Return a layer with orthogonal weights, without touching torch's global generator."""
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
    nn.init.orthogonal_(layer.weight, generator=random)
    nn.init.zeros_(layer.bias)
    return layer
