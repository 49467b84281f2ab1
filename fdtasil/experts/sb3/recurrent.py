"""RecurrentPPO of sb3-contrib: an LSTM before the layers of PPO's policy."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.errors import ExpertError, shown
from fdtasil.experts.sb3.recipes import Recipe
from fdtasil.experts.sb3.trust import ITSELF

__all__ = ["RECURRENT", "RecurrentNetwork", "is_recurrent", "read_lstm"]

_LSTM = "lstm_actor"
RECURRENT = Recipe(
    "RecurrentPPO",
    {},
    frozenset(
        {
            "sb3_contrib.common.recurrent.policies.RecurrentActorCriticPolicy",
            "sb3_contrib.ppo_recurrent.policies.MlpLstmPolicy",
        }
    ),
    ("mlp_extractor.policy_net", "action_net"),
    ("log_std", "mlp_extractor.value_net", "value_net", _LSTM, "lstm_critic", "critic"),
    nn.Tanh,
    False,
    package="sb3_contrib",
)
"""How it keeps its policy; the LSTM is read apart."""


def is_recurrent(record: Mapping[str, Any]) -> bool:
    """Whether a record is that of an agent with an LSTM."""
    entry = record.get("policy_class")
    module = str(entry.get("__module__")) if isinstance(entry, dict) else ""
    return module in {policy.rpartition(".")[0] for policy in RECURRENT.policies}


def read_lstm(weights: Mapping[str, Tensor], size: int, source: str) -> nn.LSTM:
    """Build the actor's LSTM.

    Args:
        weights: The policy's state dict.
        size: n, of the observations.
        source: Name of the zip, for messages.

    Raises:
        ExpertError: If its weights are no plain LSTM's on such observations.
    """
    mine = {n.removeprefix(f"{_LSTM}."): w for n, w in weights.items() if n.startswith(_LSTM)}
    layers = len([name for name in mine if re.fullmatch(r"weight_ih_l\d", name)])
    first = mine.get("weight_hh_l0")
    hidden = first.shape[1] if first is not None and first.ndim == 2 else 0
    expected: dict[str, tuple[int, ...]] = {}
    for layer in range(layers):
        inputs = size if layer == 0 else hidden
        expected |= {
            f"weight_ih_l{layer}": (4 * hidden, inputs),
            f"weight_hh_l{layer}": (4 * hidden, hidden),
            f"bias_ih_l{layer}": (4 * hidden,),
            f"bias_hh_l{layer}": (4 * hidden,),
        }
    found = {name: tuple(weight.shape) for name, weight in mine.items()}
    finite = all(w.is_floating_point() and bool(w.isfinite().all()) for w in mine.values())
    if not layers or not hidden or found != expected or not finite:
        raise ExpertError(
            shown(f"{source} has an LSTM of {', '.join(sorted(found)) or 'no weights'}"),
            f"a plain LSTM on {size} observations, one after the other if there are several",
            ITSELF,
        )
    lstm = nn.LSTM(size, hidden, layers, device="meta")
    for name in expected:
        setattr(lstm, name, nn.Parameter(mine[name].detach().float().clone()))
    return lstm


class RecurrentNetwork(nn.Module):
    """A policy with an LSTM before its layers.

    Args:
        before: Observations -> what the LSTM takes.
        lstm: The LSTM.
        after: What it returns -> actions in environment units, or scores.
    """

    def __init__(self, before: nn.Module, lstm: nn.LSTM, after: nn.Module) -> None:
        super().__init__()
        self.before, self.lstm, self.after = before, lstm, after

    @property
    def memory_size(self) -> int:
        """k: of each layer what it says and what it keeps."""
        return 2 * self.lstm.num_layers * self.lstm.hidden_size

    def forward(self, observations: Tensor, memories: Tensor) -> tuple[Tensor, Tensor]:
        """(B, n) and (B, k) -> (B, m) actions, and the memories after them."""
        shape = (len(memories), 2, self.lstm.num_layers, self.lstm.hidden_size)
        said, kept = memories.reshape(shape).permute(1, 2, 0, 3).contiguous()
        out, (said, kept) = self.lstm(self.before(observations)[None], (said, kept))
        after = torch.stack([said, kept]).permute(2, 0, 1, 3).reshape(len(memories), -1)
        return self.after(out[0]), after

    def step(
        self, observations: np.ndarray, memories: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Do the same with arrays; see `Step`."""
        rows = (
            torch.from_numpy(np.ascontiguousarray(part, np.float32))
            for part in (observations, memories)
        )
        with torch.no_grad():
            actions, after = self(*rows)
        return actions.numpy(), after.numpy()
