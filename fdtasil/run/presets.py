"""The defaults of a derivative source and of the optimisation; a preset is a named set of them."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from fdtasil.checks import check_choice
from fdtasil.probes.adaptive import AdaptiveDirections
from fdtasil.probes.calibration import WIDE
from fdtasil.probes.directions import RandomSphere
from fdtasil.probes.source import Probes
from fdtasil.student.fit import Fit

__all__ = ["PRESETS", "Preset", "preset_of"]


@dataclass(frozen=True)
class Preset:
    """The defaults that a call leaves open.

    Attributes:
        radius: Of the probes; see `Probes`. Where calibrated, what teaches best if the expert
            allows it.
        calibrated: Whether the expert is asked at many radii before radius and stencil are set,
            and the directions may look at the states.
        space: Of the probes.
        per_step: Of the probes.
        fit: The optimisation.
    """

    radius: float
    calibrated: bool
    space: Literal["whitened", "raw"]
    per_step: int | Literal["all"]
    fit: Fit

    def complete(self, probes: Probes | None) -> Probes | None:
        """Fill in what a derivative source leaves open, but for what a calibration finds."""
        if probes is None:
            return None
        probes = replace(probes, space=probes.space or self.space)
        if isinstance(probes.directions, AdaptiveDirections) and not self.calibrated:
            probes = replace(probes, directions=RandomSphere(probes.directions.probes))
        radius = probes.radius
        if not self.calibrates(probes):
            radius = {None: self.radius, "wide": WIDE}.get(radius, radius)
        return replace(
            probes,
            radius=radius,
            per_step=self.per_step if probes.per_step is None else probes.per_step,
        )

    def calibrates(self, probes: Probes) -> bool:
        """Return whether what the source leaves open is found by asking the expert."""
        return self.calibrated and not probes.exact and probes.space == "whitened"

    def fit_with(self, **given: Any) -> Fit:
        """Return the optimisation with the fields of `Fit` that are given (not None) put in."""
        changes = {name: value for name, value in given.items() if value is not None}
        # Steps and epochs are two ways to say one thing: saying one unsays the other.
        if "steps" in changes or "epochs" in changes:
            changes = {"steps": None, "epochs": None, **changes}
        return replace(self.fit, **changes)


PRESETS = {
    "standard": Preset(radius=0.3, calibrated=True, space="whitened", per_step=1, fit=Fit()),
    # TaSIL, appendices on experiments and finite differences. The weight multiplies the norm of
    # the whole Jacobian's error there; `gain` makes it mean that for any number of probes here.
    "paper": Preset(
        radius=0.01,
        calibrated=False,
        space="raw",
        per_step="all",
        fit=Fit(epochs=4500, learning_rate=1e-3, epsilon=1e-4, weight=0.01, curvature_weight=0.01),
    ),
}


def preset_of(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        SettingError: If there is none.
    """
    return PRESETS[check_choice("preset", name, PRESETS)]
