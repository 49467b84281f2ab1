"""One panel for each expert, one curve for each method: the picture that benchmarks share."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.statistics import interquartile_mean, interval
from fdtasil.results.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["SHARE", "Curves", "draw_panels"]

Curves = Mapping[str, Mapping[float, Sequence[float]]]
"""What the legend calls a method -> place across the panel -> the scores of all seeds."""
SHARE = "return, share of the expert's"

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


def draw_panels(
    experts: Mapping[str, Curves],
    across: str,
    score: str = SHARE,
    ticks: Sequence[str] | None = None,
) -> bytes:
    """Draw interquartile means and their intervals.

    Args:
        experts: The curves of each expert; the same methods in the same order.
        across: What the places are; empty where the ticks say it, which then stand upright, and
            nothing lies between two of them.
        score: What is drawn upwards.
        ticks: What the places 0, 1, 2, ... are called; None for places that are numbers, on a
            logarithmic axis.

    Returns:
        A PNG, readable in black and white.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(experts), 3.6), layout="constrained")
    panels = figure.subplots(1, len(experts), sharey=True, squeeze=False)[0]
    for panel, (expert, curves) in zip(panels, experts.items(), strict=True):
        panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
        for number, (name, values) in enumerate(curves.items()):
            _draw_curve(panel, values, number, name, joined=bool(across))
        panel.set_title(expert, fontsize=10)
        if ticks is None:
            panel.set_xscale("log")
        else:
            panel.set_xticks(range(len(ticks)), ticks, rotation=0 if across else 90)
            panel.set_xlim(-0.6, len(ticks) - 0.4)
        panel.set_xlabel(across)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(score)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8, frameon=False
    )
    return png_of(figure)


def _draw_curve(
    panel: "Axes",
    values: Mapping[float, Sequence[float]],
    number: int,
    name: str,
    *,
    joined: bool,
) -> None:
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
        linestyle=line if joined else "none",
        linewidth=0.9,
        elinewidth=0.8,
        color=grey,
        label=name,
    )
