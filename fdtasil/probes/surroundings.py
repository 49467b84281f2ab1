"""Where a source probes around demonstrated states, and how far."""

from dataclasses import dataclass

import numpy as np

from fdtasil.errors import SettingError, warn
from fdtasil.probes.directions import Draw
from fdtasil.probes.scales import Scales
from fdtasil.probes.source import Probes, radius_text

__all__ = ["Drawn", "Surroundings"]

# States that a design is shown: enough to tell which displacements can occur.
_SHOWN = 4096
# States of one sample share this many sets of directions where the next sample has others: drawing
# them would take as long as the training.
_SETS = 128
_ALONE = 0.25  # share of the directions that move what was told of alone, and as many the others
_ROUNDED = 0.1  # share of a step that rounding may take before it is warned of


@dataclass(frozen=True)
class Drawn:
    """Where a sample probes.

    Attributes:
        displacements: (P, n) float32 bank of displacements in raw observation units.
        numbers: (N, k) int32, the rows of the bank that each state is probed along.
        gains: (P,) see `Answers`.
    """

    displacements: np.ndarray
    numbers: np.ndarray
    gains: np.ndarray


@dataclass(frozen=True)
class Surroundings:
    """What all samples of a source around some states have in common.

    Attributes:
        observations: (N, n) float32 states.
        probes: The derivative source, with radius, space and stencil set.
        live: (d,) the coordinates that are moved.
        told: (d,) bool, those of them that somebody said how far will go.
        units: (d,) what a direction's components are multiplied by.
        step: Length of a direction's step in deviations, over all coordinates.
        ends: The nearest and the farthest that it is stretched to.
        draw: Draws directions in these coordinates.
        scales: Of the demonstrations; what the student does not see may follow what it sees.
        actions: (N, m) float32 what the expert said at the states; None where that is not known.
    """

    observations: np.ndarray
    probes: Probes
    live: np.ndarray
    told: np.ndarray
    units: np.ndarray
    step: float
    ends: tuple[float, float]
    draw: Draw
    scales: Scales
    actions: np.ndarray | None = None

    @classmethod
    def of(
        cls, observations: np.ndarray, probes: Probes, scales: Scales, *, again: bool = False
    ) -> "Surroundings":
        """Return the surroundings of (N, n) states.

        Args:
            observations: The states.
            probes: The derivative source, with radius, space and stencil set.
            scales: Of the demonstrations.
            again: Whether they were looked at before, and what there is to warn of was said.

        Raises:
            SettingError: If no coordinate moves, or a step is beyond float32.
        """
        live = np.flatnonzero(scales.probed(probes.space))
        raw, usual = probes.space == "raw", probes.directions.reach(len(live))
        deviation = np.ones(len(live)) if raw else scales.deviation[live]
        ends = (1.0, 1.0) if probes.exact else probes.reaches
        step = 1.0 if raw or probes.exact else usual
        if not again:
            _check_steps(step / usual * ends[0] * deviation, observations[:, live], probes, live)
        _check_ends(step * ends[1] * deviation, observations[:, live], probes)
        # Of one distance: states lie apart in its units. Of many: in units of one deviation.
        if ends[0] == ends[1]:
            step, ends = step * ends[0], (1.0, 1.0)
        units = step * deviation
        shown = np.linspace(0, len(observations) - 1, min(len(observations), _SHOWN)).astype(int)
        draw = probes.directions.around(observations[shown][:, live] / units)
        told = scales.told[live]
        return cls(observations, probes, live, told, units, step, ends, draw, scales)

    @property
    def count(self) -> int:
        """k, how many directions each state is probed along."""
        return self.probes.directions.count(len(self.live))

    def sample(self, random: np.random.Generator) -> Drawn:
        """Draw directions, and how far each of them leads."""
        states = len(self.observations)
        sets = min(states, _SETS) if self.probes.resample else states
        bank, numbers = self.draw(sets, random)
        if sets < states:
            numbers = numbers[random.integers(sets, size=states)]
        bank = bank.astype(np.float32, copy=False)
        stretch = np.ones((len(bank), 1))
        if self.ends[0] != self.ends[1]:
            near, far = np.log(self.ends)
            stretch = np.exp(random.uniform(near, far, stretch.shape))
        apart = np.zeros(len(bank), bool)
        if self.told.any() and not self.probes.exact and self.probes.directions.reach(2) > 1:
            apart = self._take_apart(bank, random)
        displacements = np.zeros((len(bank), self.observations.shape[1]), np.float32)
        displacements[:, self.live] = (
            stretch.astype(np.float32) * bank * self.units.astype(np.float32)
        )
        displacements = self.scales.with_following(displacements)
        gains = len(self.live) ** 0.5 / (self.step * stretch[:, 0])
        # Half of the directions tell of the whole Jacobian, a quarter each of its two parts:
        # weighed so, these are the whole again.
        gains[apart] *= 2**0.5
        return Drawn(displacements, numbers, gains)

    def _take_apart(self, bank: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Let a quarter of (P, d) directions move only what was told of, and a quarter not.

        Returns:
            (P,) bool, which move a part of the coordinates.
        """
        lot, normal = random.random(len(bank)), random.standard_normal(bank.shape, np.float32)
        alone, rest = lot < _ALONE, (lot >= _ALONE) & (lot < 2 * _ALONE)
        # Drawn anew: directions between demonstrated states leave still what is still in them.
        bank[alone] = _kept(normal[alone], self.told)
        if self.told.all():
            return np.zeros(len(bank), bool)
        bank[rest] = _kept(bank[rest], ~self.told)
        return alone | rest


def _kept(directions: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return (P, d) directions along some coordinates, as long as isotropic ones are there."""
    left = np.where(moved, directions, 0)
    lengths = np.linalg.norm(left, axis=1, keepdims=True)
    return left * (moved.mean() ** 0.5 / np.where(lengths > 0, lengths, 1))


def _check_ends(sizes: np.ndarray, values: np.ndarray, probes: Probes) -> None:
    """Refuse steps that float32 can't hold beside the states."""
    with np.errstate(over="ignore"):  # looked at in the next line
        widest = np.float32(sizes.max()) + np.abs(values).max()
    if not np.isfinite(widest) or not np.float32(sizes).any():
        assert probes.radius is not None, "the preset sets the radius"
        raise SettingError(
            f"radius={radius_text(probes.radius)} moves a state by up to {sizes.max():g}",
            "steps that float32 can add to the observations",
            "leave radius= out, or write for example radius=0.3",
        )


def _check_steps(sizes: np.ndarray, values: np.ndarray, probes: Probes, live: np.ndarray) -> None:
    """Warn of steps that rounding changes."""
    if probes.exact:
        return
    lengths = np.sqrt((values.astype(np.float64) ** 2).mean(axis=0)).astype(np.float32)
    errors = np.spacing(lengths) / 12**0.5  # root mean square, of rounding to the nearest
    shares = np.divide(errors, sizes, out=np.full(len(sizes), np.inf), where=sizes > 0)
    worst = int(shares.argmax())
    if shares[worst] > _ROUNDED:
        warn(
            f"float32 rounds away {min(1.0, shares[worst]):.0%} of the step along coordinate "
            f"{live[worst]}, of {sizes[worst]:.2g} beside values of {lengths[worst]:.2g}: raise "
            "the radius, or probe in whitened space"
        )
