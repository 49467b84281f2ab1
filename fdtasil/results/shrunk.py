"""Students of several sizes beside each other: which is the smallest that keeps enough."""

from dataclasses import dataclass

from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation, interval_text, score_text
from fdtasil.results.figures import draw_sizes

__all__ = ["Candidate", "Shrunk"]


@dataclass(frozen=True)
class Candidate:
    """A student of one size, as it was judged.

    Attributes:
        hidden: Widths of its hidden layers.
        activation: Between them.
        cloned: Whether it was cloned plainly, without probes.
        bytes: Of its float32 weights.
        multiply_adds: For one observation.
        microseconds: Of `predict`, for one observation.
        normalized_return: The expert's is 1; None where the expert's means nothing.
        ci95: 95 % interval of it, over paired episodes.
        survival: Share of its episodes that the environment did not end.
    """

    hidden: tuple[int, ...]
    activation: str
    cloned: bool
    bytes: int
    multiply_adds: int
    microseconds: float
    normalized_return: float | None
    ci95: tuple[float, float] | None
    survival: float

    @property
    def name(self) -> str:
        """Its widths and activation as a text."""
        return f"{'x'.join(map(str, self.hidden)) or 'linear'} {self.activation}"

    def keeps(self, share: float) -> bool:
        """Whether the lower end of its interval is at least a share of the expert's return."""
        return self.ci95 is not None and self.ci95[0] >= share


@dataclass(frozen=True, repr=False)
class Shrunk:
    """Students of several sizes.

    Attributes:
        keep: Share of the expert's return that was to be kept.
        candidates: All that were tried, with probes and cloned, the smallest first.
        result: The smallest with probes that keeps the share; None where none does.
        confirmed: The same student from other starts than it was chosen by, which flatter it a
            little; None with it.
    """

    keep: float
    candidates: tuple[Candidate, ...]
    result: Distilled | None
    confirmed: Evaluation | None = None

    @property
    def smallest(self) -> Candidate | None:
        """The smallest student with probes that keeps the share."""
        return self._smallest(cloned=False)

    @property
    def smallest_cloned(self) -> Candidate | None:
        """The smallest that keeps it without probes."""
        return self._smallest(cloned=True)

    def _smallest(self, *, cloned: bool) -> Candidate | None:
        kept = (one for one in self.candidates if one.cloned == cloned and one.keeps(self.keep))
        return next(kept, None)

    @property
    def judged(self) -> bool:
        """Whether any student has a share of the expert's return, and an interval of it."""
        return any(one.ci95 is not None for one in self.candidates)

    def draw(self) -> bytes:
        """Return a picture: return against bytes, with and without probes, as a PNG."""
        return draw_sizes(self.candidates, self.keep)

    def __repr__(self) -> str:
        head = (
            f"{'student':18}{'bytes':>10}{'us':>7}{'return':>9}  {'95 % interval':18}{'cloned':>8}"
        )
        lines = [head]
        cloned = {one.name: one for one in self.candidates if one.cloned}
        for one in self.candidates:
            if not one.cloned:
                beside = cloned.get(one.name)
                plain = "" if beside is None else score_text(beside.normalized_return)
                mark = " <" if one == self.smallest else ""
                lines.append(
                    f"{one.name:18}{one.bytes:10,}{one.microseconds:7.0f}"
                    f"{score_text(one.normalized_return):>9}  {interval_text(one.ci95):18}"
                    f"{plain:>8}{mark}"
                )
        found, plain = self.smallest, self.smallest_cloned
        if not self.judged:
            lines.append("a share of the expert's return means nothing here, so none is chosen")
        elif found is None:
            lines.append(f"no student of these keeps {self.keep:.0%} of the expert's return")
        else:
            size = f"{found.name}, {found.bytes:,} bytes"
            lines.append(f"the smallest that keeps {self.keep:.0%}: {size}")
        if self.judged and cloned:
            lines[-1] += f"; cloned plainly: {'none' if plain is None else plain.name}"
        if self.confirmed is not None:
            score = score_text(self.confirmed.normalized_return)
            lines.append(f"from other starts: {score} {interval_text(self.confirmed.ci95)}")
        return "\n".join(lines)
