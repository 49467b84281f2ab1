"""A peer's network as plain arrays: what its process writes, and what is judged here."""

from collections.abc import Callable, Mapping

import numpy as np

__all__ = ["Policy", "arrays_of", "checked_policy", "policy_of"]

Policy = Callable[[np.ndarray], np.ndarray]


def arrays_of(name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays called `name/...`, without it."""
    head = f"{name}/"
    return {key[len(head) :]: array for key, array in arrays.items() if key.startswith(head)}


def policy_of(arrays: Mapping[str, np.ndarray], low: np.ndarray, high: np.ndarray) -> Policy:
    """Return a network of tanh layers as a function (B, n) -> (B, m).

    Args:
        arrays: `mean` and `scale` of the input; `weight 0`, `bias 0`, and so on; `low` and
            `range` of the output where it is scaled.
        low: (m,) lower action bounds, which its answers are clipped to as the peer itself does.
        high: (m,) upper action bounds.
    """
    last = sum(name.startswith("weight") for name in arrays) - 1

    def act(observations: np.ndarray) -> np.ndarray:
        values = (observations - arrays["mean"]) / arrays["scale"]
        for number in range(last):
            values = np.tanh(values @ arrays[f"weight {number}"].T + arrays[f"bias {number}"])
        values = values @ arrays[f"weight {last}"].T + arrays[f"bias {last}"]
        values = values * arrays.get("range", 1.0) + arrays.get("low", 0.0)
        return np.clip(values, low, high)

    return act


def checked_policy(
    arrays: Mapping[str, np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    states: np.ndarray,
    answers: np.ndarray,
) -> Policy:
    """Return `policy_of`, if it answers as the peer itself answered at some states.

    Raises:
        RuntimeError: If it does not.
    """
    policy = policy_of(arrays, low, high)
    off = float(np.abs(policy(states) - answers).max())
    if off > 1e-3 * float(np.max(high - low)):
        raise RuntimeError(f"the peer's weights answer by up to {off:.3g} otherwise than itself")
    return policy
