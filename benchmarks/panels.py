"""One panel for each expert, one curve for each method: the picture that benchmarks share."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.statistics import FEWEST, interquartile_mean, interval
from fdtasil.results.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["SHARE", "Curves", "draw_panels"]

Curves = Mapping[str, Mapping[float, Sequence[float]]]
"""What the legend calls a method -> place across the panel -> the scores of all seeds."""
SHARE = "return, share of the expert's"

_ABREAST = 5  # panels in a row

_Style = tuple[str, str, str]
"""Marker, line and grey: told apart without colour."""
# What several pictures show looks the same in all of them.
_KNOWN: dict[str, _Style] = {
    "plain": ("o", ":", "0.0"),
    "plain cloning": ("o", ":", "0.0"),
    "fresh": ("D", "-", "0.0"),
    "fresh queries, longer training": ("D", "-", "0.0"),
    "10 probes": ("^", "--", "0.0"),
    "1 probe": ("v", "--", "0.45"),
    "50 probes": ("P", "-.", "0.0"),
    "analytic Jacobian": ("s", "-", "0.45"),
}
_OTHERS: tuple[_Style, ...] = (
    ("X", ":", "0.45"),
    ("*", "-.", "0.0"),
    ("h", "-", "0.6"),
    ("<", "--", "0.6"),
    (">", ":", "0.0"),
    ("d", "-.", "0.6"),
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

    across_page = min(_ABREAST, len(experts))
    down = -(-len(experts) // across_page)
    height = 3.2 if across else 4.0  # names that stand upright take room
    figure = Figure(figsize=(3.4 * across_page, 0.4 + height * down), layout="constrained")
    grid = figure.subplots(down, across_page, sharey=True, squeeze=False)
    panels = list(grid.flat)
    for panel in panels[len(experts) :]:
        panel.set_visible(False)
    styles = _styles_of(list(next(iter(experts.values()))))
    for panel, (expert, curves) in zip(panels, experts.items(), strict=False):
        panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
        for name, values in curves.items():
            _draw_curve(panel, values, styles[name], name, joined=bool(across))
        panel.set_title(expert, fontsize=10)
        if ticks is None:
            panel.set_xscale("log")
        else:
            panel.set_xticks(range(len(ticks)), ticks, rotation=0 if across else 90)
            panel.set_xlim(-0.6, len(ticks) - 0.4)
        panel.set_xlabel(across)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in grid[:, 0]:
        panel.set_ylabel(score)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        title=f"interquartile mean and 95 % interval over seeds (range of fewer than {FEWEST})",
        loc="outside lower center",
        ncols=len(labels),
        fontsize=8,
        title_fontsize=8,
        frameon=False,
    )
    return png_of(figure)


def _styles_of(names: Sequence[str]) -> dict[str, _Style]:
    """Return a style for each method, the known ones by their names."""
    left = iter(_OTHERS)
    return {name: _KNOWN.get(name) or next(left) for name in names}


def _draw_curve(
    panel: "Axes",
    values: Mapping[float, Sequence[float]],
    style: _Style,
    name: str,
    *,
    joined: bool,
) -> None:
    means = np.array([interquartile_mean(sample) for sample in values.values()])
    low, high = np.reshape([interval(sample) for sample in values.values()], (-1, 2)).T
    marker, line, grey = style
    panel.errorbar(
        list(values),
        means,
        yerr=np.maximum(0.0, [means - low, high - means]),
        marker=marker,
        markersize=4.5,
        markerfacecolor="white" if grey == "0.0" and line != ":" else grey,
        linestyle=line if joined else "none",
        linewidth=0.9,
        elinewidth=0.8,
        color=grey,
        label=name,
    )
