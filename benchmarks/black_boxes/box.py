"""What a maker of black boxes is, and how what it made is measured."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdtasil.environments import EnvironmentPool
from fdtasil.experts import load_expert
from fdtasil.rollouts import Episodes, follow, rollout
from fdtasil.seeding import episode_seeds

SHIPPED = Path(__file__).parents[2] / "experts"


@dataclass(frozen=True)
class BlackBox:
    """A maker of one expert that has no useful derivative.

    Attributes:
        name: What to call it on the command line and in tables.
        about: One sentence on what it is and why it has no derivative.
        environment: Gymnasium id.
        make: Folder for its files -> the expert (an ONNX path, a function, a URL), or a context
            manager that yields it, where something must be ended afterwards.
        horizon: Steps of an episode.
        episodes: Paired episodes of an evaluation; fewer where the expert is slow.
        slow: Whether a row takes milliseconds.
        needs: Optional libraries that `make` imports.
    """

    name: str
    about: str
    environment: str
    make: Callable[[Path], Any]
    horizon: int = 300
    episodes: int = 20
    slow: bool = False
    needs: tuple[str, ...] = ()

    @contextmanager
    def open(self, folder: Path) -> Iterator[Any]:
        """Make the expert, and end what serves it afterwards."""
        folder.mkdir(parents=True, exist_ok=True)
        made = self.make(folder)
        manager = made if isinstance(made, AbstractContextManager) else nullcontext(made)
        with manager as expert:
            yield expert


def measure(expert: Any, environment: str, horizon: int, episodes: int, seed: int = 0) -> Episodes:
    """Let an expert act from the starts of a seed."""
    with EnvironmentPool(environment) as pool:
        asked = load_expert(expert, pool.boxes.observation_size, pool.boxes.action_size)
        starts = episode_seeds(seed, "measure", 0, episodes)
        return rollout(follow(asked.policy("evaluate")), pool, starts, horizon)
