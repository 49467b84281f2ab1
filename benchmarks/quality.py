"""Do the defaults keep their promise: the expert's return, and never worse than plain cloning."""

from collections.abc import Callable, Mapping, Sequence
from statistics import mean
from typing import Any

from benchmarks.controllers import available
from benchmarks.distillation import distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.statistics import difference_text, interval_text, paired_difference
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

# Episodes and steps: the usual budget, little data, whole episodes, and the default call's.
BUDGETS = ((5, 300), (2, 300), (1, 300), (5, 1000), (20, 1000))
FRESH, STORED, PLAIN = PROBES = ("fresh", 10, 0)  # these experts' default is the first
_NAMES = {PLAIN: "plain cloning", STORED: "10 probes", FRESH: "fresh"}


def cells(quick: bool) -> list[Cell]:
    """Every expert, budget and seed, with fresh and stored probes, and without."""
    experts = available("HalfCheetah-v5") if quick else available()
    return [
        {"expert": e, "probes": p, "episodes": n, "horizon": t, "seed": seed}
        for n, t in (BUDGETS[:1] if quick else BUDGETS)
        for seed in (range(2) if quick else SEEDS)
        for e in experts
        for p in PROBES
    ]


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: experts and budgets down, plain cloning, stored and fresh probes across."""
    heads = ["expert", "episodes x steps", *reversed(_names())]
    heads += [f"{_NAMES[FRESH]} - {_NAMES[other]}, 95 %" for other in (STORED, PLAIN)]
    heads += [f"{_NAMES[STORED]} - {_NAMES[PLAIN]}, 95 %"]
    heads += ["worst seeds, stored and fresh", "survival, expert, stored and fresh", "seconds"]
    lines: list[list[str]] = []
    experts = list(dict.fromkeys(row["cell"]["expert"] for row in rows))
    for episodes, horizon in BUDGETS:
        for expert in experts:
            mine = [
                row
                for row in rows
                if (row["cell"]["expert"], row["cell"]["episodes"], row["cell"]["horizon"])
                == (expert, episodes, horizon)
            ]
            lines += _line(mine, [expert, f"{episodes} x {horizon}"])
    return {"quality.md": table(heads, lines).encode()}


def _names() -> list[str]:
    return [_NAMES[probes] for probes in PROBES]


Results = Mapping[int, Mapping[str, Any]]  # by seed


def _line(rows: Sequence[Row], head: list[str]) -> list[list[str]]:
    """Return the line of an expert and budget, or none where no way has two seeds yet."""
    found = {
        probes: {
            row["cell"]["seed"]: row["result"] for row in rows if row["cell"]["probes"] == probes
        }
        for probes in PROBES
    }
    if all(len(results) < 2 for results in found.values()):
        return []
    line = [*head, *(_score_text(found[probes]) for probes in reversed(PROBES))]
    pairs = ((FRESH, STORED), (FRESH, PLAIN), (STORED, PLAIN))
    line += [_difference_text(found[ours], found[theirs]) for ours, theirs in pairs]
    asked = (STORED, FRESH)
    line.append(", ".join(_text(min, found[probes], "normalized_return") for probes in asked))
    # Equal seeds, equal starts: the expert's own survival is any way's.
    lasts = [_text(mean, max(found.values(), key=len), "expert_survival")]
    lasts += [_text(mean, found[probes], "survival") for probes in asked]
    seconds = [_text(mean, found[probes], "train_seconds", 0) for probes in asked]
    return [[*line, ", ".join(lasts), ", ".join(seconds)]]


def _score_text(results: Results) -> str:
    scores = [result["normalized_return"] for result in results.values()]
    return interval_text(scores) if len(scores) > 1 else "-"


def _difference_text(ours: Results, theirs: Results) -> str:
    if len(ours.keys() & theirs.keys()) < 2:
        return "-"
    scores = (
        {seed: result["normalized_return"] for seed, result in results.items()}
        for results in (ours, theirs)
    )
    return difference_text(*paired_difference(*scores), 3)


def _text(of: Callable[..., float], results: Results, name: str, digits: int = 2) -> str:
    return f"{of(r[name] for r in results.values()):.{digits}f}" if results else "-"


BENCHMARK = distillations("quality", __doc__ or "", cells, dict, draw)
