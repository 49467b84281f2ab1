"""What an expert is in an environment, before anything is learnt from it."""

import html
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdtasil.errors import FdtasilError, printable
from fdtasil.experts.gate import Finding
from fdtasil.files.plain import to_plain, without_infinities
from fdtasil.probes.calibration import Calibration

__all__ = ["Inspection"]

_CHANCE = "  (no worse than the expert: does it belong to this environment and version?)"


@dataclass(frozen=True)
class Inspection:
    """What an expert is: its contract with an environment, its noise, and what it reaches.

    Attributes:
        expert: Its path, address or name.
        sha256: Of its file, or None.
        environment: What the environment is called.
        observations: Numbers of an observation.
        memory: Numbers that it remembers, 0 for an expert without a memory.
        actions: Actions of the environment with their bounds, in words.
        differentiable: Whether a torch twin agrees with it, so that it has an analytic Jacobian.
        findings: One for each check of the gate.
        returns: Of its episodes; empty where it can't be asked.
        chance: Mean return of random actions from the same starts; None where it can't be asked.
        ended_early: Episodes that ended by the environment's rule.
        horizon: Steps of an episode at most.
        calibration: What the ladder of radii says; None where it can't be asked.
    """

    expert: str
    sha256: str | None
    environment: str
    observations: int
    memory: int
    actions: str
    differentiable: bool
    findings: tuple[Finding, ...]
    returns: tuple[float, ...]
    chance: float | None
    ended_early: int
    horizon: int
    calibration: Calibration | None

    @property
    def problem(self) -> FdtasilError | None:
        """The error of the first check that failed; None where it can be distilled."""
        return next((one.problem for one in self.findings if one.problem), None)

    def to_json(self) -> dict[str, Any]:
        """Return the inspection as plain JSON values; a problem is its text."""
        findings = [
            {"name": one.name, "measured": one.measured, "problem": _text(one.problem)}
            for one in self.findings
        ]
        calibration = self.calibration.to_json() if self.calibration else None
        whole = {**to_plain(self), "findings": findings, "calibration": calibration}
        return without_infinities(whole)[0]

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"

    def __str__(self) -> str:
        rows = [("expert", self.expert), ("environment", self.environment)]
        rows += [*self._contract(), *self._ladder(), *self._returns()]
        return "\n".join(printable(f"{name:20}{value}") for name, value in rows)

    def _contract(self) -> list[tuple[str, str]]:
        memory = f", and {self.memory} of memory" if self.memory else ""
        opened = all(one.name != "opening" or not one.problem for one in self.findings)
        rows = [("sha256", self.sha256)] if self.sha256 else []
        rows += [("observations", f"{self.observations}{memory}"), ("actions", self.actions)]
        if opened:
            has = "a torch twin agrees with it" if self.differentiable else "not available"
            rows.append(("analytic", has))
        return rows + [
            (one.name, f"{'FAILED: ' if one.problem else ''}{one.measured}")
            for one in self.findings
            if one.name != "opening" or one.problem
        ]

    def _ladder(self) -> list[tuple[str, str]]:
        found = self.calibration
        if found is None:
            return []
        noise = f"{found.noise_floor:.1e} of an action's unit, root mean square"
        return [
            ("regime", found.regime),
            ("noise floor", noise),
            ("suggested radius", f"{found.radius:.2g} deviations, {found.stencil} stencil"),
            ("what is matched", found.match or "differences"),
        ]

    def _returns(self) -> list[tuple[str, str]]:
        if self.chance is None:
            return []
        count = len(self.returns)
        mean, deviation = float(np.mean(self.returns)), float(np.std(self.returns))
        doubt = _CHANCE if mean <= self.chance else ""
        return [
            ("return", f"{mean:.1f} +- {deviation:.1f} over {count} episodes"),
            ("random actions", f"{self.chance:.1f}{doubt}"),
            ("ended early", f"{self.ended_early} of {count}, of at most {self.horizon} steps"),
        ]


def _text(problem: FdtasilError | None) -> str | None:
    return None if problem is None else str(problem)
