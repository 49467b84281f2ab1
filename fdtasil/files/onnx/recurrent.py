"""ONNX models whose state goes in and out: asked about observations and what is remembered."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fdtasil.checks import spelt
from fdtasil.errors import ExpertError, SettingError, shown
from fdtasil.files.onnx.limits import limit_process, run_within_limits
from fdtasil.files.onnx.nodes import free_inputs
from fdtasil.files.onnx.session import open_session

if TYPE_CHECKING:
    import onnx

__all__ = ["MEMORY_NAMES", "RecurrentPolicy", "check_memory", "find_memory", "try_recurrent"]

MEMORY_NAMES = re.compile(
    r"(?i)(^|[^a-z])(h|c)(x|n|0|_?(in|prev|t))?($|[^a-z])|state|hidden|cell|memory|rnn|lstm|gru|carry"
)
"""What inputs and outputs that hold a memory are usually called."""


def check_memory(memory: object) -> Mapping[str, str]:
    """Refuse what does not say which input comes out of which output.

    Raises:
        SettingError: If it is something else.
    """
    pairs = dict(memory) if isinstance(memory, Mapping) else {}
    if not pairs or not all(isinstance(text, str) for text in (*pairs, *pairs.values())):
        raise SettingError(spelt("memory", memory), "inputs and their outputs", _EXAMPLE)
    return {str(name): str(output) for name, output in pairs.items()}


def find_memory(
    model: "onnx.ModelProto", given: Mapping[str, str] | None, bound: Sequence[str] = ()
) -> tuple[tuple[str, str], ...]:
    """Return the inputs of a model that hold a memory, each with the output that it comes out of.

    Args:
        model: The model.
        given: Input -> output, where the caller says it.
        bound: Inputs that are given something else.

    Returns:
        The pairs; none where it has no memory, or not all but one input are accounted for.

    Raises:
        SettingError: If a name is not there.
    """
    inputs = free_inputs(model.graph)
    outputs = {entry.name: entry for entry in model.graph.output}
    if given is not None:
        for name, there in (
            *((n, inputs) for n in given),
            *((n, outputs) for n in given.values()),
        ):
            if name not in there:
                listed = ", ".join(map(shown, there))
                raise SettingError(f"memory: {name!r}", f"one of {listed}", _EXAMPLE)
        left = [name for name in inputs if name not in given and name not in bound]
        if len(left) != 1:
            raise SettingError(
                f"memory: {len(left)} inputs are left beside it: {', '.join(map(shown, left))}",
                "one, the observation",
                "name every input of the memory, each with its output",
            )
        return tuple(given.items())
    pairs, free = [], list(outputs)
    for place, (name, entry) in enumerate(inputs.items()):
        sizes = _sizes(entry)
        likely = MEMORY_NAMES.search(name) or (place > 0 and len(sizes) == 3)
        same = [o for o in free if _sizes(outputs[o])[-1:] == sizes[-1:] and sizes[-1:]]
        same = [o for o in same if len(_sizes(outputs[o])) == len(sizes)]
        same.sort(key=lambda o: (_stem(o) != _stem(name), not MEMORY_NAMES.search(o)))
        if likely and same and name not in bound:
            pairs.append((name, same[0]))
            free.remove(same[0])
    left = [name for name in inputs if name not in dict(pairs) and name not in bound]
    return tuple(pairs) if len(left) == 1 and free else ()


def _stem(name: str) -> str:
    """Return what is left of a name without the words for in and out."""
    return re.sub(r"(?i)(in|out|prev|next|new|old|[0-9n]|_|\.)+$", "", name).lower()


def _sizes(entry: "onnx.ValueInfoProto") -> list[int]:
    return [dimension.dim_value for dimension in entry.type.tensor_type.shape.dim]


_EXAMPLE = 'write memory={"h_in": "h_out"}'


class RecurrentPolicy:
    """Answers (B, n) observations and (B, k) memories with actions and the memories after them.

    Args:
        data: The model's bytes.
        name: What to call it in messages.
        pairs: Inputs and outputs of the memory.
        size: n, where the file leaves it open.
        action_size: m, which chooses among the outputs; or None.
        output: Name of the output with the actions, or None.
    """

    def __init__(
        self,
        data: bytes,
        name: str,
        pairs: tuple[tuple[str, str], ...],
        size: int | None,
        action_size: int | None,
        output: str | None,
    ) -> None:
        self._arguments = data, name, pairs, size, action_size, output
        self._session, self._pairs = open_session(data, name), pairs
        entries = {entry.name: entry for entry in self._session.get_inputs()}
        self._memories = [entries.pop(entering) for entering, _ in pairs]
        (self._observed,) = entries.values()
        n = self._observed.shape[-1]
        n = n if isinstance(n, int) else size
        if n is None:
            step = "write load_expert(path, observation_size=...)"
            raise ExpertError(f"{name} leaves its observation size open", "a size", step)
        self.observation_size = n
        if not all(isinstance(entry.shape[-1], int) for entry in self._memories):
            raise ExpertError(
                f"{name} leaves the size of its memory open",
                "fixed sizes but for the batch",
                "export it again with a fixed size of the state",
            )
        self._parts = [self._part(entry) for entry in self._memories]
        self.memory_size = sum(int(np.prod(part)) for part in self._parts)
        self.output = self._chosen(name, action_size, output)
        actions, _ = self._row(np.zeros((1, n)), np.zeros((1, self.memory_size)))
        self.action_size = actions.shape[1]

    def __reduce__(self) -> tuple[object, ...]:
        return RecurrentPolicy, self._arguments

    def __call__(
        self, observations: np.ndarray, memories: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See the class; rows are asked one by one, for exporters fix the batch at one."""
        if not len(observations):
            return np.zeros((0, self.action_size), np.float32), memories
        rows = zip(observations[:, None], memories[:, None], strict=True)
        actions, after = zip(*(self._row(*row) for row in rows), strict=True)
        return np.concatenate(actions), np.concatenate(after)

    def _row(self, observation: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        feed = {self._observed.name: _as(observation.reshape(self._shape()), self._observed.type)}
        start = 0
        for entry, part in zip(self._memories, self._parts, strict=True):
            stop = start + int(np.prod(part))
            feed[entry.name] = _as(memory[0, start:stop].reshape(part), entry.type)
            start = stop
        names = [self.output, *(leaving for _, leaving in self._pairs)]
        actions, *after = run_within_limits(self._session, names, feed)
        joined = np.concatenate([part.astype(np.float32).reshape(1, -1) for part in after], 1)
        return actions.astype(np.float32).reshape(1, -1), joined

    def _shape(self) -> tuple[int, ...]:
        """Of one observation, as the file has it: lengths of one but for the last."""
        return (*(1 for _ in self._observed.shape[:-1]), self.observation_size)

    def _part(self, entry: object) -> tuple[int, ...]:
        """Of the memory of one row; what is open is the batch."""
        return tuple(n if isinstance(n, int) and n > 0 else 1 for n in entry.shape)  # pyright: ignore

    def _chosen(self, name: str, action_size: int | None, output: str | None) -> str:
        left = [
            entry
            for entry in self._session.get_outputs()
            if entry.name not in {leaving for _, leaving in self._pairs}
        ]
        fitting = [e.name for e in left if output in (None, e.name)]
        if output is None and action_size is not None:
            sized = [e.name for e in left if e.shape and e.shape[-1] in (action_size, None)]
            fitting = sized or fitting
        if len(fitting) != 1:
            listed = ", ".join(shown(entry.name) for entry in left)
            raise ExpertError(
                f"{name} has {len(fitting)} outputs that could be the actions, of {listed}",
                "one",
                'name it: load_expert(path, output="...") (--output on the command line)',
            )
        return fitting[0]


def _as(value: np.ndarray, kind: str) -> np.ndarray:
    types = {"tensor(double)": np.float64, "tensor(float16)": np.float16}
    return np.ascontiguousarray(value, types.get(kind, np.float32))


def try_recurrent(data: bytes, *rest: Any) -> None:
    """Open a model and ask it once, in a process that may be killed for it; see the class."""
    limit_process(len(data))
    RecurrentPolicy(data, *rest)
