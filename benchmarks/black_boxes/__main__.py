"""`python -m benchmarks.black_boxes NAME --out FOLDER`: make one, and measure its return."""

import argparse
from pathlib import Path

from . import BLACK_BOXES, measure


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.black_boxes", description=__doc__)
    parser.add_argument("name", choices=BLACK_BOXES)
    parser.add_argument("--out", type=Path, required=True, help="folder of the files made")
    parser.add_argument("--episodes", type=int, default=20, help="of the measured return")
    arguments = parser.parse_args()
    box = BLACK_BOXES[arguments.name]
    with box.open(arguments.out) as expert:
        print(f"{box.name}: {getattr(expert, 'name', expert)}\n{box.about}")
        episodes = measure(expert, box.environment, box.horizon, arguments.episodes)
        print(
            f"{box.environment}, {arguments.episodes} episodes of {box.horizon} steps: return "
            f"{episodes.returns.mean():.2f} +- {episodes.returns.std():.2f}, "
            f"survival {1 - episodes.terminated.mean():.2f}"
        )


if __name__ == "__main__":
    main()
