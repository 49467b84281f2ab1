"""The kinds of experts, one function each, and the choice between them."""

import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from fdtasil.errors import ExpertError
from fdtasil.experts.expert import Expert
from fdtasil.experts.onnx_expert import open_onnx
from fdtasil.sb3 import Trust, read_agent

__all__ = ["ExpertLike", "load_expert"]


@runtime_checkable
class Predictor(Protocol):
    """What stable-baselines3's agents, and many others, look like."""

    def predict(self, observation: np.ndarray, *, deterministic: bool) -> Any:
        """Answer (B, n) observations with (B, m) actions, or a tuple that begins with them."""
        ...


ExpertLike = str | Path | Expert | torch.nn.Module | Predictor | Callable[[np.ndarray], np.ndarray]
"""A path, an expert, a torch module, an object with `predict`, or a function on batches."""


def load_expert(
    source: ExpertLike,
    observation_size: int | None = None,
    action_size: int | None = None,
    *,
    output: str | None = None,
    batch: int | None = None,
    trust: Trust = None,
) -> Expert:
    """Open whatever answers observations with actions.

    Args:
        source: An ONNX path, the path of a stable-baselines3 zip, a torch module, an object with
            stable-baselines3's `predict`, a function (B, n) -> (B, m), or an `Expert`, of which a
            copy is returned.
        observation_size: n, where it is known; checked against the expert.
        action_size: m, where it is known; chooses among the outputs of an ONNX file.
        output: Name of the ONNX output that holds the actions.
        batch: Rows asked at once, where the expert can't take any number; 1 asks row by row.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.

    Returns:
        The expert, with an empty ledger.

    Raises:
        ExpertError: If it can't be opened, or its sizes are others.

    Example:
        >>> load_expert(lambda observations: -observations[:, :2], action_size=2).name
        'the function <lambda>'
    """
    if isinstance(source, Expert):
        expert = dataclasses.replace(
            source,
            observation_size=source.observation_size or observation_size,
            action_size=source.action_size or action_size,
            queries=Counter(),
        )
    elif isinstance(source, (str, Path)) and Path(source).suffix == ".zip":
        expert = _from_agent(Path(source), trust)
    elif isinstance(source, (str, Path)):
        expert = open_onnx(Path(source), observation_size, action_size, output)
    elif isinstance(source, torch.nn.Module):
        expert = _from_module(source, action_size)
    elif isinstance(source, Predictor):
        expert = _from_predict(source, action_size)
    elif callable(source):
        expert = Expert(source, f"the function {_name(source)}", observation_size, action_size)
    else:
        raise ExpertError(
            f"expert is a {type(source).__name__}",
            "an ONNX path, a torch module, an object with predict, or a function on batches",
            "wrap it: lambda observations: ...  ((B, n) -> (B, m))",
        )
    return expert if batch is None else _limited(expert, batch)


def _from_agent(path: Path, trust: Trust) -> Expert:
    agent = read_agent(path, trust=trust)
    expert = _from_module(agent.module, len(agent.action_low))
    return dataclasses.replace(
        expert, name=path.name, observation_size=agent.observation_size, sha256=agent.sha256
    )


def _from_module(module: torch.nn.Module, action_size: int | None) -> Expert:
    module.eval()
    place = next((p for p in module.parameters()), torch.zeros(()))

    def answer(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            batch = torch.from_numpy(observations).to(place.device, place.dtype)
            return module(batch).float().cpu().numpy()

    name = f"the torch module {type(module).__name__}"
    return Expert(answer, name, action_size=action_size, module=module)


def _from_predict(source: Predictor, action_size: int | None) -> Expert:
    name = f"{type(source).__name__}.predict"

    def answer(observations: np.ndarray) -> np.ndarray:
        result = source.predict(observations, deterministic=True)
        if not isinstance(result, tuple):
            return result
        actions, state = result
        if state is not None:
            raise ExpertError(
                f"{name} returns a state beside its actions",
                "a policy without memory",
                "distil a policy that depends on the observation only",
            )
        return actions

    return Expert(answer, name, action_size=action_size)


def _limited(expert: Expert, batch: int) -> Expert:
    if isinstance(batch, bool) or batch < 1:
        raise ExpertError(f"batch={batch!r}", "a positive number of rows", "write batch=1")
    return dataclasses.replace(expert, chunk=batch)


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
