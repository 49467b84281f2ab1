"""What a run has cost so far, over interruptions: queries, warnings, seconds."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from fdtasil.errors import SettingError

__all__ = ["Account", "check_account"]


class Account:
    """The account of a run, which every checkpoint keeps.

    The ledger only grows, and only the expert writes it. What a run has spent is what its
    interrupted part had spent, and what the ledger has grown by since that was taken up.

    Args:
        ledger: Rows that the expert has answered in this process, by purpose.
        notes: The library's warnings in this process; grows by itself.
    """

    def __init__(self, ledger: Mapping[str, int], notes: Sequence[str]) -> None:
        self._ledger, self._notes = ledger, notes
        self._earlier: dict[str, Any] = {"queries": {}, "again": 0, "notes": [], "seconds": 0.0}
        self._before: Mapping[str, int] = {}  # the ledger, when that was taken up
        self._heard = 0  # notes of this process, when that was taken up
        self._repeated: Counter[str] = Counter()
        self._began = time.perf_counter()

    @property
    def queries(self) -> Counter[str]:
        """Rows by purpose, each counted once."""
        spent = Counter(self._earlier["queries"])
        spent.update(self._ledger)
        spent.subtract(self._before)
        spent.subtract(self._repeated)
        return spent

    @property
    def again(self) -> int:
        """Rows that were asked again after an interruption; they are counted nowhere else."""
        repeated = sum(self._before.values()) + self._repeated.total()
        return self._earlier["again"] + repeated

    @property
    def notes(self) -> list[str]:
        """The warnings, those of the interrupted part first, and none of them twice for it."""
        earlier = self._earlier["notes"]
        again, new = self._notes[: self._heard], self._notes[self._heard :]
        return [*earlier, *(note for note in again if note not in earlier), *new]

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of collecting, probing and training."""
        return self._earlier["seconds"] + time.perf_counter() - self._began

    def start_clock(self) -> None:
        """Count the seconds from now on."""
        self._began = time.perf_counter()

    def to_json(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        queries = {purpose: rows for purpose, rows in self.queries.items() if rows}
        return {
            "queries": queries,
            "again": self.again,
            "notes": self.notes,
            "seconds": self.seconds,
        }

    def take_up(self, earlier: dict[str, Any]) -> None:
        """Go on from a checkpoint; what this process asked before, the interrupted one had too."""
        self._earlier, self._before = earlier, dict(self._ledger)
        self._heard = len(self._notes)
        self._repeated.clear()  # the whole ledger is
        self.start_clock()

    @contextmanager
    def asked_before(self) -> Iterator[None]:
        """Count what is asked inside the block as asked again: the interrupted part counted it."""
        before = Counter(self._ledger)
        yield
        self._repeated.update(Counter(self._ledger) - before)

    def check_budget(self, rows: int, most: int | None) -> None:
        """Refuse to ask beyond the budget: early ends make a resampling source ask more often.

        What a resumed run had to ask again is no part of what the run needs.

        Raises:
            SettingError: If `rows` more are more than `most` in all.
        """
        asked = self.queries.total()
        if most is not None and asked + rows > most:
            raise SettingError(
                f"{asked:,} queries are asked, and {rows:,} more are due",
                f"at most max_queries={most:,}",
                "raise max_queries, or write probes=10, which are asked once",
            )


def check_account(earlier: object) -> None:
    """Refuse what `Account.to_json` has not written.

    Raises:
        TypeError: If it is something else.
    """
    if not isinstance(earlier, dict):
        raise TypeError("an account that is none")
    queries, notes = earlier["queries"], earlier["notes"]
    good = (
        isinstance(queries, dict)
        and all(type(rows) is int for rows in (*queries.values(), earlier["again"]))
        and isinstance(notes, list)
        and all(isinstance(note, str) for note in notes)
        and type(earlier["seconds"]) in (int, float)
    )
    if not good:
        raise TypeError("an account that is none")
