"""What a run has cost so far, kept over interruptions: rows asked, warnings, seconds."""

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from fdtasil.errors import SettingError

__all__ = ["Account"]


@dataclass
class Account:
    """The account of a run, which every checkpoint keeps.

    Attributes:
        queries: Rows that the expert has answered, by purpose: the expert's own ledger, which it
            writes; empty where nobody is asked.
        notes: The library's warnings so far; grows by itself.
        earlier: Seconds that the interrupted run took for what is taken up from it.
        started: When this process began, on the clock of `time.perf_counter`.
        again: Rows asked before a checkpoint was taken up, which the interrupted run has asked
            and counted too; None in a run that was not interrupted.
    """

    queries: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    earlier: float = 0.0
    started: float = field(default_factory=time.perf_counter)
    again: int | None = None

    @property
    def seconds(self) -> float:
        """Wall-clock seconds so far."""
        return self.earlier + time.perf_counter() - self.started

    def to_json(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {
            "queries": dict(self.queries),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def take_up(self, kept: dict[str, Any]) -> None:
        """Go on from an interrupted run's; what this process asked before counts as again."""
        if self.again is None:
            self.again = sum(self.queries.values())
        self.queries.clear()
        self.queries.update(kept["queries"])
        self.queries["again"] += self.again
        earlier = kept["notes"]
        self.notes[:] = earlier + [note for note in self.notes if note not in earlier]
        self.earlier, self.started = kept["seconds"], time.perf_counter()

    def check_budget(self, rows: int, most: int | None) -> None:
        """Refuse to ask beyond the budget: early ends make a resampling source ask more often.

        What a resumed run had to ask again is no part of what the run needs.

        Raises:
            SettingError: If `rows` more are more than `most` in all.
        """
        asked = sum(count for purpose, count in self.queries.items() if purpose != "again")
        if most is not None and asked + rows > most:
            raise SettingError(
                f"{asked:,} rows are asked, and {rows:,} more are due",
                f"at most max_queries={most:,}",
                "raise max_queries, or leave out resample",
            )
