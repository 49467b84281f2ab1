"""What a run has cost so far, over interruptions: queries, warnings, seconds."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from fdtasil.errors import SettingError
from fdtasil.experts.silence import Silence

__all__ = ["Account", "check_account"]


class _Tally:
    """Rows by purpose, over interruptions, each counted once.

    Args:
        rows: Those of this process; only the expert writes them, and they only grow.
    """

    def __init__(self, rows: Mapping[str, int]) -> None:
        self._rows = rows
        self._earlier: Mapping[str, int] = {}
        self._before: Mapping[str, int] = {}  # the rows, when the earlier ones were taken up
        self._repeated: Counter[str] = Counter()

    @property
    def counted(self) -> Counter[str]:
        counted = Counter(self._earlier)
        counted.update(self._rows)
        counted.subtract(self._before)
        counted.subtract(self._repeated)
        return counted

    @property
    def again(self) -> int:
        return sum(self._before.values()) + self._repeated.total()

    def to_json(self) -> dict[str, int]:
        return {purpose: rows for purpose, rows in self.counted.items() if rows}

    def take_up(self, earlier: Mapping[str, int]) -> None:
        self._earlier, self._before = earlier, dict(self._rows)
        self._repeated.clear()  # all rows of this process are

    @contextmanager
    def repeating(self) -> Iterator[None]:
        before = Counter(self._rows)
        yield
        self._repeated.update(Counter(self._rows) - before)


class Account:
    """The account of a run, which every checkpoint keeps.

    What a run has spent is what its interrupted part had spent, and what has come since that was
    taken up.

    Args:
        ledger: Rows that the expert was asked for in this process, by purpose.
        silence: What is known of those that had no answer.
        notes: The library's warnings in this process; grows by itself.
    """

    def __init__(self, ledger: Mapping[str, int], silence: Silence, notes: Sequence[str]) -> None:
        self._asked, self._silent, self._notes = _Tally(ledger), _Tally(silence.rows), notes
        self._silence = silence
        self._earlier: dict[str, Any] = {"again": 0, "notes": [], "seconds": 0.0}
        self._heard = 0  # notes of this process, when the earlier ones were taken up
        self._began = time.perf_counter()

    @property
    def queries(self) -> Counter[str]:
        """Rows by purpose, each counted once."""
        return self._asked.counted

    @property
    def silent(self) -> Counter[str]:
        """Rows without an answer by purpose, each counted once."""
        return self._silent.counted

    @property
    def again(self) -> int:
        """Rows that were asked again after an interruption; they are counted nowhere else."""
        return self._earlier["again"] + self._asked.again

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
        return {
            "queries": self._asked.to_json(),
            "silent": self._silent.to_json(),
            "reason": self._silence.reason,
            "again": self.again,
            "notes": self.notes,
            "seconds": self.seconds,
        }

    def take_up(self, earlier: dict[str, Any]) -> None:
        """Go on from a checkpoint; what this process asked before, the interrupted one had too."""
        self._earlier = earlier
        self._asked.take_up(earlier["queries"])
        self._silent.take_up(earlier.get("silent", {}))  # older versions knew of none
        if earlier.get("silent"):
            self._silence.reason = earlier["reason"]
        self._heard = len(self._notes)
        self.start_clock()

    @contextmanager
    def asked_before(self) -> Iterator[None]:
        """Count what is asked inside the block as asked again: the interrupted part counted it."""
        with self._asked.repeating(), self._silent.repeating():
            yield

    def check_budget(self, rows: int, most: int | None, later: int = 0) -> None:
        """Refuse to ask beyond the budget: early ends make a resampling source ask more often.

        What a resumed run had to ask again is no part of what the run needs.

        Args:
            rows: That are due now.
            most: That may be asked in all.
            later: That the end of the run will ask: its evaluation.

        Raises:
            SettingError: If they are more.
        """
        asked = self.queries.total()
        if most is not None and asked + rows + later > most:
            raise SettingError(
                f"{asked:,} queries are asked, and {rows + later:,} more are due",
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
    queries, silent, notes = earlier["queries"], earlier.get("silent", {}), earlier["notes"]
    good = (
        isinstance(queries, dict)
        and isinstance(silent, dict)
        and isinstance(earlier.get("reason", ""), str)
        and all(
            type(rows) is int for rows in (*queries.values(), *silent.values(), earlier["again"])
        )
        and isinstance(notes, list)
        and all(isinstance(note, str) for note in notes)
        and type(earlier["seconds"]) in (int, float)
    )
    if not good:
        raise TypeError("an account that is none")
