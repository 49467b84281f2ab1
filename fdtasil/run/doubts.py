"""What demonstrations lack, said before a student is trained on them."""

from collections.abc import Mapping

import numpy as np

from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import warn
from fdtasil.probes.scales import ROUNDING, Scales
from fdtasil.probes.source import Probes
from fdtasil.probes.spread import stands_still
from fdtasil.rollouts.behaviours import Policy
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.survivors import SURVIVORS
from fdtasil.run.lesson import Lesson
from fdtasil.student.fit import Fit

__all__ = [
    "warn_of_falls",
    "warn_of_idle_weights",
    "warn_of_misfit",
    "warn_of_narrow_spread",
    "warn_of_one_state",
    "warn_of_rounded_movement",
    "warn_of_silence",
    "warn_of_small_units",
    "warn_of_still_coordinates",
    "warn_of_whole_numbers",
]

_FEW = 5  # demonstrations, of which each counts
_USUALLY = 0.75  # share of the expert's episodes that it survives
_MISFIT = 0.15  # share of the actions' deviation; students of the experts here reach 0.01
_RAISED = "; each row of a batch that raises is asked again, alone: a row of NaN costs no query"
_CHOICES = 20  # values that a mode has at most
_SELDOM = 0.05  # of the states: what is met in fewer is an exception
_NARROW = 0.5  # of a coordinate's own deviation
_SHOWN = 8  # coordinates named in a warning
_CLEARLY = 4  # of float32's steps, that rounding does not move a coordinate by
_SMALL = 1e-4  # of the median deviation; robots' observations differ by less


def warn_of_falls(states: Demonstrations, expert: Episodes, keep: str) -> None:
    """Warn of a demonstration that ended early, where the expert usually lasts.

    Args:
        states: Of the expert's demonstrations.
        expert: (E, T) its own episodes, from other starts.
        keep: Which demonstrations are kept.
    """
    lasts, horizon = 1 - float(expert.terminated.mean()), expert.valid.shape[1]
    episodes, lengths = np.unique(states.episode, return_counts=True)
    fallen = lengths[np.isin(episodes, states.episode[states.terminated]) & (lengths < horizon)]
    if len(fallen) and len(episodes) <= _FEW and lasts >= _USUALLY and keep != SURVIVORS:
        warn(
            f"{len(fallen)} of {len(episodes)} demonstrations ended early, after "
            f"{', '.join(map(str, fallen))} of {horizon} steps, and the expert lasts in "
            f'{lasts:.0%} of its episodes: keep="survivors" records others in their place'
        )


def warn_of_idle_weights(
    given: Fit, usual: Fit, source: Probes | None, *, calibrated: bool
) -> None:
    """Warn of weights that somebody sets, and that nothing is multiplied by.

    Args:
        given: The optimisation.
        usual: That of the preset; what is another there, somebody has set.
        source: The derivative source. None, plain cloning, has no use for any weight, and is
            compared with others that have.
        calibrated: Whether a calibration may still decide what is matched.
    """
    if source is None:
        return
    weights, is_open = given.weights(source.match), source.match is None and calibrated
    used = {
        "weight": weights.derivative is not None,
        "moved_weight": weights.moved is not None or is_open,
    }
    matched = "answers as labels" if source.match == "labels" else "differences"
    for name, does in used.items():
        value = getattr(given, name)
        if not does and value != getattr(usual, name):
            warn(f"{name}={value:g} weighs nothing: {source.describe()!r} matches {matched}")
    curvature, unsaid = given.curvature_weight, (usual.curvature_weight, Fit().curvature_weight)
    if given.order == 1 and curvature not in unsaid:
        warn(f"curvature_weight={curvature:g} weighs nothing without order=2")


def warn_of_silence(shares: Mapping[str, float], reason: str, given_up: int) -> None:
    """Warn of states where the expert had no answer.

    Args:
        shares: By purpose, of the rows asked, where some had none.
        reason: What it said instead, the last time.
        given_up: Episodes that ended for it.
    """
    if not shares:
        return
    where = ", ".join(f"{name} {share:.2g}" for name, share in shares.items())
    ended = f"; {given_up} episode{'s' * (given_up > 1)} ended for it" if given_up else ""
    warn(
        f"the expert had no answer to some rows (shares: {where}), which are left out{ended}; the "
        f"last time it said {reason}" + ("" if reason == "NaN" else _RAISED)
    )


def warn_of_misfit(lesson: Lesson, student: Policy, steps: int, *, remembers: bool) -> None:
    """Warn of a student that does not even repeat what it was shown.

    Args:
        lesson: What was learnt from.
        student: Who learnt it.
        steps: How long it was trained, as the library chose it.
        remembers: Whether the expert has a memory.
    """
    states = lesson.dataset.demonstrations
    said, own = states.actions, student(states.observations)
    deviation = float(np.linalg.norm(said - said.mean(axis=0), axis=1).mean())
    error = float(np.linalg.norm(own - said, axis=1).mean())
    if deviation > 0 and error > _MISFIT * deviation:
        cause = "it does not see the expert's memory" if remembers else "it may see too little"
        warn(
            f"at the demonstrated states the student's actions are off by {error / deviation:.0%} "
            f"of what the expert's vary by: {cause}, or want more than {steps:,} steps "
            f"(fit=fdtasil.Fit(steps={2 * steps}))"
        )


def warn_of_one_state(states: Demonstrations) -> None:
    """Warn of demonstrations that are one observation again and again, such as a dead sensor's."""
    if len(states) > 1 and (states.observations == states.observations[0]).all():
        warn(
            f"all {len(states):,} observations are the same: a student can learn one answer from "
            "them, and nothing of how it changes; look at where they come from"
        )


def warn_of_small_units(scales: Scales) -> None:
    """Warn of coordinates that move so little that they may be still, or in other units.

    Args:
        scales: Of all states.
    """
    looked_at = scales.live & scales.seen
    small = scales.deviation < _SMALL * np.median(scales.deviation[scales.live])
    found = np.flatnonzero(looked_at & small & ~scales.told)
    if len(found):
        told, more = _listed(found, scales.deviation)
        warn(
            f"{len(found)} coordinates deviate by less than a ten-thousandth of what others do "
            f"({told}{more}): that is taken for their units; of one that only stands nearly still "
            "here, spread={coordinate: deviation} says how far it will go"
        )


def warn_of_narrow_spread(told: Mapping[int, float], scales: Scales) -> None:
    """Warn of coordinates that go farther in the demonstrations than somebody said they will.

    Args:
        told: Deviations by coordinate.
        scales: Of all states.
    """
    found = [i for i, said in told.items() if said < _NARROW * scales.deviation[i]]
    if found:
        first = found[0]
        warn(
            f"spread={{{first}: {told[first]:g}}} is less than what the coordinate shows in the "
            f"demonstrations, a deviation of {scales.deviation[first]:.2g}, which is taken: is it "
            "the right one?"
        )


def warn_of_rounded_movement(lesson: Lesson) -> None:
    """Warn of coordinates that move by few of the steps that float32 has beside their offset.

    They count as still, are neither normalised nor probed, and are no constants.
    """
    sizes = np.abs(lesson.dataset.demonstrations.observations).max(axis=0)
    still, deviations = lesson.scales.seen & ~lesson.scales.live, lesson.scales.deviation
    offset = (_CLEARLY * np.spacing(sizes) < deviations) & (deviations <= ROUNDING * sizes)
    found = np.flatnonzero(still & offset)
    if not len(found):
        return
    told, more = _listed(found, deviations)
    warn(
        f"{len(found)} coordinates move by few of the steps that float32 has beside their offset "
        f"({told}{more}; number {found[0]} beside {sizes[found[0]]:.6g}), and count as still, "
        "which is neither normalised nor probed: subtract a constant"
    )


def _listed(found: np.ndarray, deviations: np.ndarray) -> tuple[str, str]:
    """Return some coordinates with their deviations, and how many more there are."""
    told = ", ".join(f"{i}: {deviations[i]:.2g}" for i in found[:_SHOWN])
    return told, f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""


def warn_of_still_coordinates(lesson: Lesson, expert: Episodes | None) -> None:
    """Warn of coordinates of which few demonstrations show few values.

    Args:
        lesson: What is learnt from.
        expert: (E, T) the expert's own episodes, from other starts; or None.
    """
    states, scales = lesson.dataset.demonstrations, lesson.scales
    count = len(np.unique(states.episode))
    seen, number = states.observations, states.episode
    if expert is not None:
        theirs = np.broadcast_to(np.arange(len(expert.valid))[:, None], expert.valid.shape)
        seen = np.concatenate([seen, expert.observations[expert.valid]])
        number = np.concatenate([number, number.max() + 1 + theirs[expert.valid]])
    still = stands_still(seen, number) & scales.seen & ~scales.told
    found = np.flatnonzero(still)
    if not len(found) or count > 2 * _FEW:
        return
    deviations = seen.std(axis=0, dtype=np.float64)
    told, more = _listed(found, deviations)
    warn(
        f"{len(found)} coordinates stand still within an episode and differ between episodes, "
        f"such as a command, a goal or a mass; {count} demonstrations show {count} values of "
        f"them: spread={{{told}}}{more} probes them as far as the episodes that were seen differ"
    )


def _is_mode(values: np.ndarray) -> bool:
    """Whether whole numbers are few, one beside the other, and two of them no exceptions.

    Frames of a stack that is not full yet are zeros, and a force that is cut is seldom at its end.
    """
    if not 0 < np.ptp(values) < _CHOICES:
        return False
    kinds, counts = np.unique(values, return_counts=True)
    return len(kinds) == np.ptp(values) + 1 and np.sort(counts)[-2] >= _SELDOM * len(values)


def warn_of_whole_numbers(lesson: Lesson) -> None:
    """Warn of coordinates that may be a mode or a flag, of which no space has said so."""
    states, scales = lesson.dataset.demonstrations.observations, lesson.scales
    whole = (states == np.round(states)).all(axis=0) & scales.seen & scales.live & ~scales.told
    found = [i for i in np.flatnonzero(whole) if _is_mode(states[:, i])]
    if len(states) > _CHOICES and found:
        listed = ", ".join(map(str, found[:_SHOWN])) + ", ..." * (len(found) > _SHOWN)
        warn(
            f"coordinates that are whole numbers in every state ({listed}) are probed as any "
            "others: if they are modes or flags, the expert is asked between them. An "
            "environment whose space says so (Discrete, MultiBinary) keeps them as they are"
        )
