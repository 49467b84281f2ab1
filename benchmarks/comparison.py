"""Methods side by side: the picture and the tables that several benchmarks share."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.runner import Row
from benchmarks.statistics import (
    difference_text,
    interquartile_mean,
    interval,
    interval_text,
    paired_difference,
)
from fdtasil.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "Column",
    "Scores",
    "differences_table",
    "draw_curve",
    "draw_panels",
    "scores_of",
    "scores_table",
]

Column = int | str
"""Where a score stands across a figure: a number of trajectories, or the name of a condition."""
Scores = Mapping[tuple[str, Column], Mapping[str, Mapping[int, float]]]
"""(expert, column) -> method -> seed -> score; of complete groups only."""
TRAJECTORIES = "trajectories"

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
    found: dict[tuple[str, Column], dict[str, dict[int, float]]] = {}
    for row in rows:
        cell = row["cell"]
        group = found.setdefault((cell["expert"], cell["episodes"]), {})
        of_method = group.setdefault(cell["method"], {})
        of_method[cell["seed"]] = row["result"]["normalized_return"]
    return {
        key: group
        for key, group in sorted(found.items(), key=lambda item: item[0])
        if all(len(group.get(method, {})) >= seeds for method in methods)
    }


def scores_table(scores: Scores, methods: Sequence[str], across: str = TRAJECTORIES) -> str:
    """Return a table of interquartile means with their 95 % intervals, one line a group."""
    lines = _head([across, *methods])
    for (expert, column), group in scores.items():
        texts = [interval_text(list(group[method].values())) for method in methods]
        lines.append(f"| {expert} | {column} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def differences_table(
    scores: Scores, pairs: Sequence[tuple[str, str]], across: str = TRAJECTORIES
) -> str:
    """Return a table of mean differences on equal seeds, ours - theirs, with 95 % intervals."""
    lines = _head([across, *(f"{ours} - {theirs}" for ours, theirs in pairs)])
    for (expert, column), group in scores.items():
        found = [paired_difference(group[ours], group[theirs]) for ours, theirs in pairs]
        texts = [difference_text(*difference) for difference in found]
        lines.append(f"| {expert} | {column} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def _head(columns: Sequence[str]) -> list[str]:
    return [f"| expert | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]


def draw_panels(
    scores: Scores,
    methods: Sequence[str],
    label: Callable[[str], str],
    across: str = TRAJECTORIES,
) -> bytes:
    """Draw one panel an expert: score against column, a mark and an interval for each method.

    Args:
        scores: What is drawn.
        methods: In which order.
        label: A method -> what the legend calls it.
        across: What the columns are; empty where their names say it.

    Returns:
        A PNG, readable in black and white.
    """
    from matplotlib.figure import Figure

    experts = sorted({expert for expert, _ in scores})
    # Numbers by size, names as they come.
    columns = dict.fromkeys(column for _, column in scores)
    columns = sorted(columns, key=lambda column: column if isinstance(column, int) else 0)
    figure = Figure(figsize=(3.4 * len(experts), 3.6), layout="constrained")
    panels = figure.subplots(1, len(experts), sharey=True, squeeze=False)[0]
    for panel, expert in zip(panels, experts, strict=True):
        panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
        for number, method in enumerate(methods):
            # Beside each other, so that equal methods can still be told apart.
            shift = (number - (len(methods) - 1) / 2) * 0.8 / len(methods)
            values = {
                place + shift: list(scores[expert, column][method].values())
                for place, column in enumerate(columns)
                if (expert, column) in scores
            }
            draw_curve(panel, values, number, label(method))
        panel.set_title(expert, fontsize=10)
        names = [str(column) for column in columns]
        panel.set_xticks(range(len(columns)), names, rotation=0 if across else 90)
        panel.set_xlim(-0.6, len(columns) - 0.4)
        panel.set_xlabel(across)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("return, share of the expert's")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(methods), fontsize=8, frameon=False
    )
    return png_of(figure)


def draw_curve(
    panel: "Axes", values: Mapping[float, Sequence[float]], number: int, name: str
) -> None:
    """Draw the means of a method and their intervals at places across a panel.

    Args:
        panel: Where.
        values: Place -> the scores of all seeds.
        number: Of the method, which has a style of its own.
        name: What the legend calls it.
    """
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
