"""Processes that end badly: forks of one that has loaded everything, which takes seconds."""

import os
import pickle
import select
import subprocess
import sys
from pathlib import Path

_CODE = """
import os, pickle, signal, sys, traceback
import gymnasium, onnx, onnxruntime, scipy.stats, torch
import torch._dynamo  # which an optimiser loads
torch.set_num_threads(1)
import fdtasil
fdtasil.distill  # loaded when it is named
{code}
for line in sys.stdin:
    order = pickle.loads(bytes.fromhex(line))
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background jobs
        code = 1
        try:
            code = run(**order)
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    print("begun", child, flush=True)
    print("ended", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Nursery:
    """Starts processes, one at a time.

    Args:
        code: Defines `run(**order)`, which returns an exit code. What it prints to standard output
            are lines of a word and a number.
        errors: File of what is printed to standard error.
    """

    def __init__(self, code, errors):
        self.errors = errors
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors.open("w")}
        command = [sys.executable, "-c", _CODE.replace("{code}", code)]
        self._process = subprocess.Popen(command, env=environment, text=True, **pipes)

    def start(self, **order):
        """Start a process; return its number, which is that of its group too."""
        self._process.stdin.write(pickle.dumps(order).hex() + "\n")
        self._process.stdin.flush()
        return self.told("begun")

    def end(self):
        """Wait for the process's end; return its exit code, negative for a signal."""
        return self.told("ended")

    def ends_within(self, seconds):
        """Wait for a line, such as that of the end, but not for long; return whether it came."""
        return bool(select.select([self._process.stdout], [], [], seconds)[0])

    def told(self, what):
        """Return what is told next of that kind: a test that failed may not have waited.

        An exit code of 0 that is taken for a process number would signal this whole group.
        """
        while True:
            said, number = self._process.stdout.readline().split()
            if said == what:
                return int(number)

    def close(self):
        """End it."""
        self._process.stdin.close()
        self._process.wait(30)
