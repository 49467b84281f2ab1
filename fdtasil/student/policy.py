"""The policy that is kept: normalise, network, action bounds; its own file."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.compute import ask_module
from fdtasil.errors import SettingError, StorageError, first_line
from fdtasil.files.onnx.graph import Graph
from fdtasil.files.tensors import tensors_from_bytes, tensors_to_bytes
from fdtasil.student.architectures import Architecture, architecture_of, describe

__all__ = ["Student"]

_ENTRY = "fdtasil"  # of the metadata of a file of weights


class Student(nn.Module):
    """A small deterministic policy on raw observations, in environment units.

    The normaliser and the action bounds are buffers: they are in the weights file and in the
    ONNX file, and nobody has to apply them outside.

    Args:
        architecture: Of the network.
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
        architecture: Architecture,
        mean: np.ndarray,
        scale: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        random: torch.Generator,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        for name, value in {"mean": mean, "scale": scale, "low": low, "high": high}.items():
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float32)))
        self.network = architecture.build(len(mean), len(low), random)
        bounded = np.isfinite(low) & np.isfinite(high)
        # Constants of the graph, from the bounds; safetensors has no use for them.
        centre = np.where(bounded, (np.where(bounded, high, 0) + np.where(bounded, low, 0)) / 2, 0)
        half = np.where(bounded, (np.where(bounded, high, 2) - np.where(bounded, low, 0)) / 2, 1)
        self._all_bounded = bool(bounded.all())
        self.register_buffer("_bounded", torch.from_numpy(bounded), persistent=False)
        self.register_buffer("_centre", torch.from_numpy(centre).float(), persistent=False)
        self.register_buffer("_half", torch.from_numpy(half).float(), persistent=False)

    @property
    def observation_size(self) -> int:
        """n, the length of an observation."""
        return len(self.mean)

    @property
    def action_size(self) -> int:
        """m, the length of an action."""
        return len(self.low)

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) raw observations -> (B, m) actions in environment units."""
        raw = self.network((observations - self.mean) / self.scale)
        squashed = torch.tanh(raw)
        if not self._all_bounded:
            squashed = torch.where(self._bounded, squashed, raw)
        return self._centre + self._half * squashed

    def write(self, graph: Graph, value: str) -> str:
        """Add the nodes of the student to an ONNX graph; see `Writable`."""
        centred = graph.node("Sub", value, graph.constant(self.mean))
        raw = graph.module(self.network, graph.node("Div", centred, graph.constant(self.scale)))
        if not self._bounded.any():
            return raw
        squashed = graph.node("Tanh", raw)
        actions = graph.node("Mul", squashed, graph.constant(self._half))
        if self._centre.any():
            actions = graph.node("Add", actions, graph.constant(self._centre))
        if self._all_bounded:
            return actions
        share = graph.constant(self._bounded.float())  # of the bounded actions; the rest is raw
        rest = graph.node("Mul", raw, graph.constant(1 - self._bounded.float()))
        return graph.node("Add", graph.node("Mul", actions, share), rest)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Answer as a policy: (B, n) float32 -> (B, m) float32."""
        return ask_module(self, observations)

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
        n = self.observation_size
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
        sizes = {"observation_size": self.observation_size, "action_size": self.action_size}
        about = {"student": {**sizes, **describe(self.architecture)}, **(metadata or {})}
        return tensors_to_bytes(self.state_dict(), about, _ENTRY)

    @classmethod
    def from_bytes(cls, data: bytes) -> "Student":
        """Read what `to_bytes` wrote.

        Raises:
            StorageError: If it is not a student's file.
        """
        tensors, about = tensors_from_bytes(data, _ENTRY, "a student's weights")
        try:
            fields = {k: v for k, v in about["student"].items() if not k.endswith("_size")}
            bounds = {name: tensors[name].numpy() for name in ("mean", "scale", "low", "high")}
            student = cls(architecture_of(fields), **bounds, random=torch.Generator())
            student.load_state_dict(tensors)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise StorageError(
                f"not a student's weights: {type(error).__name__} {first_line(error)}",
                "a student.safetensors written by fdtasil",
                "check the path, or save again",
            ) from error
        return student.eval()
