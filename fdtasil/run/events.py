"""What a run tells while it goes on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fdtasil.errors import SettingError
from fdtasil.results.evaluation import Evaluation
from fdtasil.student.network import Student

__all__ = ["Callback", "Event", "tell_all"]


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


def tell_all(callback: Callback | None, formats: Sequence[str], folder: Path | None) -> Callback:
    """Return one callback that tells the caller's and stable-baselines3's logger.

    Raises:
        SettingError: If formats are asked for without a folder, or one can't be had.
    """
    if formats and folder is None:
        raise SettingError(
            f"log_formats={tuple(formats)!r} without a folder", "out=", 'write out="runs/mine"'
        )
    log = None
    if formats and folder is not None:
        # A resumed run logs into a folder of its own: the logger begins its files anew.
        earlier = len(list(folder.glob("log*")))
        log = open_log(folder / (f"log-{earlier + 1}" if earlier else "log"), formats)

    def tell(event: Event) -> None:
        if log is not None:
            values: dict[str, object] = {f"train/{k}": v for k, v in event.entry.items()}
            if event.evaluation is not None:
                numbers = event.evaluation.to_json().items()
                values |= {f"eval/{k}": v for k, v in numbers if isinstance(v, float)}
            if event.kind != "round":
                log(event.step, values)
        if callback is not None:
            callback(event)

    return tell


FORMATS = ("stdout", "log", "csv", "json", "tensorboard")


def open_log(folder: Path, formats: Sequence[str]) -> Callable[[int, dict[str, Any]], None]:
    """Return a function that logs values at a training step.

    Args:
        folder: Where the files go: progress.csv, progress.json, log.txt, events.out.tfevents...
        formats: Some of `FORMATS`; "tensorboard" needs the package tensorboard (`[tb]`).

    Raises:
        SettingError: If a format is unknown or its package is missing.
    """
    unknown = sorted(set(formats) - set(FORMATS))
    if unknown:
        raise SettingError(f"log_formats: {', '.join(unknown)}", f"some of {FORMATS}", "choose")
    from stable_baselines3.common import logger

    try:
        log = logger.configure(str(folder), list(formats))
    except (ImportError, AssertionError) as error:
        raise SettingError(
            f"log_formats: {error}", "the package tensorboard", 'pip install "fdtasil[tb]"'
        ) from error

    def write(step: int, values: dict[str, Any]) -> None:
        for name, value in values.items():
            log.record(name, value)
        log.dump(step)

    return write
