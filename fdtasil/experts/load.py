"""The kinds of experts, one function each, and the choice between them."""

import copy
import dataclasses
import inspect
import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from fdtasil.errors import ExpertError, FdtasilWarning, SettingError
from fdtasil.experts.expert import CHUNK, Answer, Expert
from fdtasil.experts.http_expert import is_http_url, open_http
from fdtasil.experts.hub import fetch
from fdtasil.experts.hub.place import is_hub_uri
from fdtasil.experts.onnx_expert import open_onnx
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.trust import Trust
from fdtasil.experts.workers import BATCH, check_workers, with_processes, with_threads

__all__ = ["ExpertLike", "load_expert"]


@runtime_checkable
class Predictor(Protocol):
    """What stable-baselines3's agents, and many others, look like."""

    def predict(self, observation: np.ndarray, /) -> Any:
        """Answer (B, n) observations with (B, m) actions, or a tuple that begins with them."""
        ...


ExpertLike = str | Path | Expert | torch.nn.Module | Predictor | Callable[[np.ndarray], np.ndarray]
"""A path, `hf:` or `http:` address, expert, torch module, object with `predict`, or function."""


def load_expert(
    source: ExpertLike,
    observation_size: int | None = None,
    action_size: int | None = None,
    *,
    output: str | None = None,
    batch: int | None = None,
    trust: Trust = None,
    workers: int = 0,
    threads: bool = False,
    timeout: float | None = None,
) -> Expert:
    """Open whatever answers observations with actions.

    Args:
        source: An ONNX path, the path of a stable-baselines3 zip, either of them on the Hugging
            Face hub (`hf://org/repo/file[@revision]`), a torch module, an object with
            stable-baselines3's `predict`, a function (B, n) -> (B, m), `http://host:port/path`
            (`POST {"observations": [[...]]}`, answered by `{"actions": [[...]]}`), or an `Expert`,
            of which a copy is returned.
        observation_size: n, where it is known; checked against the expert.
        action_size: m, where it is known; chooses among the outputs of an ONNX file.
        output: Name of the ONNX output that holds the actions.
        batch: Rows asked at once; 1 asks row by row. Left out, it is 1024, 64 over HTTP, 8
            with `workers`: equal batches give equal bytes, whatever the number of workers.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.
        workers: Processes that answer side by side, for slow experts. They start at the first
            question, hold a copy of the expert each, and compute on one thread.
        threads: Use threads of this process instead, for experts that wait or let other threads
            run; those behind HTTP always do.
        timeout: Seconds that a batch may take; a process that hangs is ended. None is for ever,
            and 10 s over HTTP.

    Returns:
        The expert, with an empty ledger.

    Raises:
        ExpertError: If it can't be opened or sent to another process, or its sizes are others.
        SettingError: If code of the hub would be trusted, or workers, threads and timeout don't
            go together.

    Example:
        >>> load_expert(lambda observations: -observations[:, :2], action_size=2).name
        'the function <lambda>'
    """
    remote = is_http_url(source)
    check_workers(workers, threads, timeout, remote)
    if isinstance(source, Expert):
        expert = dataclasses.replace(source, queries=Counter())
    elif is_http_url(source):
        expert = open_http(source, action_size, timeout)
    elif is_hub_uri(source):
        expert = _from_hub(str(source), observation_size, action_size, output, trust)
    elif isinstance(source, (str, Path)) and Path(source).suffix == ".zip":
        expert = _from_agent(Path(source), trust)
    elif isinstance(source, (str, Path)):
        expert = open_onnx(Path(source), observation_size, action_size, output)
    elif isinstance(source, torch.nn.Module) and _is_the_policy(source, observation_size):
        expert = _from_module(source)
    elif isinstance(source, Predictor):
        expert = _from_predict(source)
    elif callable(source):
        expert = Expert(source, f"the function {_name(source)}")
    else:
        raise ExpertError(
            f"expert is a {type(source).__name__}",
            "an ONNX path, a torch module, an object with predict, or a function on batches",
            "wrap it: lambda observations: ...  ((B, n) -> (B, m))",
        )
    expert = _sized(expert, observation_size, action_size)
    if batch is None and workers and expert.chunk == CHUNK:
        batch = BATCH
    expert = expert if batch is None else _limited(expert, batch)
    if not workers:
        return expert
    if threads or remote:  # who waits for a server needs no process
        return with_threads(expert, workers)
    return with_processes(expert, _opener(source, expert, output, trust), workers, timeout)


def _opener(
    source: ExpertLike, expert: Expert, output: str | None, trust: Trust
) -> Callable[[], Answer] | None:
    """Return what opens a file again in another process; what is no file is sent as it is."""
    if not isinstance(source, (str, Path)):
        return None
    place = expert.name if is_hub_uri(source) else Path(source).absolute()
    sizes = expert.observation_size, expert.action_size
    return partial(_open_again, place, *sizes, output, trust, expert.sha256)


def _open_again(
    place: str | Path,
    observation_size: int | None,
    action_size: int | None,
    output: str | None,
    trust: Trust,
    sha256: str | None,
) -> Answer:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FdtasilWarning)  # the caller has been told
        expert = load_expert(place, observation_size, action_size, output=output, trust=trust)
    if expert.sha256 != sha256:
        raise ExpertError(
            f"{place} has changed since it was opened",
            f"sha256 {sha256}",
            "leave the file as it is while it is asked, or open it again",
        )
    return expert.answer


def _sized(expert: Expert, observation_size: int | None, action_size: int | None) -> Expert:
    """Return the expert with its sizes, where they are not others than those expected."""
    said = (expert.observation_size, expert.action_size)
    expected = (observation_size, action_size)
    for role, ours, theirs in zip(("observations", "actions"), said, expected, strict=True):
        if None not in (ours, theirs) and ours != theirs:
            raise ExpertError(
                f"{expert.name} has {ours} {role}, the environment has {theirs}",
                "an expert of this environment",
                "check the environment's version and options, and the output that was chosen",
            )
    return dataclasses.replace(
        expert, observation_size=said[0] or expected[0], action_size=said[1] or expected[1]
    )


def _from_hub(
    uri: str,
    observation_size: int | None,
    action_size: int | None,
    output: str | None,
    trust: Trust,
) -> Expert:
    if trust is not None:
        raise SettingError(
            f"trust={trust!r} with {uri}",
            "no trust: what others put on the hub is never run",
            "download the file, look at it, and name its path",
        )
    file = fetch(uri)
    expert = load_expert(file.path, observation_size, action_size, output=output)
    return dataclasses.replace(expert, name=file.uri)


def _from_agent(path: Path, trust: Trust) -> Expert:
    agent = read_agent(path, trust=trust)
    return dataclasses.replace(
        _from_module(agent.module),
        name=path.name,
        observation_size=agent.observation_size,
        action_size=len(agent.action_low),
        sha256=agent.sha256,
    )


def _is_the_policy(module: torch.nn.Module, observation_size: int | None) -> bool:
    """Whether calling a module is asking it: stable-baselines3's policies scale in `predict`."""
    if not isinstance(module, Predictor):
        return True
    if observation_size is None:
        return False
    rows = np.random.default_rng(0).standard_normal((8, observation_size)).astype(np.float32)
    try:
        called, asked = _from_module(module).answer(rows), _from_predict(module).answer(rows)
    except (AttributeError, RuntimeError, TypeError, ValueError):
        return False
    return np.shape(called) == np.shape(asked) and np.allclose(called, asked, atol=1e-5)


def _from_module(given: torch.nn.Module) -> Expert:
    module = copy.deepcopy(given).eval()  # the caller's may go on training
    place = next((p for p in module.parameters()), torch.zeros(()))

    def answer(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            batch = torch.from_numpy(observations).to(place.device, place.dtype)
            return module(batch).float().cpu().numpy()

    return Expert(answer, f"the torch module {type(module).__name__}", module=module)


def _from_predict(source: Predictor) -> Expert:
    name = f"{type(source).__name__}.predict"
    # scikit-learn's predict takes the batch alone; stable-baselines3's is stochastic by default.
    parameters = inspect.signature(source.predict).parameters
    options = {"deterministic": True} if "deterministic" in parameters else {}

    def answer(observations: np.ndarray) -> np.ndarray:
        result = source.predict(observations, **options)
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

    return Expert(answer, name)


def _limited(expert: Expert, batch: int) -> Expert:
    if isinstance(batch, bool) or batch < 1:
        raise ExpertError(f"batch={batch!r}", "a positive number of rows", "write batch=1")
    return dataclasses.replace(expert, chunk=batch)


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
