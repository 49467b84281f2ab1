"""Methods side by side over budgets: the picture and the tables that several benchmarks share."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.runner import Row
from benchmarks.statistics import interquartile_mean, interval, interval_text, paired_difference
from fdtasil.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Scores", "differences_table", "draw_panels", "scores_of", "scores_table"]

Scores = Mapping[tuple[str, int], Mapping[str, Mapping[int, float]]]
"""(expert, budget) -> method -> seed -> score; of complete groups only."""

# Told apart without colour: marker, line and grey.
_STYLES = (
    ("o", ":", "0.0"),
    ("s", "-", "0.0"),
    ("^", "--", "0.0"),
    ("v", "--", "0.45"),
    ("D", "-", "0.45"),
    ("P", "-.", "0.0"),
    ("X", ":", "0.45"),
    ("*", "-.", "0.45"),
    ("h", "-", "0.7"),
)


def scores_of(rows: Sequence[Row], methods: Sequence[str], seeds: int) -> Scores:
    """Sort the rows' scores into groups, and leave out those with a method or seed missing.

    Args:
        rows: With `expert`, `method`, `seed` and `episodes` in their cells, `normalized_return`
            in their results.
        methods: Which a group must have.
        seeds: How many of each.
    """
    found: dict[tuple[str, int], dict[str, dict[int, float]]] = {}
    for row in rows:
        cell = row["cell"]
        group = found.setdefault((cell["expert"], cell["episodes"]), {})
        of_method = group.setdefault(cell["method"], {})
        of_method[cell["seed"]] = row["result"]["normalized_return"]
    return {
        key: group
        for key, group in sorted(found.items())
        if all(len(group.get(method, {})) >= seeds for method in methods)
    }


def scores_table(scores: Scores, methods: Sequence[str]) -> str:
    """Return a table of interquartile means with their 95 % intervals, one line a group."""
    lines = [
        f"| expert | trajectories | {' | '.join(methods)} |",
        "|---|---|" + "---|" * len(methods),
    ]
    lines += [
        f"| {expert} | {count} | "
        + " | ".join(interval_text(list(group[method].values())) for method in methods)
        + " |"
        for (expert, count), group in scores.items()
    ]
    return "\n".join(lines) + "\n"


def differences_table(scores: Scores, pairs: Sequence[tuple[str, str]]) -> str:
    """Return a table of mean differences on equal seeds, ours - theirs, with 95 % intervals."""
    heads = [f"{ours} - {theirs}" for ours, theirs in pairs]
    lines = _head(heads)
    for (expert, count), group in scores.items():
        found = [paired_difference(group[ours], group[theirs]) for ours, theirs in pairs]
        texts = [f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]" for mean, (low, high) in found]
        lines.append(f"| {expert} | {count} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def _head(columns: Sequence[str]) -> list[str]:
    return [
        f"| expert | trajectories | {' | '.join(columns)} |",
        "|---" * (len(columns) + 2) + "|",
    ]


def draw_panels(scores: Scores, methods: Sequence[str], label: Callable[[str], str]) -> bytes:
    """Draw one panel an expert: score against budget, a mark and an interval for each method.

    Args:
        scores: What is drawn.
        methods: In which order.
        label: A method -> what the legend calls it.

    Returns:
        A PNG, readable in black and white.
    """
    from matplotlib.figure import Figure

    experts = sorted({expert for expert, _ in scores})
    budgets = sorted({budget for _, budget in scores})
    figure = Figure(figsize=(3.4 * len(experts), 3.6), layout="constrained")
    panels = figure.subplots(1, len(experts), sharey=True, squeeze=False)[0]
    for panel, expert in zip(panels, experts, strict=True):
        panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
        for number, method in enumerate(methods):
            # Beside each other, so that equal methods can still be told apart.
            shift = (number - (len(methods) - 1) / 2) * 0.8 / len(methods)
            values = {
                place + shift: list(scores[expert, budget][method].values())
                for place, budget in enumerate(budgets)
                if (expert, budget) in scores
            }
            _draw_method(panel, values, number, label(method))
        panel.set_title(expert, fontsize=10)
        panel.set_xticks(range(len(budgets)), [str(budget) for budget in budgets])
        panel.set_xlim(-0.6, len(budgets) - 0.4)
        panel.set_xlabel("trajectories")
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("return, share of the expert's")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(methods), fontsize=8, frameon=False
    )
    return png_of(figure)


def _draw_method(
    panel: "Axes", values: Mapping[float, Sequence[float]], number: int, name: str
) -> None:
    """Draw the means of a method and their intervals at places across a panel."""
    means = np.array([interquartile_mean(sample) for sample in values.values()])
    low, high = np.transpose([interval(sample) for sample in values.values()])
    marker, line, grey = _STYLES[number]
    panel.errorbar(
        list(values),
        means,
        yerr=np.maximum(0.0, [means - low, high - means]),
        marker=marker,
        markersize=4.5,
        markerfacecolor="white" if number % 2 else grey,
        linestyle=line,
        linewidth=0.9,
        elinewidth=0.8,
        color=grey,
        label=name,
    )
