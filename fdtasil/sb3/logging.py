"""Logging through stable-baselines3's logger: stdout, log, csv, json, tensorboard."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fdtasil.errors import SettingError

__all__ = ["FORMATS", "open_log"]

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
