"""What the environments that an agent was trained in make of its observations."""

from collections.abc import Iterator
from typing import Any

from fdtasil.errors import ExpertError, warn

__all__ = ["normaliser_of"]

# Wrappers of vectorised environments that leave observations and actions as they are, or do to
# images what `predict` does to them itself.
_HARMLESS = {"VecMonitor", "VecCheckNan", "VecVideoRecorder", "VecNormalize", "VecTransposeImage"}


def normaliser_of(source: Any) -> Any:
    """Return the VecNormalize that normalises an agent's observations, or None.

    Raises:
        ExpertError: If it was trained on observations that another wrapper made.
    """
    if not hasattr(source, "get_vec_normalize_env"):
        return None
    if source.env is None:
        _check_forgotten(source)
        return None
    found = None
    for layer in _layers(source.env):
        kind = type(layer).__name__
        if kind not in _HARMLESS:
            raise ExpertError(
                f"the {type(source).__name__} agent was trained on observations that {kind} makes",
                "an agent that takes the environment's own observations",
                _advice(layer, normalised=found is not None),
            )
        if _normalises(layer):
            found = layer
    _check_innermost(source)
    return found


def _normalises(layer: Any) -> bool:
    return type(layer).__name__ == "VecNormalize" and layer.norm_obs


def _advice(wrapper: Any, *, normalised: bool) -> str:
    """Say how to do without a wrapper, and with the VecNormalize around it or inside it."""
    inside = any(map(_normalises, _layers(wrapper.venv)))
    first = "what VecNormalize does (TransformObservation with its normalize_obs), then "
    asked = (
        "a function: lambda rows: agent.predict("
        "agent.get_vec_normalize_env().normalize_obs(rows), deterministic=True)[0]"
    )
    return (
        f"do in the environment {first * inside}what the wrapper does (for VecFrameStack "
        'FrameStackObservation with padding_type="zero", and FlattenObservation), and pass '
        f"{asked if normalised else 'agent.policy'}"
    )


def _check_forgotten(source: Any) -> None:
    """Warn of an agent that was loaded without the VecNormalize that it was trained in.

    Only PPO and its like, which alone have a gae_lambda, say so: see `statistics.py`.
    """
    kind = type(source).__name__
    if hasattr(source, "gae_lambda") and source._last_original_obs is not None:
        warn(
            f"the {kind} agent was trained in VecNormalize, and has been loaded without it: if it "
            "normalised observations, the agent is asked about others than it knows. Load it "
            f"with its environment, as {kind}.load(path, env=VecNormalize.load('stats.pkl', venv))"
        )


def _layers(outermost: Any) -> Iterator[Any]:
    """Yield the wrappers around a vectorised environment."""
    while outermost is not None and "venv" in vars(outermost):
        yield outermost
        outermost = outermost.venv


def _check_innermost(source: Any) -> None:
    """Warn of statistics that are kept inside the agent's own environments."""
    *_, innermost = [source.env, *(layer.venv for layer in _layers(source.env))]
    layer = next(iter(getattr(innermost, "__dict__", {}).get("envs", ())), None)
    while layer is not None:
        if type(layer).__name__ == "NormalizeObservation":
            warn(
                f"the {type(source).__name__} agent was trained in NormalizeObservation, whose "
                "statistics are not the agent's: pass an environment that has them, and keeps "
                "them as they are (update_running_mean = False)"
            )
            return
        layer = getattr(layer, "__dict__", {}).get("env")
