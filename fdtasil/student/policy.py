"""The policy that is kept: normalise, network, action bounds; its own file."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.compute import ask_module
from fdtasil.errors import SettingError
from fdtasil.files.border import reads
from fdtasil.files.onnx.graph import add_module
from fdtasil.files.onnx.nodes import Nodes
from fdtasil.files.tensors import tensors_from_bytes, tensors_to_bytes
from fdtasil.probes.scales import Scales
from fdtasil.rollouts.environments import bounds_text
from fdtasil.rollouts.spaces import Mismatch, Spaces
from fdtasil.student.architectures import Architecture, Mlp, architecture_of, describe
from fdtasil.student.asking import as_numbers, check_choosing
from fdtasil.student.plain import PlainPolicy, choices_of, cut_of, middle_of

__all__ = ["Student"]

_AS_SEEN = (
    "pass raw observations, of student_obs= that part alone; of a student with a history, ask "
    "fdtasil.History"
)

_ENTRY = "fdtasil"  # of the metadata of a file of weights


class Student(nn.Module):
    """A small deterministic policy on raw observations, in environment units.

    The normaliser and the action bounds are buffers: they are in the weights file and in the
    ONNX file, and nobody has to apply them outside.

    Args:
        architecture: Of the network.
        mean: (n,) subtracted from observations.
        scale: (n,) divided by; positive.
        low: (m,) action bounds; the output of an action with two is a scaled tanh.
        high: (m,) upper bounds; where one is infinite the output is linear, and cut off at the
            other if that is finite.
        random: Draws the initial weights.
        actions: Scales of the expert's actions, in which linear outputs are; None for ones.
        spaces: Of what it sees and does, where they are no plain boxes: `predict` takes and
            returns the environment's own form. Actions of a choice are its scores.
    """

    takes_flat_rows = True  # when it is called, whatever `predict` takes

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
        actions: Scales | None = None,
        spaces: Spaces | None = None,
    ) -> None:
        super().__init__()
        self.architecture, self.spaces = architecture, spaces
        for name, value in {"mean": mean, "scale": scale, "low": low, "high": high}.items():
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float32)))
        self.network = architecture.build(len(mean), len(low), random)
        bounded = np.isfinite(low) & np.isfinite(high)
        middle, reach = (0.0, 1.0) if actions is None else (actions.mean, actions.scale)
        between = middle_of(low, high)
        centre, half = np.where(bounded, between[0], middle), np.where(bounded, between[1], reach)
        # Where all are bounded they follow from the bounds, and no file needs them.
        stored = not bounded.all()
        self.register_buffer("_bounded", torch.from_numpy(bounded), persistent=False)
        self.register_buffer("_centre", torch.from_numpy(centre).float(), persistent=stored)
        self.register_buffer("_half", torch.from_numpy(half).float(), persistent=stored)
        self._all_bounded = bool(bounded.all())
        self._cuts = cut_of(low, high) is not None
        self._plain: tuple[list[int], PlainPolicy | None] | None = None

    @property
    def observation_size(self) -> int:
        """n, the length of an observation."""
        return len(self.mean)

    @property
    def action_size(self) -> int:
        """m, the length of an action."""
        return len(self.low)

    def extra_repr(self) -> str:
        """Return what the sizes of the network do not tell."""
        ends = bounds_text(self.low.numpy(force=True), self.high.numpy(force=True))
        return f"{self.observation_size} observations -> {self.action_size} actions, {ends}"

    def forward(self, observations: Tensor) -> Tensor:
        """(B, n) raw observations -> (B, m) actions in environment units, inside the bounds."""
        actions = self.uncut(observations)
        return actions.clamp(self.low, self.high) if self._cuts else actions

    def uncut(self, observations: Tensor) -> Tensor:
        """Answer as `forward` does, and beyond a bound that stands alone.

        This is what is trained: where actions are cut off, they have no gradient.
        """
        raw = self.network((observations - self.mean) / self.scale)
        squashed = torch.tanh(raw)
        if not self._all_bounded:
            squashed = torch.where(self._bounded, squashed, raw)
        return self._centre + self._half * squashed

    def write_onnx(self, nodes: Nodes, value: str) -> str:
        """Add the nodes of the student to an ONNX graph; see `Writable`."""
        centred = nodes.node("Sub", value, nodes.constant(self.mean))
        raw = add_module(
            nodes, self.network, nodes.node("Div", centred, nodes.constant(self.scale))
        )
        actions = nodes.node("Tanh", raw) if self._bounded.any() else raw
        if self._bounded.any() and not self._all_bounded:
            shares = self._bounded.float(), 1 - self._bounded.float()
            parts = zip((actions, raw), shares, strict=True)
            actions = nodes.node(
                "Add", *(nodes.node("Mul", p, nodes.constant(s)) for p, s in parts)
            )
        for operator, constant, idle in (("Mul", self._half, 1), ("Add", self._centre, 0)):
            if (constant != idle).any():
                actions = nodes.node(operator, actions, nodes.constant(constant))
        if self._cuts:
            for operator, bound in (("Max", self.low), ("Min", self.high)):
                actions = nodes.node(operator, actions, nodes.constant(bound))
        return actions

    @property
    def action_units(self) -> Tensor:
        """(m,) half the range of a bounded action, the deviation of the expert's elsewhere."""
        return self._half

    @property
    def plain(self) -> PlainPolicy | None:
        """The same in numpy, with the weights as they are now; None where it is no `Mlp`."""
        if not isinstance(self.network, nn.Sequential) or not isinstance(self.architecture, Mlp):
            return None
        linear = [layer for layer in self.network if type(layer) is nn.Linear]
        weights = (one for layer in linear for one in (layer.weight, layer.bias))
        # Walking the modules for `buffers()` takes a quarter of the time of an answer.
        key = [one.data_ptr() for one in (*self._buffers.values(), *weights) if one is not None]
        if self._plain is None or self._plain[0] != key:
            self._plain = key, self._in_numpy(self.architecture.activation, linear)
        return self._plain[1]

    def _in_numpy(self, activation: str, linear: Sequence[nn.Linear]) -> PlainPolicy | None:
        """Return the student in numpy, which shares the memory of the weights."""
        if self.mean.device.type != "cpu" or self.mean.dtype != torch.float32:
            return None
        return PlainPolicy(
            self.mean.numpy(),
            self.scale.numpy(),
            [(one.weight.detach().numpy(), one.bias.detach().numpy()) for one in linear],
            activation,
            self._bounded.numpy(),
            self._centre.numpy(),
            self._half.numpy(),
            choices_of(self.spaces.to_json()["actions"]) if self.spaces else (),
            cut_of(self.low.numpy(), self.high.numpy()),
        )

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
            observation: (n,) or (B, n) raw observations, or what the environment gives.
            state: Returned as it is; the student has no memory.
            episode_start: Not used.
            deterministic: Not used; the student always is.

        Returns:
            (m,) or (B, m) float32 actions in environment units, or what the environment takes
            (of a choice, which), and `state`.

        Raises:
            SettingError: If the observations have another shape.
        """
        if self.spaces is not None:
            return self._in_spaces(observation, self.spaces), state
        n = self.observation_size
        rows = as_numbers(observation, f"({n},) or (B, {n}) numbers", "pass an array")
        if rows.ndim not in (1, 2) or rows.shape[-1] != n:
            raise SettingError(
                f"observation of shape {rows.shape}",
                f"({n},) or (B, {n})",
                _AS_SEEN,
            )
        actions = self.answer(np.atleast_2d(rows))
        return (actions[0] if rows.ndim == 1 else actions), state

    def answer(self, rows: np.ndarray) -> np.ndarray:
        """Answer as `act` does, in numpy where that is quicker: (B, n) -> (B, m)."""
        # Torch takes longer to begin than the numbers of one row take.
        plain = self.plain if len(rows) == 1 else None
        return self.act(rows) if plain is None else plain(rows)

    def _in_spaces(self, observation: Any, spaces: Spaces) -> Any:
        try:
            rows, one = spaces.observations.read(observation)
        except Mismatch as mismatch:
            names = ", ".join(spaces.observations.names)
            raise SettingError(
                f"an observation with {mismatch}",
                f"what the environment gives{f': {names}' if names else ''}, or flat rows",
                _AS_SEEN,
            ) from None
        actions = self.answer(rows)
        check_choosing(actions, spaces.actions)
        return spaces.actions.value(actions[0]) if one else spaces.actions.values(actions)

    def to_bytes(self, metadata: Mapping[str, str] | None = None) -> bytes:
        """Return the student as a safetensors file; equal students give equal bytes."""
        sizes = {"observation_size": self.observation_size, "action_size": self.action_size}
        about = {"student": {**sizes, **describe(self.architecture)}, **(metadata or {})}
        if self.spaces is not None:
            about["spaces"] = self.spaces.to_json()
        return tensors_to_bytes(self.state_dict(), about, _ENTRY)

    @classmethod
    @reads(
        "a student's weights",
        "a student.safetensors written by fdtasil",
        "check the path, or save again",
    )
    def from_bytes(cls, data: bytes) -> "Student":
        """Read what `to_bytes` wrote.

        Raises:
            StorageError: If it is not a student's file.
        """
        tensors, about = tensors_from_bytes(data, _ENTRY, "a student's weights")
        fields = {k: v for k, v in about["student"].items() if not k.endswith("_size")}
        mean, scale, low, high = (
            tensors[name].numpy() for name in ("mean", "scale", "low", "high")
        )
        if any(vector.ndim != 1 for vector in (mean, scale, low, high)):
            raise ValueError("a normaliser or bounds that are no vectors")
        _check_widths(fields, tensors, len(mean), len(low))
        architecture, random = architecture_of(fields), torch.Generator()
        spaces = Spaces.from_json(about["spaces"]) if "spaces" in about else None
        if spaces and (spaces.observations.size, spaces.actions.size) != (len(mean), len(low)):
            raise ValueError("spaces of other sizes than the network")
        student = cls(architecture, mean, scale, low, high, random, spaces=spaces)
        student.load_state_dict(tensors)
        return student.eval()


def _check_widths(
    fields: Mapping[str, Any], tensors: Mapping[str, Tensor], inputs: int, outputs: int
) -> None:
    """Refuse a network far larger than its weights, before memory is taken for it."""
    shapes = [tensor.shape for tensor in tensors.values()]
    most = max((len(tensors), *(size for shape in shapes for size in shape)))
    for name, value in fields.items():
        numbers = value if isinstance(value, list) else [value]
        if len(numbers) > len(tensors):
            raise ValueError(f"{name} has {len(numbers):,} entries")
        if any(isinstance(number, (int, float)) and number > most for number in numbers):
            raise ValueError(f"{name} is larger than any of the weights")
    widths = fields.get("hidden")
    if isinstance(widths, list):
        known = {tuple(shape) for shape in shapes}
        layers = pairwise((inputs, *widths, outputs))
        if any((after, before) not in known for before, after in layers):
            raise ValueError("hidden is not what the weights are")
