"""Is a question better spent on a probe, or on another trajectory: return against questions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.comparison import draw_curve
from benchmarks.distillation import distillations
from benchmarks.finite_difference import HORIZON, SEEDS, experts
from benchmarks.runner import Cell, Row
from benchmarks.statistics import difference_text, interval_text, paired_difference
from fdtasil.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["QUERIES"]

# Trajectories of each method: what they cost in questions overlaps.
BUDGETS: dict[str, tuple[int, ...]] = {
    "plain": (1, 2, 5, 20, 60),
    "dagger": (5, 20, 60),
    "1": (1, 2, 5, 20),
    "10": (1, 2, 5, 20),
    "50": (1, 2, 5, 20),
}
METHODS: dict[str, dict[str, Any]] = {
    "plain": {"probes": 0},
    "dagger": {"trainer": "dagger", "probes": 0},
    **{count: {"probes": int(count)} for count in ("1", "10", "50")},
}
LABELS = {
    "plain": "plain cloning, more trajectories",
    "dagger": "DAgger, more trajectories",
    "1": "1 probe",
    "10": "10 probes",
    "50": "50 probes",
}
RIVALS = ("plain", "dagger")
# The answers that a student learns from; the gate's and the evaluation's are asked of all.
PURPOSES = ("act", "label", "calibrate", "probe")

Curves = Mapping[str, Mapping[int, Mapping[int, tuple[int, float]]]]
"""method -> trajectories -> seed -> (questions, score)."""


def cells(quick: bool) -> list[Cell]:
    """Every seed, expert, method and number of trajectories."""
    return [
        {"expert": expert, "episodes": count, "method": method, "seed": seed}
        for seed in (range(2) if quick else SEEDS)
        for expert in (experts()[:1] if quick else experts())
        for method in BUDGETS
        for count in (BUDGETS[method][:2] if quick else BUDGETS[method])
    ]


def arguments(cell: Cell) -> dict[str, Any]:
    """Return the cell's method; the rest are defaults."""
    settings = {"expert": cell["expert"], "episodes": cell["episodes"], "seed": cell["seed"]}
    return {**settings, "horizon": HORIZON, **METHODS[cell["method"]]}


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One picture and two tables, of the experts that are complete."""
    curves = _curves(rows)
    if not curves:
        return {}
    text = f"{_scores(curves)}\nAgainst a rival that asks as much:\n\n{_differences(curves)}"
    return {"queries.png": _picture(curves), "queries.md": text.encode()}


def _curves(rows: Sequence[Row]) -> dict[str, Curves]:
    """Return the curves of each expert with every cell."""
    found: dict[str, dict[str, dict[int, dict[int, tuple[int, float]]]]] = {}
    for row in rows:
        cell, result = row["cell"], row["result"]
        asked = sum(result["queries"].get(purpose, 0) for purpose in PURPOSES)
        curve = found.setdefault(cell["expert"], {}).setdefault(cell["method"], {})
        point = curve.setdefault(cell["episodes"], {})
        point[cell["seed"]] = (asked, result["normalized_return"])
    return {
        expert: curves
        for expert, curves in sorted(found.items())
        if all(
            len(curves.get(method, {}).get(count, {})) >= len(SEEDS)
            for method, counts in BUDGETS.items()
            for count in counts
        )
    }


def _at_equal_cost(curves: Curves, ours: tuple[str, int], rival: str) -> dict[int, float]:
    """Return, by seed, what the rival reaches with the questions that we asked.

    Between two numbers of trajectories the rival's return is taken to be linear in the logarithm
    of its questions. Seeds that ask more than its largest number, or less than its least, are
    left out.
    """
    found = {}
    method, count = ours
    for seed, (asked, _) in curves[method][count].items():
        points = sorted(by_seed[seed] for by_seed in curves[rival].values())
        costs, scores = np.log([cost for cost, _ in points]), [score for _, score in points]
        if costs[0] <= np.log(asked) <= costs[-1]:
            found[seed] = float(np.interp(np.log(asked), costs, scores))
    return found


def _scores(curves: Mapping[str, Curves]) -> str:
    lines = ["| expert | method | trajectories | questions | return |", "|---|---|---|---|---|"]
    for expert, of_expert in curves.items():
        for method, counts in BUDGETS.items():
            for count in counts:
                points = of_expert[method][count].values()
                asked = np.median([cost for cost, _ in points])
                score = interval_text([score for _, score in points])
                lines.append(f"| {expert} | {LABELS[method]} | {count} | {asked:,.0f} | {score} |")
    return "\n".join(lines) + "\n"


def _differences(curves: Mapping[str, Curves]) -> str:
    """Return a table of paired differences, ours - the rival's at equal questions."""
    heads = [f"- {LABELS[rival].partition(',')[0]}" for rival in RIVALS]
    lines = [
        f"| expert | method | trajectories | questions | {' | '.join(heads)} |",
        "|---|---|---|---|" + "---|" * len(heads),
    ]
    for expert, of_expert in curves.items():
        for method, counts in BUDGETS.items():
            for count in counts if method not in RIVALS else ():
                points = of_expert[method][count]
                scores = {seed: score for seed, (_, score) in points.items()}
                theirs = [_at_equal_cost(of_expert, (method, count), rival) for rival in RIVALS]
                texts = [
                    difference_text(*paired_difference(scores, other))
                    if len(other) == len(scores)
                    else "out of reach"
                    for other in theirs
                ]
                asked = np.median([cost for cost, _ in points.values()])
                lines.append(
                    f"| {expert} | {LABELS[method]} | {count} | {asked:,.0f} "
                    f"| {' | '.join(texts)} |"
                )
    return "\n".join(lines) + "\n"


def _picture(curves: Mapping[str, Curves]) -> bytes:
    """Draw one panel an expert: return against questions, one curve a method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(curves), 3.6), layout="constrained")
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for panel, (expert, of_expert) in zip(panels, curves.items(), strict=True):
        _panel(panel, expert, of_expert)
    panels[0].set_ylabel("return, share of the expert's")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8, frameon=False
    )
    return png_of(figure)


def _panel(panel: "Axes", expert: str, curves: Curves) -> None:
    panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
    for number, method in enumerate(BUDGETS):
        values = {
            float(np.median([cost for cost, _ in points.values()])): [
                score for _, score in points.values()
            ]
            for points in curves[method].values()
        }
        draw_curve(panel, values, number, LABELS[method])
    panel.set_xscale("log")
    panel.set_title(expert, fontsize=10)
    panel.set_xlabel("questions that the student learns from")
    panel.spines[["top", "right"]].set_visible(False)


QUERIES = distillations("queries", __doc__ or "", cells, arguments, draw)
