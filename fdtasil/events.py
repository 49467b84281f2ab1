"""What a run tells while it goes on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fdtasil.errors import SettingError
from fdtasil.evaluation import Evaluation
from fdtasil.sb3 import open_log
from fdtasil.student import Student

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
