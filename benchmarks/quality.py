"""Do the defaults keep their promise: the expert's return, and never worse than plain cloning."""

from collections.abc import Sequence

from benchmarks.controllers import available
from benchmarks.distillation import distillations
from benchmarks.grid import SEEDS
from benchmarks.runner import Cell, Row
from benchmarks.statistics import difference_text, interval_text, paired_difference
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

# Episodes and steps: the usual budget, little data, and the whole length of an episode.
BUDGETS = ((5, 300), (2, 300), (1, 300), (5, 1000))
PROBES = (10, 0)


def cells(quick: bool) -> list[Cell]:
    """Every expert, budget and seed, with and without probes."""
    experts = available("HalfCheetah-v5") if quick else available()
    return [
        {"expert": e, "probes": p, "episodes": n, "horizon": t, "seed": seed}
        for n, t in (BUDGETS[:1] if quick else BUDGETS)
        for seed in (range(2) if quick else SEEDS)
        for e in experts
        for p in PROBES
    ]


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table: experts and budgets down, plain cloning and probes across."""
    heads = ["expert", "episodes x steps", "plain cloning", "10 probes"]
    heads += ["paired difference, 95 %", "worst seed", "survival, expert and student", "seconds"]
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


def _line(rows: Sequence[Row], head: list[str]) -> list[list[str]]:
    """Return the line of an expert and budget, or none where two seeds are not there yet."""
    by_probes = {
        probes: {
            row["cell"]["seed"]: row["result"] for row in rows if row["cell"]["probes"] == probes
        }
        for probes in PROBES
    }
    ours, plain = (by_probes[probes] for probes in PROBES)
    if len(ours.keys() & plain.keys()) < 2:
        return []
    score = {seed: result["normalized_return"] for seed, result in ours.items()}
    base = {seed: result["normalized_return"] for seed, result in plain.items()}
    difference = paired_difference(score, base)
    survival = [
        sum(result[name] for result in ours.values()) / len(ours)
        for name in ("expert_survival", "survival")
    ]
    seconds = sum(result["train_seconds"] for result in ours.values()) / len(ours)
    cells = [interval_text(list(base.values())), interval_text(list(score.values()))]
    cells += [difference_text(*difference, 3), f"{min(score.values()):.2f}"]
    cells += [f"{survival[0]:.2f}, {survival[1]:.2f}", f"{seconds:.0f}"]
    return [[*head, *cells]]


BENCHMARK = distillations("quality", __doc__ or "", cells, dict, draw)
