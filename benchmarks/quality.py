"""Do the defaults keep their promise: the expert's return, and never worse than plain cloning."""

from collections.abc import Callable, Mapping, Sequence
from statistics import mean
from typing import Any

from benchmarks.controllers import available
from benchmarks.distillation import distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.statistics import (
    DIFFERENCES_NOTE,
    SCORES_NOTE,
    Difference,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

# Episodes and steps: the usual budget, little data, whole episodes, and the default call's.
BUDGETS = ((5, 300), (2, 300), (1, 300), (5, 1000), (20, 1000))
FRESH, STORED, PLAIN = PROBES = ("fresh", 10, 0)  # these experts' default is the first
PAIRS = ((FRESH, STORED), (FRESH, PLAIN), (STORED, PLAIN))
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
    """A table a budget: experts down, plain cloning, stored and fresh probes across."""
    experts = list(dict.fromkeys(row["cell"]["expert"] for row in rows))
    text = f"{SCORES_NOTE}\n{DIFFERENCES_NOTE}"
    for episodes, horizon in BUDGETS:
        found = {e: _results(rows, e, episodes, horizon) for e in experts}
        found = {e: of for e, of in found.items() if any(len(mine) > 1 for mine in of.values())}
        if found:
            steps = ", ".join(f"{_NAMES[p]} {_steps(found, p)}" for p in reversed(PROBES))
            text += f"\n## {episodes} x {horizon} steps\n\nSteps of training: {steps}.\n\n"
            text += _budget(found)
    return {"quality.md": text.encode()}


Results = Mapping[int, Mapping[str, Any]]  # by seed


def _results(rows: Sequence[Row], expert: str, episodes: int, horizon: int) -> dict[Any, Results]:
    """Return probes -> seed -> result of an expert and budget."""
    found: dict[Any, dict[int, Mapping[str, Any]]] = {probes: {} for probes in PROBES}
    for row in rows:
        cell = row["cell"]
        if (cell["expert"], cell["episodes"], cell["horizon"]) == (expert, episodes, horizon):
            found[cell["probes"]][cell["seed"]] = row["result"]
    return found


def _steps(found: Mapping[str, Mapping[Any, Results]], probes: Any) -> str:
    """Return how many steps were trained, over experts and seeds."""
    taken = {one["steps"] for of in found.values() for one in of[probes].values()} or {0}
    least, most = min(taken), max(taken)
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"


def _budget(found: Mapping[str, Mapping[Any, Results]]) -> str:
    heads = ["expert", *(_NAMES[probes] for probes in reversed(PROBES))]
    heads += [f"{_NAMES[ours]} - {_NAMES[theirs]}" for ours, theirs in PAIRS]
    heads += ["worst seeds, stored and fresh", "survival, expert, stored and fresh"]
    columns = [
        difference_column([_difference(of[ours], of[theirs]) for of in found.values()], 3)
        for ours, theirs in PAIRS
    ]
    lines = []
    for number, (expert, of) in enumerate(found.items()):
        line = [expert, *(_score_text(of[probes]) for probes in reversed(PROBES))]
        line += [cells[number] for cells, _ in columns]
        asked = (STORED, FRESH)
        line.append(", ".join(_text(min, of[probes], "normalized_return") for probes in asked))
        # Equal seeds, equal starts: the expert's own survival is any way's.
        lasts = [_text(mean, max(of.values(), key=len), "expert_survival")]
        lasts += [_text(mean, of[probes], "survival") for probes in asked]
        lines.append([*line, ", ".join(lasts)])
    lines.append(["intervals", "", "", "", *(counted for _, counted in columns), "", ""])
    return table(heads, lines)


def _score_text(results: Results) -> str:
    scores = [result["normalized_return"] for result in results.values()]
    return interval_text(scores) if len(scores) > 1 else "-"


def _difference(ours: Results, theirs: Results) -> Difference | None:
    if len(ours.keys() & theirs.keys()) < 2:
        return None
    scores = (
        {seed: result["normalized_return"] for seed, result in results.items()}
        for results in (ours, theirs)
    )
    return paired_difference(*scores)


def _text(of: Callable[..., float], results: Results, name: str) -> str:
    return f"{of(r[name] for r in results.values()):.2f}" if results else "-"


BENCHMARK = distillations("quality", __doc__ or "", cells, dict, draw)
