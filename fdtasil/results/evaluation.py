"""What a paired evaluation found, and how it is told."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from fdtasil.files.plain import from_plain, to_plain

__all__ = [
    "Evaluation",
    "evaluation_rows",
    "interval_text",
    "missing_text",
    "rows_html",
    "score_text",
]


@dataclass(frozen=True)
class Evaluation:
    """How a student did beside its expert, from the same starts.

    Attributes:
        episodes: E, number of paired episodes.
        horizon: T, steps after which an episode was cut.
        expert_return: Mean undiscounted return of the expert.
        student_return: Mean undiscounted return of the student.
        reference_return: What counts as zero: 0 where the expert's median return is positive,
            else the mean return of uniformly random actions.
        normalized_return: (student - reference) / (expert - reference); 1 is the expert. None
            where the expert is no better than the reference, and the share means nothing.
        ci95: 95 % bootstrap interval of the normalised return, over paired episodes; None with it,
            for a single pair, or where the expert's returns are not surely above the reference.
            Of fewer than ten pairs it is too narrow.
        survival: Share of the student's episodes that neither the environment ended, nor a policy
            that had no answer for too long.
        expert_survival: The same for the expert.
        action_error: Mean Euclidean distance of the student's action to the expert's, as the
            environment takes both, on the student's own states, in action units.
        imitation_gap: Largest distance between the two trajectories of a pair while both last,
            in the expert's standard deviations (root mean square over coordinates), averaged over
            pairs (TaSIL, section 2). Chaotic systems drift apart whatever the student does.
        expert_returns: (E,) return of each episode.
        student_returns: (E,) return of each episode, in the same order.
        expert_physics_resets: Episodes of the expert in which the simulator put itself back.
        physics_resets: The same for the student; where they are more than half, the returns mean
            nothing and there is no normalised one.
        violations: Of each constraint its name, and the share of the steps at which the expert
            and the student violated it.
        agreement: Where actions are choices, the share of the student's own states at which it
            chooses as the expert does; else None.
        roughness: How much the student's actions change from step to step; see `Smoothness`.
        expert_roughness: The same for the expert.
        high_frequency: Share of the power of the student's actions that is fast.
        expert_high_frequency: The same for the expert.
        given_up: Episodes of the student that were ended, for it had no answer for too long.
        expert_given_up: The same for the expert: its returns are of shorter episodes then.
    """

    episodes: int
    horizon: int
    expert_return: float
    student_return: float
    reference_return: float
    normalized_return: float | None
    ci95: tuple[float, float] | None
    survival: float
    expert_survival: float
    action_error: float
    imitation_gap: float
    expert_returns: tuple[float, ...]
    student_returns: tuple[float, ...]
    expert_physics_resets: int = 0
    physics_resets: int = 0
    violations: tuple[tuple[str, float, float], ...] = ()
    agreement: float | None = None
    roughness: float | None = None
    expert_roughness: float | None = None
    high_frequency: float | None = None
    expert_high_frequency: float | None = None
    given_up: int = 0
    expert_given_up: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return the evaluation as numbers, texts and lists; `action_error` may be NaN."""
        return to_plain(self)

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> "Evaluation":
        """Read what `to_json` returned."""
        return from_plain(cls, fields)

    def interval_in_words(self) -> str:
        """Return the interval of the normalised return in words, or why there is none."""
        if self.ci95 is not None:
            return interval_text(self.ci95)
        return f"n/a: {self._missing()}"

    def _missing(self) -> str:
        if 2 * self.physics_resets > self.episodes:
            return "the simulator put itself back in most episodes"
        zero = "random actions" if self.reference_return else "a return of 0"
        if self.normalized_return is None:
            return f"the expert is no better than {zero}"
        if self.episodes < 2:
            return "of a single pair"
        return f"the expert is not surely better than {zero}"

    def _repr_html_(self) -> str:
        return rows_html(evaluation_rows(self))

    def __str__(self) -> str:
        expert = f"{self.expert_return:10.1f}   survival {self.expert_survival:.2f}"
        student = f"{self.student_return:10.1f}   survival {self.survival:.2f}"
        share = f"{score_text(self.normalized_return):>10}   95 % {self.interval_in_words()}"
        kept = "".join(
            f"\n  {name:17} violated at {theirs:.2%} of the expert's steps, {ours:.2%} of the "
            "student's"
            for name, theirs, ours in self.violations
        )
        agrees = self.agreement
        same = "" if agrees is None else f"\n  agreement         {agrees:10.3f}   of its choices"
        return (
            f"{self.episodes} paired episodes of {self.horizon} steps\n"
            f"  expert            {expert}\n"
            f"  student           {student}\n"
            f"  normalised return {share}\n"
            f"  action error      {self.action_error:10.3f}   on the student's own states"
            f"{same}{self._rough()}{kept}{self._cut()}"
        )

    def _cut(self) -> str:
        cut = (("expert", self.expert_given_up), ("student", self.given_up))
        return "".join(
            f"\n  cut short         {count:10}   episodes, for the {who} had no answer for long"
            for who, count in cut
            if count
        )

    def _rough(self) -> str:
        if self.roughness is None or self.expert_roughness is None:
            return ""
        told = f"{self.roughness:10.3f}   expert {self.expert_roughness:.3f}, change in a step"
        return f"\n  roughness         {told}"


def rows_html(rows: Sequence[tuple[str, str]]) -> str:
    """Return names and texts as a table of HTML."""
    apart = 'style="padding-right: 1em"'
    lines = "".join(
        f"<tr><td {apart}>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows
    )
    return f"<table>{lines}</table>"


def evaluation_rows(found: Evaluation) -> list[tuple[str, str]]:
    """Return an evaluation as names and texts."""
    rows = [
        (
            "normalised return",
            f"{score_text(found.normalized_return)} {found.interval_in_words()}",
        ),
        ("return", f"{found.student_return:,.1f}, the expert's {found.expert_return:,.1f}"),
        ("survival", f"{found.survival:.2f}, the expert's {found.expert_survival:.2f}"),
        ("episodes", f"{found.episodes} from equal starts, of {found.horizon} steps"),
        ("action error", f"{found.action_error:.3g} on the student's own states"),
    ]
    if found.agreement is not None:
        rows.append(("agreement", f"{found.agreement:.3f} of its choices"))
    if found.roughness is not None and found.expert_roughness is not None:
        told = f"{found.roughness:.3g}, the expert's {found.expert_roughness:.3g}"
        rows.append(("change of an action in a step", told))
    for who, cut in (("expert", found.expert_given_up), ("student", found.given_up)):
        if cut:
            rows.append(("cut short", f"{cut} episodes, for the {who} had no answer for long"))
    for name, theirs, ours in found.violations:
        rows.append((f"{name} violated", f"{ours:.2%} of the steps, the expert {theirs:.2%}"))
    return rows


def missing_text(settings: Mapping[str, Any]) -> str:
    """Return why a run with these settings has no evaluation."""
    if settings.get("expert") is None:
        return "not evaluated: there was no expert to compare it with"
    if not settings.get("horizon"):
        return "not evaluated: there was no environment to act in"
    return "not evaluated: no episodes were asked for"


def score_text(share: float | None) -> str:
    """Return a normalised return for a table."""
    return "n/a" if share is None else f"{share:.3f}"


def interval_text(interval: tuple[float, float] | None) -> str:
    """Return an interval for a table."""
    return "n/a" if interval is None else f"[{interval[0]:.3f}, {interval[1]:.3f}]"
