"""What a run tells while it goes on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from fdtasil.checks import check_path, spelt
from fdtasil.errors import SettingError, shown
from fdtasil.results.evaluation import Evaluation
from fdtasil.student.policy import Student

__all__ = ["Callback", "Event", "Log", "tell_all"]


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
        kind: "entry" (100 training steps), "round" (a round's student is trained), or
            "evaluation".
        round: Number of the round.
        step: Training steps so far, of all rounds.
        entry: The history's newest entry.
        student: The round's student, not to be changed; None for an entry.
        evaluation: Student against expert; of an evaluation only.
    """

    kind: Literal["entry", "round", "evaluation"]
    round: int
    step: int
    entry: dict[str, float]
    student: Student | None = None
    evaluation: Evaluation | None = None


Callback = Callable[[Event], None]


def tell_all(callback: Callback | Sequence[Callback] | None) -> Callback:
    """Return one callback that tells all.

    Raises:
        SettingError: If one of them can't be called with an event.
    """
    given: Any = () if callback is None else callback
    several = isinstance(given, Sequence) and not isinstance(given, str | bytes)
    callbacks: list[Any] = list(given) if several and not callable(given) else [given]
    if not all(callable(one) and not isinstance(one, type) for one in callbacks):
        raise SettingError(
            spelt("callback", callback),
            "a function of an fdtasil.Event, or several in a list",
            'write for example callback=fdtasil.Log("runs/log", "csv")',
        )

    def tell(event: Event) -> None:
        for one in callbacks:
            one(event)

    return tell


class Log:
    """A callback that writes stable-baselines3's logs: losses, and the evaluation at the end.

    Args:
        folder: Where the files go: progress.csv, progress.json, log.txt, events.out.tfevents... If
            it is there already, one beside it is taken, since a logger begins its files anew.
        *formats: Some of "stdout", "log", "csv", "json", "tensorboard"; the last one needs the
            package tensorboard (`[tb]`).

    Raises:
        SettingError: If a format is unknown or its package is missing.

    Example::

        fdtasil.distill(expert, env, callback=fdtasil.Log("runs/walker/log", "csv"))
    """

    def __init__(self, folder: str | Path, *formats: str) -> None:
        where = check_path("folder", folder)
        unknown = sorted(shown(one) for one in formats if not _is_format(one))
        if unknown or not formats:
            found = f"log formats: {', '.join(unknown) or 'none'}"
            raise SettingError(found, f"some of {', '.join(_FORMATS)}", 'write for example "csv"')
        if "tensorboard" in formats and find_spec("tensorboard") is None:
            raise SettingError(
                "the log format tensorboard without its package",
                "the package tensorboard",
                'pip install "fdtasil[tb]"',
            )
        self._folder, self._formats = where.absolute(), formats
        self._logger: Any = None

    def __call__(self, event: Event) -> None:
        """Write what an event says."""
        if event.kind == "round":
            return  # its entry has been told
        if self._logger is None:
            self._logger = self._open()
        values: dict[str, object] = {f"train/{name}": v for name, v in event.entry.items()}
        if event.evaluation is not None:
            numbers = event.evaluation.to_json().items()
            values |= {f"eval/{name}": v for name, v in numbers if isinstance(v, float)}
        for name, value in values.items():
            self._logger.record(name, value)
        self._logger.dump(event.step)

    def _open(self) -> Any:
        from stable_baselines3.common import logger

        beside = [self._folder.with_name(f"{self._folder.name}-{n}") for n in range(2, 1000)]
        folder = next(path for path in (self._folder, *beside) if not path.exists())
        return logger.configure(str(folder), list(self._formats))


def _is_format(value: object) -> bool:
    return isinstance(value, str) and value in _FORMATS


_FORMATS = ("stdout", "log", "csv", "json", "tensorboard")
