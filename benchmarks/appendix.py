"""The paper's finite-difference appendix with its own settings, whatever they cost."""

from collections.abc import Sequence
from typing import Any

from benchmarks.comparison import draw_scores
from benchmarks.distillation import HORIZON, distillations
from benchmarks.grid import SEEDS, experts, label
from benchmarks.runner import Cell, Row
from benchmarks.scores import scores_of, scores_text
from benchmarks.statistics import interval_text
from benchmarks.tables import table

__all__ = ["BENCHMARK"]

# 4,500 epochs, every probe in every step, a sphere of 0.01 drawn once, weight 0.01: 13,500 steps
# for each trajectory. The cheap methods and few trajectories come first.
METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    **{str(count): {"probes": f"sphere:{count}"} for count in (1, 5, 10)},
    "jacobian": {"probes": "jacobian"},
    "50": {"probes": "sphere:50"},
}
DRAWN = ("plain", "1", "5", "10", "50", "jacobian")
BUDGETS = (1, 2, 5, 10, 20)
PAIRS = (
    ("1", "plain"),
    ("5", "plain"),
    ("10", "plain"),
    ("50", "plain"),
    ("jacobian", "plain"),
    ("5", "1"),
    ("10", "1"),
    ("50", "1"),
    ("10", "5"),
    ("5", "jacobian"),
    ("10", "jacobian"),
    ("50", "jacobian"),
)


def cells(quick: bool) -> list[Cell]:
    """Every budget, seed, method and environment."""
    return [
        {"expert": expert, "episodes": budget, "method": method, "seed": seed}
        for budget in (BUDGETS[:1] if quick else BUDGETS)
        for seed in (SEEDS[:1] if quick else SEEDS)
        for method in ([*METHODS][:2] if quick else METHODS)
        for expert in (experts()[:1] if quick else experts())
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method, with the paper's preset as it stands."""
    given = {name: cell[name] for name in ("expert", "episodes", "seed")}
    return {**given, "horizon": HORIZON, "preset": "paper", **METHODS[cell["method"]]}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """Two tables and a picture of what has all seeds, and what was run so far."""
    scores = scores_of(rows, DRAWN[:1], len(SEEDS))
    text = f"{scores_text(scores, DRAWN, PAIRS)}\n" if scores else ""
    text += f"What was run so far (seeds), with its cost:\n\n{_so_far(rows)}"
    files = {"appendix.md": text.encode()}
    return files | ({"appendix.png": draw_scores(scores, DRAWN, label)} if scores else {})


def _so_far(rows: Sequence[Row]) -> str:
    found: dict[tuple[str, int, str], list[Any]] = {}
    for row in rows:
        cell = row["cell"]
        found.setdefault((cell["expert"], cell["episodes"], cell["method"]), []).append(
            row["result"]
        )
    lines = []
    for (expert, budget, method), results in sorted(found.items()):
        scores = [one["normalized_return"] for one in results]
        score = interval_text(scores) if len(scores) > 1 else f"{scores[0]:.2f}"
        seconds = max(one["train_seconds"] for one in results)
        lines.append(
            [expert, str(budget), label(method), str(len(scores)), score, f"{seconds:.0f}"]
        )
    heads = ["expert", "trajectories", "method", "seeds", "return", "seconds at most"]
    return table(heads, lines)


BENCHMARK = distillations("appendix", __doc__ or "", cells, arguments, draw)
