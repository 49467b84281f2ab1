"""What float32 loses of observations in float64: nothing that matters, or an error."""

import numpy as np

from fdtasil.errors import EnvironmentFault, FdtasilError, SettingError, warn

__all__ = ["Narrowing"]

_LOST = 0.05  # of a coordinate's range, as the largest error of rounding
_STILL = 1e-9  # of a coordinate's size: what moves less is as good as constant


class Narrowing:
    """Compares observations with what is left of them in float32.

    Args:
        size: n, the length of an observation.
        name: Of the environment.
    """

    def __init__(self, size: int, name: str) -> None:
        self._name = name
        self._low, self._high = np.full(size, np.inf), np.full(size, -np.inf)
        self._lost = np.zeros(size)

    def see(self, wide: np.ndarray, narrow: np.ndarray) -> None:
        """Take note of (B, n) observations before and after."""
        np.minimum(self._low, wide.min(axis=0), out=self._low)
        np.maximum(self._high, wide.max(axis=0), out=self._high)
        np.maximum(self._lost, np.abs(wide - narrow).max(axis=0), out=self._lost)

    def judge(
        self,
        raised: type[FdtasilError] = EnvironmentFault,
        advice: str = "subtract a constant in gymnasium.wrappers.TransformObservation",
    ) -> None:
        """Warn of coordinates whose movement is rounded away.

        Args:
            raised: What is raised where that are all that move.
            advice: What to do.

        Raises:
            FdtasilError: If that are all that move.
        """
        found, whole = self._found()
        if found is None:
            return
        if not whole:
            warn(f"{found}: {advice}")
            return
        raise raised(
            found, "observations whose movement float32 can hold: experts are asked in it", advice
        )

    def judge_a_log(self) -> None:
        """Warn of the same coordinates of states that were recorded elsewhere.

        Raises:
            SettingError: If that are all that move.
        """
        self.judge(
            SettingError, "subtract a constant from the column, and where the student runs too"
        )

    def _found(self) -> tuple[str | None, bool]:
        """Return what is rounded away, in words, and whether nothing else moves."""
        if not np.isfinite(self._low).all():
            return None, False  # nothing was narrowed
        span = self._high - self._low
        moves = span > _STILL * np.maximum(np.abs(self._low), np.abs(self._high))
        rounded = np.flatnonzero(moves & (self._lost > _LOST * span))
        if not len(rounded):
            return None, False
        first = int(rounded[0])
        found = (
            f"{self._name}: float32 rounds away how {len(rounded)} of the {int(moves.sum())} "
            f"observations that move do so; number {first} moves by {span[first]:.2g} beside "
            f"values of {self._high[first]:.2g}"
        )
        return found, len(rounded) == int(moves.sum())
