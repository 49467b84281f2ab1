"""An ONNX model as a policy: which output holds the actions, and how it is asked in batches.

Nothing here needs torch: the process that tries unknown files starts in a moment.
"""

import time
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from fdtasil.errors import ExpertError, FdtasilWarning, first_line, shown, warn
from fdtasil.files.onnx.limits import limit_process
from fdtasil.files.onnx.recurrent import MEMORY_NAMES
from fdtasil.files.onnx.session import is_batched, open_session, rebatched, run_session

if TYPE_CHECKING:
    import onnxruntime

    Session = onnxruntime.InferenceSession

__all__ = ["OnnxPolicy", "cannot_be_asked", "open_policy", "open_within_limits"]

_WHOLE = ("tensor(int64)", "tensor(int32)")
_FLOATS = ("tensor(float)", "tensor(double)", "tensor(float16)")


class OnnxPolicy:
    """Answers (B, n) float32 with (B, m) float32; sent to another process, it opens itself there.

    Args:
        data: The model's bytes.
        name: What to call it in messages.
        output: Name of the output that holds the actions.
        size: n.
        rows: How many rows are asked at once; None for any number, 0 for one without a batch axis.
        session: The model, where it is open already.

    Attributes:
        output: As given.
        size: n.
    """

    def __init__(
        self,
        data: bytes,
        name: str,
        output: str,
        size: int,
        rows: int | None,
        session: "Session | None" = None,
    ) -> None:
        self._arguments = data, name, output, size, rows
        self.output, self.size, self._rows = output, size, rows
        self._session = open_session(data, name) if session is None else session

    def __reduce__(self) -> tuple[type["OnnxPolicy"], tuple[bytes, str, str, int, int | None]]:
        return OnnxPolicy, self._arguments

    @property
    def one_by_one(self) -> bool:
        """Whether the model takes one row at a time."""
        return self._rows in (0, 1)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """(B, n) float32 -> (B, m) float32."""
        if self._rows is None:
            return run_session(self._session, self.output, observations)
        if self._rows == 0:
            return self._one_by_one(observations)
        return self._in_turn(observations, self._rows)

    def _in_turn(self, observations: np.ndarray, size: int) -> np.ndarray:
        empty = np.zeros((-len(observations) % size, self.size), np.float32)
        padded = np.concatenate([observations, empty])
        parts = [
            run_session(self._session, self.output, padded[start : start + size])
            for start in range(0, len(padded), size)
        ]
        return np.concatenate(parts)[: len(observations)]

    def _one_by_one(self, observations: np.ndarray) -> np.ndarray:
        zeros = np.zeros((1, self.size), np.float32)  # for an empty batch, to know the width
        rows = observations if len(observations) else zeros
        answers = [run_session(self._session, self.output, row) for row in rows]
        return np.stack(answers)[: len(observations)]


def open_policy(
    data: bytes,
    name: str,
    observation_size: int | None,
    action_size: int | None,
    output: str | None,
    choices: int = 0,
) -> tuple[OnnxPolicy, int, int | None]:
    """Open a model, and ask it about a few observations.

    Args:
        data: The model's bytes.
        name: What to call it.
        observation_size: n, used where the file leaves it open.
        action_size: m, which chooses among the outputs; or None.
        output: Name of the output that holds the actions, or None.
        choices: How many choices an action is; where no scores go out, they themselves are taken.

    Returns:
        The policy, and its n and m; None for m where it answers with choices.

    Raises:
        ExpertError: If it can't be opened or asked, or its signature is not a policy's.
    """
    session = open_session(data, name)
    try:
        n = _observation_size(session, name, observation_size)
        chosen = _choose_output(session, name, action_size, output, choices)
        policy = _fastest(data, name, session, chosen, n)
        answers = policy(np.zeros((2, n), np.float32))
    except ExpertError:
        raise
    except Exception as error:  # onnxruntime has its own, and damaged names are no text
        raise cannot_be_asked(name, error) from error
    if choices and answers.shape in ((2,) * (choices == 1), (2, choices)):
        return policy, n, None
    if answers.ndim != 2 or len(answers) != 2:
        raise ExpertError(
            f"{name} answers 2 observations with shape {answers.shape}",
            "(2, m): one row of actions for each row of observations",
            _wrapped(session, name, chosen, "rows", ".reshape(len(rows), -1)"),
        )
    return policy, n, answers.shape[1]


def cannot_be_asked(name: str, error: Exception) -> ExpertError:
    """Return the error of a model that fails to answer."""
    limited = isinstance(error, (MemoryError, TimeoutError))
    return ExpertError(
        f"{name} can't be asked: {first_line(error)}",
        "answers to a few observations",
        "leave the file alone; if you know it, wrap a session of its own in a function"
        if limited
        else "export it again, and ask it with onnxruntime alone",
    )


def open_within_limits(
    data: bytes,
    name: str,
    observation_size: int | None,
    action_size: int | None,
    output: str | None,
    choices: int,
    straight: bool,
) -> None:
    """Do what `open_policy` does, in a process that may be killed for it.

    Args:
        data: As there, like the next five.
        name: As there.
        observation_size: As there.
        action_size: As there.
        output: As there.
        choices: As there.
        straight: Whether it is also asked what a torch twin of it is compared on.
    """
    limit_process(len(data))
    warnings.simplefilter("ignore", FdtasilWarning)  # the parent opens it again, and warns
    policy, n, _ = open_policy(data, name, observation_size, action_size, output, choices)
    if straight:
        with suppress(Exception):  # what it raises, the parent will see
            policy(np.random.default_rng(0).standard_normal((64, n)).astype(np.float32))


def _observation_size(session: "Session", name: str, wanted: int | None) -> int:
    inputs = session.get_inputs()
    described = _described(inputs)
    if len(inputs) != 1:
        raise _several_inputs(session, name, described)
    shape, kind = inputs[0].shape, inputs[0].type
    if kind not in _FLOATS or len(shape) not in (1, 2):
        raise ExpertError(
            f"{name} has the input {described}",
            "(batch, n) numbers of type float16, float32 or float64, or (n) of them",
            "export the policy for flat observations",
        )
    n = shape[-1] if isinstance(shape[-1], int) else wanted
    if n is None:
        raise ExpertError(
            f"{name} leaves its observation size open: {described}",
            "a size in the file or from the caller",
            "write load_expert(path, observation_size=...)",
        )
    return n


def _several_inputs(session: "Session", name: str, described: str) -> ExpertError:
    """Say whether they are a memory, or parts of an observation."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    # What goes in as it came out; a goal or a time goes in only.
    widths = [entry.shape[-1:] for entry in outputs if entry.shape]
    memory = any(
        (MEMORY_NAMES.search(str(e.name)) or len(e.shape) == 3) and e.shape[-1:] in widths
        for e in inputs[1:]
    )
    found = f"{name} has {len(inputs)} inputs: {described}"
    if memory:
        return ExpertError(
            f"{found}; they look like a policy's memory",
            "one input (batch, n), or one and a memory that comes out again",
            'say which: load_expert(path, memory={"h_in": "h_out"})',
        )
    start, parts = 0, []
    for entry in inputs:
        width = entry.shape[-1] if len(entry.shape) > 1 and entry.type in _FLOATS else None
        wide = width if isinstance(width, int) else 0
        parts.append(f'"{entry.name}": ' + (f'"{start}:{start + wide}"' if wide else "0.0"))
        start += wide
    written = shown(f"{{{', '.join(parts)}}}")
    return ExpertError(
        found,
        "what each of them is given: columns of the observation, or a number always",
        f"write for example load_expert(path, inputs={written}) (--inputs in a shell)",
    )


def _wrapped(session: "Session", name: str, output: str, *parts: str) -> str:
    """Return the function that asks a model as it is; the last of `parts` may treat its answer."""
    inputs = session.get_inputs()
    treated = parts[-1] if len(parts) > len(inputs) else ""
    types = {"tensor(double)": '.astype("float64")', "tensor(float16)": '.astype("float16")'}
    feed = ", ".join(
        f"{str(entry.name)!r}: {part}{types.get(entry.type, '')}"
        for entry, part in zip(inputs, parts, strict=False)
    )
    return (
        f"wrap it: session = onnxruntime.InferenceSession({name!r}); expert = lambda rows: "
        f"session.run([{str(output)!r}], {{{feed}}})[0]{treated}"
    )


_NO_LIST = 'a classifier of skl2onnx: convert it with options={id(model): {"zipmap": False}}'


def _choose_output(
    session: "Session", name: str, action_size: int | None, output: str | None, choices: int
) -> str:
    outputs = session.get_outputs()
    described = _described(outputs)
    if output is not None:
        kinds = {entry.name: entry.type for entry in outputs}
        if output not in kinds:
            raise ExpertError(
                f"{name} has no output {output!r}", f"one of {described}", "choose one of these"
            )
        if kinds[output].startswith("seq("):
            found = f"the output {output!r} of {name} is a list ({shown(kinds[output])})"
            raise ExpertError(found, "numbers (batch, m)", _NO_LIST)
        return output
    rank = len(session.get_inputs()[0].shape)
    fitting = [entry.name for entry in outputs if _could_be_actions(entry, rank, action_size)]
    # One number a row, without an axis of its own: what is wrong with it is said once it is asked.
    flat = [e.name for e in outputs if e.type in _FLOATS and len(e.shape) < rank]
    whole = [entry.name for entry in outputs if entry.type in _WHOLE] if choices else []
    fitting = fitting or whole[:1] or flat[:1]
    if len(fitting) != 1:
        raise ExpertError(
            f"{name} has {len(fitting)} outputs that could be the actions: {described}",
            f"one floating-point output (batch, {action_size or 'm'})",
            'name it: load_expert(path, output="...") (--output on the command line)'
            if fitting
            else _NO_LIST
            if any(entry.type.startswith("seq(") for entry in outputs)
            else "check that expert and environment belong together",
        )
    return fitting[0]


def _could_be_actions(entry: "onnxruntime.NodeArg", rank: int, action_size: int | None) -> bool:
    if entry.type not in _FLOATS:
        return False
    # An exporter may leave the shape open; then only asking tells.
    if not entry.shape or not isinstance(entry.shape[-1], int):
        return True
    return len(entry.shape) == rank and action_size in (None, entry.shape[-1])


def _fastest(data: bytes, name: str, session: "Session", output: str, n: int) -> OnnxPolicy:
    """Return the fastest way to ask that gives the answers of single rows."""
    if len(session.get_inputs()[0].shape) == 1:
        return _slow(OnnxPolicy(data, name, output, n, 0, session), 1, n)
    if is_batched(session):
        if _takes_batches(session, output, n):
            return OnnxPolicy(data, name, output, n, None, session)
        size = 1
    else:
        size = session.get_inputs()[0].shape[0]
    in_turn = OnnxPolicy(data, name, output, n, size, session)
    free = rebatched(data)
    try:
        at_once = OnnxPolicy(free, "the re-batched model", output, n, None)
    except ExpertError:
        return _slow(in_turn, size, n)
    return at_once if _agree(at_once, in_turn, n) else _slow(in_turn, size, n)


def _takes_batches(session: "Session", output: str, n: int) -> bool:
    """Whether a free batch dimension is true: a constant inside the graph may hold another."""
    try:
        answers = run_session(session, output, np.zeros((3, n), np.float32))
    except (MemoryError, TimeoutError):
        raise
    except Exception:  # onnxruntime has its own
        return False
    return answers.ndim != 2 or len(answers) == 3


def _agree(at_once: OnnxPolicy, in_turn: OnnxPolicy, n: int) -> bool:
    rows = np.random.default_rng(0).standard_normal((17, n)).astype(np.float32)
    try:
        fast, slow = at_once(rows), in_turn(rows)
    except (MemoryError, TimeoutError):
        raise
    except Exception:  # a constant inside the graph still wants the old batch
        return False
    return fast.shape == slow.shape and np.allclose(fast, slow, rtol=1e-4, atol=1e-5)


def _slow(in_turn: OnnxPolicy, size: int, n: int) -> OnnxPolicy:
    rows = np.zeros((64 * size, n), np.float32)
    in_turn(rows[:size])
    start = time.perf_counter()
    in_turn(rows)
    seconds = (time.perf_counter() - start) / len(rows)
    warn(
        f"the model takes {size} row(s) at a time and can't be re-batched: asked in turn, "
        f"{1e6 * seconds:.0f} microseconds a row (batches are about ten times faster); "
        "export it with a free batch dimension to mend this"
    )
    return in_turn


def _described(entries: "Sequence[onnxruntime.NodeArg]") -> str:
    """Return inputs or outputs as a text; a file may have thousands of them."""
    listed = ", ".join(_describe(entry) for entry in entries[:8])
    return f"{listed}, ..." if len(entries) > 8 else listed


def _describe(entry: "onnxruntime.NodeArg") -> str:
    kind = entry.type.removeprefix("tensor(").removesuffix(")")
    return shown(f"{entry.name} {kind} ({', '.join(str(size) for size in entry.shape)})")
