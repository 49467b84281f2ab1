"""What a run has cost, over interruptions: everything is counted once, and nothing is lost."""

from collections import Counter

import pytest

from fdtasil.errors import SettingError
from fdtasil.experts.silence import Silence
from fdtasil.run.account import Account


class Process:
    """What an expert and a clock tell the account in one process."""

    def __init__(self, monkeypatch):
        self.rows, self.silence, self.notes, self.now = Counter(), Silence(), [], 0.0
        monkeypatch.setattr("fdtasil.run.account.time.perf_counter", lambda: self.now)
        self.account = Account(self.rows, self.silence, self.notes)

    def ask(self, purpose, rows, silent=0):
        self.rows[purpose] += rows
        self.silence.rows[purpose] += silent


def test_what_is_asked_again_after_an_interruption_is_counted_apart(monkeypatch):
    first = Process(monkeypatch)
    first.ask("act", 50, silent=3)
    kept = first.account.to_json()
    first.ask("act", 9)  # lost, for nothing was kept after it
    second = Process(monkeypatch)
    second.ask("check", 4)
    with second.account.asked_before():
        second.ask("check", 16, silent=1)
    second.account.take_up(kept)  # a later stage was kept as well
    assert second.account.queries == Counter(act=50)
    assert second.account.again == 20
    with second.account.asked_before():
        second.ask("probe", 5, silent=2)
    second.ask("probe", 7, silent=1)
    assert second.account.to_json()["queries"] == {"act": 50, "probe": 7}
    assert second.account.to_json()["silent"] == {"act": 3, "probe": 1}
    assert second.account.again == 25
    third = Process(monkeypatch)
    third.ask("act", 2)
    third.account.take_up(second.account.to_json())
    assert third.account.queries == Counter(act=50, probe=7)
    assert third.account.silent == Counter(act=3, probe=1)
    assert third.account.again == 27


def test_warnings_and_seconds_go_on_where_the_interrupted_run_was(monkeypatch):
    first = Process(monkeypatch)
    first.silence.reason, first.now = "infeasible", 100.0
    first.ask("act", 50, silent=3)
    first.notes += ["slow", "still"]
    kept = first.account.to_json()
    second = Process(monkeypatch)
    second.notes += ["slow", "clipped"]
    second.now = 30.0  # of finding what was kept
    second.account.take_up(kept)
    second.notes.append("slow")
    second.now = 35.0
    assert second.account.notes == ["slow", "still", "clipped", "slow"]
    assert second.account.seconds == 105.0
    assert second.silence.reason == "infeasible"


def test_a_budget_may_be_used_up_to_the_last_row(monkeypatch):
    run = Process(monkeypatch)
    run.ask("act", 50)
    with run.account.asked_before():
        run.ask("act", 50)
    run.account.check_budget(10, 60)
    run.account.check_budget(10**9, None)
    with pytest.raises(SettingError, match="50 queries are asked, and 11 more are due"):
        run.account.check_budget(11, 60)
    run.account.check_budget(4, 60, later=6)
    with pytest.raises(SettingError, match="50 queries are asked, and 11 more are due"):
        run.account.check_budget(4, 60, later=7)
