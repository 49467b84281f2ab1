"""How far to probe: what an expert's answers look like at many distances, asked once."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fdtasil.demonstrations import Statistics
from fdtasil.experts import Expert
from fdtasil.presets import PRESETS

__all__ = ["Calibration", "calibrate"]

_RAYS = 48
_RADII = 4.0 ** np.arange(-9, 1)  # standard deviations of each coordinate
# Differences at a radius and at a quarter of it point the same way where a derivative exists:
# smooth experts reach 0.85 and more somewhere, trees and quantised networks stay below 0.5.
_COHERENT = 0.75


@dataclass(frozen=True)
class Calibration:
    """What the ladder of radii says of an expert.

    Attributes:
        regime: "smooth", "noisy" (a derivative exists above a noise that differences at small
            radii show), or "steps" (no radius has one).
        noise_floor: Root mean square error of an action, from second differences at the smallest
            radius, where nothing but rounding and noise is left of them.
        radius: Suggested, in standard deviations of each coordinate.
        stencil: Suggested, "forward" or "central".
        similarity: (10,) secant similarity at each radius and a quarter of it; the first is NaN.
        radii: (10,) the radii.
        queries: Rows asked.
    """

    regime: Literal["smooth", "noisy", "steps"]
    noise_floor: float
    radius: float
    stencil: str
    similarity: np.ndarray
    radii: np.ndarray
    queries: int


def calibrate(
    expert: Expert, observations: np.ndarray, scales: Statistics, random: np.random.Generator
) -> Calibration:
    """Ask an expert at ten radii on both sides of some states, about 1,000 rows in all.

    Args:
        expert: The expert.
        observations: (N, n) states of the environment.
        scales: Of these states.
        random: Draws states and directions.
    """
    rows = random.choice(len(observations), size=_RAYS, replace=len(observations) < _RAYS)
    scale = np.where(scales.live, scales.deviation, 0.0)
    normal = random.standard_normal((_RAYS, len(scale))) * scales.live
    live = max(1, int(scales.live.sum()))
    rays = scale * normal / np.linalg.norm(normal, axis=1, keepdims=True) * live**0.5
    signs = np.array([1.0, -1.0])[None, None, :, None]
    moved = rays[:, None, None, :] * _RADII[None, :, None, None] * signs
    points = (observations[rows][:, None, None, :] + moved).astype(np.float32)
    centres = expert.ask(observations[rows], "check").astype(np.float64)
    answers = expert.ask(points.reshape(-1, len(scale)), "check")
    values = answers.reshape(_RAYS, len(_RADII), 2, -1).astype(np.float64)
    secants = (values[:, :, 0] - values[:, :, 1]) / (2 * _RADII[None, :, None])
    similarity = np.append(np.nan, _similarity(secants[:, 1:], secants[:, :-1]))
    second = values[:, 0, 0] + values[:, 0, 1] - 2 * centres
    floor = float(np.sqrt((second**2).mean() / 6))
    regime, radius = _judge(similarity)
    stencil = "central" if regime != "smooth" else "forward"
    return Calibration(regime, floor, radius, stencil, similarity, _RADII, len(answers) + _RAYS)


def _similarity(wide: np.ndarray, narrow: np.ndarray) -> np.ndarray:
    """Return the mean over rays of 2 <a, b> / (|a|^2 + |b|^2), one number for each radius."""
    both = (wide**2).sum(axis=-1) + (narrow**2).sum(axis=-1)
    product = 2 * (wide * narrow).sum(axis=-1)
    return np.where(both > 0, product / np.where(both > 0, both, 1), 0.0).mean(axis=0)


def _judge(similarity: np.ndarray) -> tuple[Literal["smooth", "noisy", "steps"], float]:
    usual = PRESETS["standard"].radius
    coherent = np.flatnonzero(similarity >= _COHERENT)
    if not len(coherent) or _RADII[coherent[-1]] < 1e-3:
        return "steps", max(usual, 0.3)
    low, high = _RADII[coherent[0]], _RADII[coherent[-1]]
    # The kinks of a ReLU network end the band before the distance that teaches best, so only
    # its lower end, where the noise is, moves the radius.
    regime = "noisy" if low > 4.0**-6 else "smooth"
    return regime, float(max(usual, low)) if high < usual else float(np.clip(usual, low, high))
