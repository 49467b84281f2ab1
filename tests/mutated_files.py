"""Experts' files, mutated at random and opened in child processes that may crash or hang.

Run as a script, this is such a child: it writes one line for each file, so that the parent knows
which one it died of.
"""

import hashlib
import io
import json
import queue
import subprocess
import sys
import tempfile
import threading
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np

BATCH = 500  # files for each child
SECONDS = 60  # without a line, after which a child hangs; its start on a busy machine counts too


def mutate(data: bytes, random: np.random.Generator) -> bytes:
    """Flip bits, overwrite, delete, insert or cut off, once to three times."""
    changed = bytearray(data)
    for _ in range(random.choice([1, 1, 1, 2, 3])):
        place = int(random.integers(max(len(changed), 1)))
        length = int(random.integers(1, 17))
        kind = random.integers(5)
        if kind == 0 and changed:
            changed[place] ^= 1 << random.integers(8)
        elif kind == 1:
            changed[place : place + length] = random.bytes(length)
        elif kind == 2:
            del changed[place : place + length]
        elif kind == 3:
            changed[place:place] = random.bytes(length)
        elif random.integers(4) == 0:  # a cut is nearly always found, and so nearly always dull
            del changed[place:]
    return bytes(changed)


def mutate_member(data: bytes, random: np.random.Generator) -> bytes:
    """Mutate a zip, or one of the members that are read, so that the zip itself stays whole."""
    if random.integers(2):
        return mutate(data, random)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = ("data", "policy.pth")[random.integers(2)]
    members[name] = mutate(members[name], random)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    return target.getvalue()


def open_mutated(bases: list[Path], count: int) -> Counter[str]:
    """Return how many of `count` mutated files had which outcome.

    Outcomes are "refused", "same answers", "other answers", "not finite"; or what must not be:
    "crash", "hang", "unpickled" and the name of an exception that is not fdtasil's. Each with the
    number of such a file after it.
    """
    outcomes: Counter[str] = Counter()
    first = 0
    while first < count:
        last = min(first + BATCH, count)
        lines, ending = _child(bases, first, last)
        outcomes.update(lines)
        first += len(lines)
        if first < last:
            outcomes[f"{ending} on file {first}"] += 1
            first += 1
    return outcomes


def _child(bases: list[Path], first: int, last: int) -> tuple[list[str], str]:
    command = [sys.executable, __file__, json.dumps([*map(str, bases)]), str(first), str(last)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    arrived: queue.SimpleQueue[str] = queue.SimpleQueue()
    lines, ending = [], "crash"

    def read() -> None:
        for line in process.stdout:
            arrived.put(line.strip())
        arrived.put("")

    threading.Thread(target=read, daemon=True).start()
    assert arrived.get(timeout=3 * SECONDS) == "ready", (
        "the child's own error is on standard error"
    )
    while True:
        try:
            line = arrived.get(timeout=SECONDS)
        except queue.Empty:
            ending = "hang"
            break
        if not line:
            break
        lines.append(line)
    process.kill()
    process.wait()
    process.stdout.close()
    return lines, ending


def main(bases: list[Path], first: int, last: int) -> None:
    """Open mutated files, and print a line for each."""
    import torch

    import fdtasil
    from fdtasil.experts.trial import vouch_for
    from fdtasil.files.onnx import limits

    torch.set_num_threads(1)
    limits.CALL_SECONDS = 10.0
    unpickled = []
    sys.addaudithook(lambda event, _: unpickled.append(event) if "pickle" in event else None)
    warnings.simplefilter("ignore")
    originals = [(base.read_bytes(), fdtasil.load_expert(base)) for base in bases]
    folder = Path(tempfile.mkdtemp(dir=bases[0].parent))
    print("ready", flush=True)
    for number in range(first, last):
        random = np.random.default_rng(number)
        data, original = originals[number % len(bases)]
        base = bases[number % len(bases)]
        rows = random.standard_normal((4, original.observation_size)).astype(np.float32)
        expected = original.ask(rows, "check")
        path = folder / f"mutated{base.suffix}"
        path.write_bytes((mutate_member if base.suffix == ".zip" else mutate)(data, random))
        if number % 20:  # a process for each would take hours; what it finds, a crash shows here
            vouch_for(hashlib.sha256(path.read_bytes()).hexdigest())
        unpickled.clear()
        try:
            outcome = _compare(fdtasil.load_expert(path), rows, expected)
        except fdtasil.FdtasilError as error:
            text = str(error)
            outcome = "not finite" if "not finite" in text else "refused"
            if len(text.splitlines()) > 6 or not text.replace("\n", "").isprintable():
                outcome = f"a long or unprintable message of file {number}"
        except Exception as error:
            outcome = f"{type(error).__name__} on file {number}"
        print(f"unpickled on file {number}" if unpickled else outcome, flush=True)


def _compare(expert, rows, expected):
    answers = expert.ask(rows, "check")
    same = answers.shape == expected.shape and np.array_equal(answers, expected)
    return "same answers" if same else "other answers"


if __name__ == "__main__":
    main([Path(base) for base in json.loads(sys.argv[1])], int(sys.argv[2]), int(sys.argv[3]))
