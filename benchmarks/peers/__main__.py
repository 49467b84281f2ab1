"""`python -m benchmarks.peers [NAME ...]` makes the environments that peers run in."""

import argparse
import subprocess
import sys

from benchmarks.peers.environment import FOLDER, PEERS, ROOT, python_of


def make(name: str) -> None:
    """Make a peer's environment anew, with the versions of `constraints.txt`."""
    subprocess.run([sys.executable, "-m", "venv", "--clear", FOLDER / name], check=True)
    pip = [python_of(name), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    for wanted in PEERS[name]:
        subprocess.run([*pip, "-c", ROOT / "constraints.txt", *wanted], check=True)
    (FOLDER / name / "ready").touch()


def main() -> None:
    """Make the environments that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(PEERS)}; all, if none is named")
    names = parser.parse_args().names or list(PEERS)
    if unknown := sorted(set(names) - set(PEERS)):
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join(PEERS)}")
    for name in names:
        make(name)
        print(python_of(name))


if __name__ == "__main__":
    main()
