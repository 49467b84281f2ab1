"""The command line as a user has it; `inside` of conftest runs it without a process."""

import os
import subprocess
import sys


def shell(*arguments, cwd="."):
    """Run `fdtasil` as a user does; starting Python and torch takes seconds."""
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    command = [sys.executable, "-m", "fdtasil", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment)
