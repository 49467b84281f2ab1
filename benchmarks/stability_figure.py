"""The picture of the stability experiment."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.runner import Row
from benchmarks.stability_table import NAMES, STARTS, THRESHOLDS, Results, grouped
from benchmarks.statistics import interval
from fdtasil.results.figures import png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_figure"]

_PANELS = {
    "gap": "imitation gap, $\\max_t\\ \\|x_t - x^*_t\\|$",
    "mean": "policy discrepancy, $\\mathrm{mean}_t\\ \\|\\Delta(x_t)\\|$",
}
_TICKS = (0.05, 0.1, 0.2, 0.5, 1, 2, 3)
# Told apart without colour: the order by its marker, the source by line and filling.
_COLOURS = ("#000000", "#0072B2", "#D55E00")
_MARKERS = ("o", "s", "^")
_SOURCES: dict[str, dict[str, Any]] = {
    "none": {"linestyle": "-"},
    "jacobian": {"linestyle": "-"},
    "differences": {"linestyle": (0, (4, 2)), "markerfacecolor": "white"},
}


def draw_figure(rows: Sequence[Row]) -> bytes:
    """Draw gap and discrepancy against nu, from fresh starts above, from learnt ones below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 6.2), layout="constrained")
    panels = figure.subplots(len(STARTS), len(_PANELS), sharex=True, squeeze=False)
    for across, (starts, title) in zip(panels, STARTS.items(), strict=True):
        for panel, (quantity, label) in zip(across, _PANELS.items(), strict=True):
            for number, (key, results) in enumerate(grouped(rows).items()):
                _curve(panel, key, results, starts, quantity, number)
            _dress(panel, label, title)
    for panel in panels[-1]:
        panel.set_xlabel("$\\nu$, where $\\gamma(r) = 5\\,r^\\nu$", fontsize=9)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return png_of(figure, dpi=200)


def _curve(
    panel: "Axes",
    key: tuple[int, str],
    results: Results,
    starts: str,
    quantity: str,
    number: int,
) -> None:
    """Draw the median over seeds of the medians over starts, and its interval."""
    order, source = key
    values = np.array([result[starts][quantity]["median"] for result in results])
    nus, colour = results[0]["nus"], _COLOURS[order]
    low, high = np.transpose([interval(column, np.median) for column in values.T])
    panel.fill_between(nus, low, high, color=colour, alpha=0.15, linewidth=0)
    panel.plot(
        nus,
        np.median(values, axis=0),
        color=colour,
        marker=_MARKERS[order],
        markersize=4.5,
        # In turn, for the curves of the two sources lie on each other.
        markevery=(number % 4, 4),
        linewidth=1.2,
        label=f"$p = {order}$, {NAMES[source]}",
        **_SOURCES[source],
    )


def _dress(panel: "Axes", label: str, title: str) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
    panel.set_xticks([], minor=True)
    for order, (nu, text) in enumerate(THRESHOLDS.items()):
        panel.axvline(nu, color="#555555", linestyle=":", linewidth=1.0, zorder=0)
        panel.text(
            nu,
            1.01,
            f"$p = {order}$\n{text}",
            transform=panel.get_xaxis_transform(),
            ha="center",
            fontsize=6,
            color="#333333",
        )
    panel.set_title(title, fontsize=9, pad=22)
    panel.set_ylabel(label, fontsize=9)
    panel.tick_params(labelsize=8)
    panel.grid(alpha=0.25, linewidth=0.5)
