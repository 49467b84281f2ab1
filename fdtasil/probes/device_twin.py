"""An expert's torch twin answers on the GPU, where its own answers would have to travel to."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fdtasil.errors import ExpertError, warn
from fdtasil.experts.expert import Expert
from fdtasil.experts.silence import MOST
from fdtasil.experts.twin import AGREEMENT
from fdtasil.probes.answers import Answers
from fdtasil.probes.surroundings import Drawn, Surroundings
from fdtasil.rollouts.behaviours import largest_action

__all__ = ["DeviceTwin"]

_NUMBERS = 2**26  # in the points that are asked at once: a quarter of a GiB


@dataclass(frozen=True)
class DeviceTwin:
    """Evaluates, and never differentiates, what an expert computes.

    Attributes:
        expert: Whose twin it is; the rows are counted as its own.
        module: The twin, on the device.
        observations: (N, n) states, on the device.
        offsets: (p,) of the stencil.
    """

    expert: Expert
    module: nn.Module
    observations: Tensor
    offsets: Sequence[float]

    @classmethod
    def of(
        cls, expert: Expert, around: Surroundings, said: Answers, device: torch.device
    ) -> "DeviceTwin | None":
        """Return the twin of an expert on a device, or None where it has none that agrees.

        Args:
            expert: The reference.
            around: Where it is asked.
            said: What it said itself at moved states of the same kind.
            device: Of the training.
        """
        stencil = around.probes.stencil
        if expert.module is None or stencil is None or stencil.exact:
            return None
        try:
            module = copy.deepcopy(expert.module).to(device).eval()
        except Exception:  # locks and the like; each type has its own
            return None
        observations = torch.from_numpy(np.ascontiguousarray(around.observations)).to(device)
        twin = cls(expert, module, observations, stencil.offsets)
        error = twin._error(said)
        if error > AGREEMENT:
            warn(
                f"on {device}, {expert.name} answers moved states otherwise than where it is "
                f"asked (by {error:.2g} of the largest action): it is asked there, which takes "
                "longer"
            )
            return None
        return twin

    def values(self, drawn: Drawn) -> np.ndarray:
        """Return the answers (N, k, p, m) at drawn displacements, counted as the expert's.

        Raises:
            ExpertError: If one of them is infinite.
        """
        values = self._values(drawn.displacements, drawn.numbers)
        rows = values[..., 0].size
        self.expert.count(rows, "probe")
        self.expert.silence.rows["probe"] += int(np.isnan(values).any(axis=3).sum())
        if np.isinf(values).any():
            raise ExpertError(
                f"{self.expert.name} is infinite on some of {rows} observations (states moved "
                "by probes)",
                "finite numbers",
                "check its weights, or pass a smaller radius",
            )
        return values

    @torch.no_grad()
    def _values(self, displacements: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        device = self.observations.device
        like = next(self.module.parameters(), self.observations)
        bank = torch.from_numpy(displacements).to(device)
        along = torch.from_numpy(np.ascontiguousarray(numbers)).to(device)
        states = max(1, _NUMBERS // (along.shape[1] * len(self.offsets) * bank.shape[1]))
        parts = []
        for seen, numbers_ in zip(
            self.observations.split(states), along.split(states), strict=True
        ):
            steps = bank[numbers_]
            # As `probes/answers.py` moves states, to the bit.
            moved = torch.stack([offset * steps for offset in self.offsets], dim=2)
            points = seen[:, None, None, :] + moved
            answers = self.module(points.flatten(0, 2).to(like.dtype)).float()
            parts.append(answers.reshape(*points.shape[:3], -1))
        return torch.cat(parts).cpu().numpy()

    def _error(self, said: Answers) -> float:
        """Return the largest difference to the expert's own answers, in units of the largest."""
        try:
            found = self._values(said.displacements, said.numbers)
        except Exception:  # a module that names its device, or an operator that is not there
            return float("inf")
        if found.shape != said.values.shape or np.isnan(found).mean() > MOST:
            return float("inf")
        # Where the expert had no answer, `said` has another one.
        apart = float(np.nan_to_num(np.abs(found - said.values), nan=0.0).max())
        return apart / largest_action(said.values.reshape(-1, found.shape[-1]))
