"""Pictures of a run; matplotlib is loaded when one is drawn."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from fdtasil.probes.calibration import Calibration
from fdtasil.results.evaluation import Evaluation, interval_text, score_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "FIGURES",
    "draw_calibration",
    "draw_returns",
    "draw_sizes",
    "draw_training",
    "png_of",
]

_STUDENT, _EXPERT = "#1f77b4", "#444444"


def draw_training(history: Sequence[dict[str, float]]) -> bytes:
    """Draw the errors that a student was trained on against the training step, as a PNG."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    titles = {
        "action_error": "error of the actions",
        "moved_error": "at the moved states",
        "derivative_error": "of the whitened Jacobian",
    }
    # An older run knows no labels at moved states.
    drawn = [name for name in titles if any(entry.get(name, 0) > 0 for entry in history)]
    figure = _figure(7.0, 3.0)
    panels = figure.subplots(1, max(1, len(drawn)), squeeze=False)[0]
    steps = _cumulative_steps(history)
    for panel, name in zip(panels, drawn, strict=False):
        panel.plot(steps, [entry[name] for entry in history], color=_STUDENT, linewidth=1.4)
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.yaxis.set_major_formatter("{x:.2g}")
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        panel.set_title(titles[name], fontsize=9)
        panel.set_xlabel("training step")
        panel.grid(alpha=0.3, which="both", linewidth=0.5)
    panels[0].set_ylabel("mean norm")
    return png_of(figure)


def draw_sizes(candidates: Sequence[Any], keep: float) -> bytes:
    """Draw return against bytes of students of several sizes, as a PNG.

    Args:
        candidates: As `fdtasil.results.shrunk.Candidate`.
        keep: Share of the expert's return that is to be kept.
    """
    figure = _figure(6.0, 3.4)
    panel = figure.subplots()
    for cloned, name, colour, marker in (
        (True, "plain cloning", _EXPERT, "s"),
        (False, "with probes", _STUDENT, "o"),
    ):
        mine = [one for one in candidates if one.cloned == cloned and one.ci95 is not None]
        if mine:
            middle = [one.normalized_return for one in mine]
            ends = [(one.normalized_return, *one.ci95) for one in mine]
            bars = [[max(m - low, 0) for m, low, _ in ends], [max(h - m, 0) for m, _, h in ends]]
            places = [one.bytes for one in mine]
            about = {"color": colour, "marker": marker, "label": name, "capsize": 3}
            panel.errorbar(places, middle, bars, linewidth=1.2, markersize=5, **about)
    panel.axhline(1, color=_EXPERT, linewidth=0.8)
    panel.axhline(keep, color=_EXPERT, linewidth=0.8, linestyle=":")
    panel.set(xscale="log", xlabel="bytes of weights (float32)", ylabel="normalised return")
    low = min((one.ci95[0] for one in candidates if one.ci95 is not None), default=0.0)
    panel.set_ylim(max(low, -0.2) - 0.05, None)
    panel.grid(alpha=0.3, which="both", linewidth=0.5)
    if any(one.ci95 is not None for one in candidates):
        panel.legend(frameon=False, fontsize=8)
    return png_of(figure)


def draw_returns(evaluation: Evaluation) -> bytes:
    """Draw each episode's return of the student against the expert's, as a PNG."""
    from matplotlib.ticker import MaxNLocator

    figure = _figure(7.0, 3.2)
    panel = figure.subplots()
    order = sorted(range(evaluation.episodes), key=lambda e: evaluation.expert_returns[e])
    ranks = range(1, evaluation.episodes + 1)
    for rank, episode in zip(ranks, order, strict=True):
        ends = evaluation.expert_returns[episode], evaluation.student_returns[episode]
        panel.plot([rank, rank], ends, color="#bbbbbb", linewidth=1, zorder=1)
    expert = [evaluation.expert_returns[e] for e in order]
    student = [evaluation.student_returns[e] for e in order]
    panel.scatter(ranks, expert, marker="s", s=22, color=_EXPERT, label="expert", zorder=2)
    panel.scatter(ranks, student, marker="o", s=26, color=_STUDENT, label="student", zorder=3)
    panel.set_title(
        f"normalised return {score_text(evaluation.normalized_return)}, "
        f"95 % {interval_text(evaluation.ci95)}, "
        f"survival {evaluation.survival:.2f}",
        fontsize=9,
    )
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.set_xlabel("evaluation episode, in the order of the expert's return")
    panel.set_ylabel(f"return over {evaluation.horizon} steps")
    if min(*expert, *student) > 0:
        panel.set_ylim(0, 1.08 * max(*expert, *student))  # whole marks, where all are equal
    panel.grid(alpha=0.3, axis="y", linewidth=0.5)
    # Outside: between the axes its marks would read as two episodes.
    panel.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return png_of(figure)


def draw_calibration(found: Calibration) -> bytes:
    """Draw how the expert's answers change with the distance of a probe, as a PNG."""
    figure = _figure(7.0, 3.0)
    change, agreement = figure.subplots(1, 2)
    change.plot(found.radii, found.change, color=_STUDENT, marker="o", markersize=3)
    change.axhline(found.noise_floor, color=_EXPERT, linestyle=":", label="noise floor")
    if max(*found.change, found.noise_floor) > 0:  # an expert that answers everywhere the same
        change.set_yscale("log")
    change.set_title("change of an action in its unit", fontsize=9)
    change.set_ylabel("root mean square")
    agreement.plot(found.radii[1:], found.similarity[1:], color=_STUDENT, marker="o", markersize=3)
    agreement.set_ylim(-0.05, 1.05)
    agreement.set_title("agreement of differences at r and r / 4", fontsize=9)
    agreement.set_ylabel("secant similarity")
    for panel in (change, agreement):
        name = f"radius {found.radius:.2g}, {found.stencil} ({found.regime})"
        panel.axvline(found.radius, color="#999999", linestyle="--", label=name)
        panel.set_xscale("log")
        panel.set_xlabel("radius, standard deviations", fontsize=9)
        panel.grid(alpha=0.3, linewidth=0.5)
    change.legend(frameon=False, fontsize=7)
    return png_of(figure)


def _cumulative_steps(history: Sequence[dict[str, float]]) -> list[float]:
    """Return the steps counted on over the rounds, each of which counts from zero."""
    steps, base = [], 0.0
    before: Mapping[str, float] = {}
    for entry in history:
        if entry["round"] != before.get("round", entry["round"]):
            base += before["step"]
        steps.append(base + entry["step"])
        before = entry
    return steps


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def png_of(figure: "Figure", dpi: int = 150) -> bytes:
    """Return a figure as a PNG that does not name the version that drew it."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=dpi, metadata={"Software": None})
    return target.getvalue()


class Drawn(Protocol):
    """What pictures are drawn of: a `Distilled`."""

    history: list[dict[str, float]]
    evaluation: Evaluation | None
    report: dict[str, Any]


def _training(result: Drawn) -> bytes:
    return draw_training(result.history)


def _returns(result: Drawn) -> bytes | None:
    return None if result.evaluation is None else draw_returns(result.evaluation)


def _calibration(result: Drawn) -> bytes | None:
    found: Mapping[str, Any] | None = result.report["calibration"]
    return None if found is None else draw_calibration(Calibration.from_json(found))


FIGURES: dict[str, Callable[[Any], bytes | None]] = {
    "training": _training,
    "returns": _returns,
    "calibration": _calibration,
}
"""The pictures of a run's folder, by name: a `Drawn` -> a PNG, or None where it has no such."""
