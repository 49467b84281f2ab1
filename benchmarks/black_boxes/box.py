"""What a maker of black boxes is, and how what it made is measured."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdtasil.experts.load import load_expert
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds

SHIPPED = Path(__file__).parents[2] / "experts"


@dataclass(frozen=True)
class BlackBox:
    """A maker of one expert that has no useful derivative.

    Attributes:
        name: What to call it on the command line and in tables.
        about: One sentence on what it is and why it has no derivative.
        environment: Gymnasium id.
        make: Folder for its files -> the expert (an ONNX path, a function, an `Expert`).
        horizon: Steps of an episode.
        demonstrations: Episodes that it is distilled from.
        slow: Whether a row takes milliseconds.
        needs: Optional libraries that `make` imports.
        serves: Whether `make` returns a context manager that yields the expert, since something
            must be ended afterwards.
    """

    name: str
    about: str
    environment: str
    make: Callable[[Path], Any]
    horizon: int = 300
    demonstrations: int = 5
    slow: bool = False
    needs: tuple[str, ...] = ()
    serves: bool = False

    @contextmanager
    def open(self, folder: Path) -> Iterator[Any]:
        """Make the expert, and end what serves it afterwards."""
        folder.mkdir(parents=True, exist_ok=True)
        made = self.make(folder)
        with made if self.serves else nullcontext(made) as expert:
            yield expert


def measure(expert: Any, environment: str, horizon: int, episodes: int, seed: int = 0) -> Episodes:
    """Let an expert act from the starts of a seed."""
    with EnvironmentPool(environment) as pool:
        asked = load_expert(expert, pool.boxes.observation_size, pool.boxes.action_size)
        starts = episode_seeds(seed, "measure", 0, episodes)
        return rollout(follow(asked.policy("evaluate")), pool, starts, horizon)
