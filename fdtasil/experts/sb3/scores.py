"""What an agent of stable-baselines3 chooses by: its values, or the logits of its distribution."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

__all__ = ["scores_of"]


def scores_of(policy: Any) -> Callable[[Any], np.ndarray] | None:
    """Return what gives the scores of a policy that chooses; None where it has none to give.

    Args:
        policy: Of an agent.

    Returns:
        Observations as `predict` takes them, B of them -> (B, m) scores.
    """
    found = _of_tensors(policy)
    if found is None or not hasattr(policy, "obs_to_tensor"):
        return None

    def scores(observations: Any) -> np.ndarray:
        policy.set_training_mode(False)
        tensors, _ = policy.obs_to_tensor(observations)
        with torch.no_grad():
            return found(tensors).cpu().numpy()

    return scores


def _of_tensors(policy: Any) -> Callable[[Any], torch.Tensor] | None:
    if hasattr(policy, "quantile_net"):
        return lambda rows: policy.quantile_net(rows).mean(dim=1)
    if hasattr(policy, "q_net"):
        return policy.q_net
    if not hasattr(policy, "get_distribution") or hasattr(policy, "lstm_actor"):
        return None

    def logits(rows: Any) -> torch.Tensor:
        parts = policy.get_distribution(rows).distribution
        parts = parts if isinstance(parts, list) else [parts]
        return torch.cat([_scores(part.logits, part) for part in parts], dim=1)

    kind = getattr(policy, "action_dist", None)
    return logits if type(kind).__name__ in _KNOWN else None


_KNOWN = ("CategoricalDistribution", "MultiCategoricalDistribution", "BernoulliDistribution")


def _scores(logits: torch.Tensor, part: Any) -> torch.Tensor:
    """Return a score for each possibility; of yes and no, the logit is that of yes."""
    if isinstance(part, torch.distributions.Bernoulli):
        return torch.stack([torch.zeros_like(logits), logits], dim=2).flatten(1)
    return logits
