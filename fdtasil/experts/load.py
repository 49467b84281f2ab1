"""Whatever answers observations with actions: a table of kinds, and the choice between them."""

import dataclasses
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from fdtasil.checks import check_choice, check_count, check_flag, check_path, spelt
from fdtasil.compute import usual_modes
from fdtasil.errors import ExpertError, FdtasilWarning, SettingError, in_one_line
from fdtasil.experts.c_expert import open_c
from fdtasil.experts.expert import CHUNK, Expert, Hints, Origin
from fdtasil.experts.http_expert import is_http_url, open_http
from fdtasil.experts.hub import fetch, is_hub_uri
from fdtasil.experts.memory import Memory, stateless
from fdtasil.experts.modules import ask_as_it_is, open_module
from fdtasil.experts.onnx_expert import open_onnx
from fdtasil.experts.own_jacobian import own_jacobian
from fdtasil.experts.picking import Picks, PicksOutput
from fdtasil.experts.predicting import open_predictor
from fdtasil.experts.sb3.agent import read_agent
from fdtasil.experts.sb3.observations import check_parts
from fdtasil.experts.sb3.randomness import randomness_kept
from fdtasil.experts.sb3.recurrent import RecurrentNetwork
from fdtasil.experts.sb3.trust import Trust
from fdtasil.experts.silence import Silence
from fdtasil.experts.sizes import AS_A_STUDENT, size_hint
from fdtasil.experts.structure import in_spaces
from fdtasil.experts.trial import vouch_for
from fdtasil.experts.workers import BATCH, Workers, check_workers, with_processes, with_threads
from fdtasil.files.onnx.binding import Inputs, check_inputs
from fdtasil.files.onnx.recurrent import check_memory
from fdtasil.rollouts.behaviours import Policy, largest_action
from fdtasil.rollouts.environments import EnvironmentPool

__all__ = ["KINDS", "ExpertLike", "Kind", "expert_in", "load_expert", "open_expert", "sized"]


@runtime_checkable
class Predictor(Protocol):
    """What stable-baselines3's agents, and many others, look like."""

    def predict(self, observation: np.ndarray, /) -> Any:
        """Answer (B, n) observations with (B, m) actions, or a tuple that begins with them.

        Of one action, (B,) will do.
        """
        ...


ExpertLike = str | Path | Expert | torch.nn.Module | Predictor | Callable[[np.ndarray], np.ndarray]
"""A path, `hf:` or `http:` address, expert, torch module, object with `predict`, or function."""


def load_expert(
    source: ExpertLike,
    observation_size: int | None = None,
    action_size: int | None = None,
    *,
    output: str | int | None = None,
    inputs: Inputs | None = None,
    memory: Mapping[str, str] | None = None,
    batch: int | None = None,
    trust: Trust = None,
    workers: Workers = 0,
    threads: bool = False,
    timeout: float | None = None,
) -> Expert:
    """Open whatever answers observations with actions.

    Args:
        source: An ONNX path, the path of a stable-baselines3 zip, either of them on the Hugging
            Face hub (`hf://org/repo/file[@revision]`), a torch module, an object with
            stable-baselines3's `predict`, a function (B, n) -> (B, m), which may return its
            (B, m, n) derivatives beside them, `http://host:port/path`
            (`POST {"observations": [[...]]}`, answered by `{"actions": [[...]]}`), or an `Expert`,
            of which a copy is returned. An object or a function with a method `jacobian` gives its
            derivatives by that.
        observation_size: n, where it is known; checked against the expert.
        action_size: m, where it is known; chooses among the outputs of an ONNX file.
        output: Name of the ONNX output that holds the actions; of a function or a torch module
            that returns a dictionary or a tuple, the key or the number of the part.
        inputs: What the inputs of an ONNX file are given, where it has several: a number or an
            array always, or columns of the observation ("0:17"); one that is left out is given
            the other columns.
        memory: Inputs of an ONNX file that hold a memory, and the outputs that it comes out of,
            {"h_in": "h_out"}; left out, they are found by their names and sizes.
        batch: Rows asked at once; 1 asks row by row. Left out, it is 1024, 64 over HTTP, 8
            with `workers`: equal batches give equal bytes, whatever the number of workers.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it; "c" compiles and runs a C file that fdtasil exported.
        workers: Processes that answer side by side, for slow experts. They start at the first
            query, hold a copy of the expert each, and compute on one thread. "ray" asks those of
            a Ray cluster, one for each core ("ray:8" for eight); a batch that is lost with a
            machine is asked again.
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
    for name, size in (("observation_size", observation_size), ("action_size", action_size)):
        if size is not None:
            check_count(name, size)
    if trust is not None:
        check_choice("trust", trust, ("pickle", "c"))
    if isinstance(output, int) and not isinstance(output, bool):
        output = str(output)
    if output is not None and not isinstance(output, str):
        example = "leave it out, or write the name that a viewer of ONNX files shows"
        raise SettingError(
            spelt("output", output), "the name of an output, or the number of a part", example
        )
    threads = check_flag("threads", threads)
    bound = None if inputs is None else check_inputs(inputs)
    kind = _kind_of(source)
    pairs = None if memory is None else check_memory(memory)
    hints = Hints(observation_size, action_size, output, trust, timeout, bound, pairs)
    workers, timeout = check_workers(workers, threads, timeout, kind.remote)
    expert = sized(open_expert(source, hints), observation_size, action_size)
    if batch is None and workers and expert.chunk == CHUNK:
        batch = BATCH
    if batch is not None:
        expert = dataclasses.replace(expert, chunk=check_count("batch", batch))
    if not workers:
        return expert
    if expert.memory is not None:
        raise SettingError(
            f"workers={workers} with {expert.name}, which has a memory",
            "one process: what is remembered comes from the step before",
            "leave workers= out",
        )
    if isinstance(workers, int) and (threads or kind.remote):  # who waits needs no process
        return with_threads(expert, workers)
    return with_processes(expert, _opener(source, expert, hints), workers, timeout)


def expert_in(
    source: ExpertLike,
    pool: EnvironmentPool,
    *,
    output: str | None = None,
    inputs: Inputs | None = None,
    trust: Trust = None,
) -> Expert:
    """Open an expert for an environment, whose own form of observations it may take.

    Args:
        source: The expert.
        pool: The environment.
        output: As in `load_expert`.
        inputs: As there.
        trust: As there.

    Raises:
        ExpertError: If it can't be opened, or does not fit the environment.
    """
    n, m = pool.boxes.observation_size, pool.boxes.action_size
    if pool.spaces.plain:
        return load_expert(source, n, m, output=output, inputs=inputs, trust=trust)
    bound = None if inputs is None else check_inputs(inputs)
    hints = Hints(n, m, output, trust, inputs=bound, spaces=pool.spaces)
    return sized(in_spaces(open_expert(source, hints), pool.spaces), n, m)


def open_expert(source: ExpertLike, hints: Hints) -> Expert:
    """Open an expert whose sizes may be others than those hinted at; see `load_expert`."""
    if isinstance(source, str | Path):
        check_path("expert", source)
    kind = _kind_of(source)
    told = {name: getattr(hints, name) for name in (*_TAKEN_BY, "trust")}
    told = {name: value for name, value in told.items() if value is not None}
    for name in told.keys() & _TAKEN_BY.keys() - kind.takes:
        raise SettingError(
            f"{name}= of {kind.called or f'a {type(source).__name__}'}",
            _TAKEN_BY[name],
            "leave it out",
        )
    with usual_modes():
        found = kind.opens(source, hints)
    said = [f"{name}={value!r}" for name, value in told.items() if name in kind.takes]
    return _from(found, options=in_one_line(", ".join(said))) if said else found


def _from(expert: Expert, **told: str) -> Expert:
    """Return an expert of which more is told where it came from."""
    return dataclasses.replace(expert, origin=dataclasses.replace(expert.origin, **told))


_TAKEN_BY = {
    "output": "an ONNX file, a torch module or a function that returns several things",
    "inputs": "an ONNX file, whose inputs have names",
    "memory": "an ONNX file, whose inputs have names",
}
"""Who takes an option, by its name; `trust` may be said of anybody."""


def sized(expert: Expert, observation_size: int | None, action_size: int | None) -> Expert:
    """Return the expert with its sizes, where they are not others than those expected."""
    # What is remembered lies behind the environment's observations.
    carried = expert.memory.size if expert.memory else 0
    said = (expert.observation_size and expert.observation_size - carried, expert.action_size)
    expected = (observation_size, action_size)
    for role, ours, theirs in zip(("observations", "actions"), said, expected, strict=True):
        if ours is not None and theirs is not None and ours != theirs:
            raise ExpertError(
                f"{expert.name} has {ours} {role}, the environment has {theirs}",
                "an expert of this environment",
                _step(expert, role, ours, theirs),
            )
    return dataclasses.replace(
        expert,
        observation_size=expert.observation_size or expected[0],
        action_size=said[1] or expected[1],
    )


def _step(expert: Expert, role: str, ours: int, theirs: int) -> str:
    if role == "actions":
        return "check the environment's version and options, and the output that was chosen"
    return size_hint(ours, theirs) if expert.origin.columns is None else AS_A_STUDENT


def _kind_of(source: object) -> "Kind":
    for kind in KINDS:
        if kind.recognises(source):
            return kind
    raise ExpertError(
        f"the expert, of type {type(source).__name__}",
        "an ONNX path, a torch module, an object with predict, or a function on batches",
        _how_to_pass(source),
    )


def _how_to_pass(source: object) -> str:
    """Return what makes an expert of an object that is none; no property of it is asked."""
    if isinstance(getattr(source, "__dict__", {}).get("student"), torch.nn.Module):
        return "of a result, pass its student: result.student"
    if (advice := _BY_TYPE.get(type(source).__name__)) is not None:
        return advice
    for name in _OTHER_NAMES:
        if callable(getattr(type(source), name, None)):
            return f"pass its method, expert.{name}, if that takes (B, n) and returns (B, m)"
    return (
        "wrap it: lambda observations: ...  ((B, n) -> (B, m)); what remembers has "
        "predict(observations, state, episode_start) -> (actions, state)"
    )


_BY_TYPE = {
    "InferenceSession": "pass the path of its file, or lambda rows: session.run(None, {name: "
    "rows})[0], with the name of its input",
    "ModelProto": 'write it first: onnx.save(model, "expert.onnx"), and pass that path',
    "OrderedDict": "of weights alone, load them into their module, and pass that",
    "bytes": "write them to a file, and pass its path",
}

_OTHER_NAMES = ("act", "get_action", "select_action", "compute_action", "compute_actions")
"""What other libraries call `predict`."""


def _opener(source: ExpertLike, expert: Expert, hints: Hints) -> Callable[[], Policy] | None:
    """Return what opens a file again in another process; what is no file is sent as it is."""
    if not isinstance(source, (str, Path)):
        return None
    # The hub's files are called by their commit, which the source may leave open.
    file = expert.name if is_hub_uri(source) else Path(source).absolute()
    known = dataclasses.replace(
        hints, observation_size=expert.observation_size, action_size=expert.action_size
    )
    return partial(_open_again, file, known, expert.origin.sha256)


def _open_again(file: str | Path, hints: Hints, sha256: str | None) -> Policy:
    vouch_for(sha256)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FdtasilWarning)  # the caller has been told
        expert = open_expert(file, hints)
    if expert.origin.sha256 != sha256:
        raise ExpertError(
            f"{file} has changed since it was opened",
            f"sha256 {sha256}",
            "leave the file as it is while it is asked, or open it again",
        )
    return expert.answer


def _from_expert(expert: Expert, hints: Hints) -> Expert:
    return dataclasses.replace(expert, queries=Counter(), silence=Silence(), seconds={})


def _from_http(url: str, hints: Hints) -> Expert:
    return open_http(url, hints.action_size, hints.timeout)


def _from_hub(uri: str | Path, hints: Hints) -> Expert:
    if hints.trust is not None:
        raise SettingError(
            f"trust={hints.trust!r} with {uri}",
            "no trust: what others put on the hub is never run",
            "download the file, look at it, and name its path",
        )
    file = fetch(uri)
    found = dataclasses.replace(open_expert(file.path, hints), name=file.uri)
    return _from(found, source=file.uri)


def _from_agent(path: str | Path, hints: Hints) -> Expert:
    agent = read_agent(path, trust=None if hints.trust == "c" else hints.trust)
    if hints.spaces is not None:
        check_parts(agent.parts, hints.spaces.observations, str(path))
    origin = Origin(str(path), agent.sha256)
    if isinstance(agent.module, RecurrentNetwork):
        n, step = agent.observation_size, agent.module.step
        return Expert(
            stateless(step, n),
            Path(path).name,
            n + agent.memory,
            len(agent.action_low),
            memory=Memory(agent.memory, step),
            origin=origin,
        )
    return dataclasses.replace(
        ask_as_it_is(agent.module),
        name=Path(path).name,
        observation_size=agent.observation_size,
        action_size=len(agent.action_low),
        origin=origin,
    )


def _from_torch(module: torch.nn.Module, hints: Hints) -> Expert:
    """Ask a module by calling it, unless it has a `predict` that answers otherwise."""
    if getattr(module, "takes_flat_rows", False):  # a student of ours
        return open_module(module)
    if hints.output is not None:
        picks = PicksOutput(module, hints.output)
        found = dataclasses.replace(open_module(picks), own_form=True)
        return dataclasses.replace(found, name=f"the torch module {type(module).__name__}")
    if not isinstance(module, Predictor) or _is_the_policy(module, hints.observation_size):
        return dataclasses.replace(open_module(module), own_form=True)
    return _from_predictor(module, hints)


def _is_the_policy(module: torch.nn.Module, observation_size: int | None) -> bool:
    """Whether calling a module is asking it: stable-baselines3's policies scale in `predict`."""
    if observation_size is None:
        return False
    rows = np.random.default_rng(0).standard_normal((8, observation_size)).astype(np.float32)
    try:
        with randomness_kept():  # calling PPO's draws an action
            called = open_module(module).answer(rows.copy())
        asked = np.asarray(open_predictor(module).answer(rows.copy()))
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError):
        return False
    if not isinstance(called, np.ndarray):  # PPO's says actions, values and log-probabilities
        return False
    return called.shape == asked.shape and np.allclose(
        called, asked, atol=1e-5 * largest_action(asked.reshape(len(asked), -1))
    )


def _from_predictor(source: Predictor, hints: Hints) -> Expert:
    layout = hints.spaces.observations if hints.spaces else None
    parts = None if layout is None or layout.plain else layout
    chooses = hints.spaces is not None and bool(hints.spaces.actions.choices)
    found = open_predictor(source, hints.observation_size, parts, chooses=chooses)
    # What remembers takes flat rows, with the memory behind them, and makes parts of them itself.
    return dataclasses.replace(found, own_form=found.memory is None)


def _from_function(function: Callable[[np.ndarray], np.ndarray], hints: Hints) -> Expert:
    name = getattr(function, "__name__", type(function).__name__)
    if hints.output is not None:
        return Expert(Picks(function, hints.output), f"the function {name}", own_form=True)
    given = own_jacobian(function)
    return Expert(function, f"the function {name}", jacobian=given, own_form=True)


def _is_path(source: object) -> bool:
    return isinstance(source, (str, Path))


def _is_c(source: object) -> bool:
    return isinstance(source, (str, Path)) and Path(source).suffix == ".c"


def _is_zip(source: object) -> bool:
    return isinstance(source, (str, Path)) and Path(source).suffix == ".zip"


@dataclass(frozen=True)
class Kind:
    """One kind of expert.

    Attributes:
        recognises: Whether a source is of this kind.
        opens: A source of this kind, and what is known of it -> the expert.
        takes: The options of `load_expert` that say how.
        called: What it is; None for what its class is called.
        remote: Whether somebody else answers, is waited for, and keeps the time.
    """

    recognises: Callable[[object], bool]
    opens: Callable[[Any, Hints], Expert]
    takes: frozenset[str] = frozenset()
    called: str | None = None
    remote: bool = False


_PARTS, _TRUST = frozenset({"output"}), frozenset({"trust"})
_INPUTS = _PARTS | {"inputs", "memory"}

KINDS = (
    Kind(lambda source: isinstance(source, Expert), _from_expert),
    Kind(is_http_url, _from_http, called="a server", remote=True),
    Kind(is_hub_uri, _from_hub, _INPUTS, "a file of the hub"),
    Kind(_is_zip, _from_agent, _TRUST, "an agent's zip"),
    Kind(_is_c, open_c, _TRUST, "a C file"),
    Kind(_is_path, open_onnx, _INPUTS, "an ONNX file"),
    Kind(lambda source: isinstance(source, torch.nn.Module), _from_torch, _PARTS),
    Kind(lambda source: isinstance(source, Predictor), _from_predictor),
    Kind(callable, _from_function, _PARTS),
)
"""Every kind of expert; the first that recognises a source opens it."""
