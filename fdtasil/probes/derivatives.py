"""The analytic reference: exact directional derivatives, of a torch module or the expert's own."""

from collections.abc import Callable

import numpy as np
import torch

from fdtasil.errors import ExpertError, in_one_line
from fdtasil.experts.expert import Expert
from fdtasil.probes.gains import gain_rows, gains
from fdtasil.probes.scales import measure_scales

__all__ = ["check_derivatives", "comparison_rows", "differentiate"]

_STATES, _NUMBERS = 64, 2**24  # differentiated at once: states, and numbers of their directions
_COMPARED = 4  # states at which an expert's own derivatives are compared with differences
_PROBED = 'probe it instead: probes="basis" or probes=10'
_APART = 3  # errors of a difference that they may lie apart, and
_TOLERATED = 0.02  # of the derivatives' norm


def differentiate(
    expert: Expert,
    observations: np.ndarray,
    directions: np.ndarray,
    numbers: np.ndarray,
    order: int,
) -> np.ndarray:
    """Differentiate the expert along directions.

    Args:
        expert: One that is a torch module, or gives its derivatives itself.
        observations: (N, n) float32 states.
        directions: (P, n) float32 bank.
        numbers: (N, k) rows of the bank, those of each state.
        order: 1, or 2 for second derivatives too.

    Returns:
        (N, k, order, m) float32 directional derivatives; NaN is none.

    Raises:
        ExpertError: If the expert can't be differentiated, or its own derivatives are not those
            of its actions.
    """
    along = _of_module(expert.module, order) if expert.module else _of_the_expert(expert, order)
    parts, size = [], numbers.shape[1] * observations.shape[1]
    block = max(1, min(_STATES, _NUMBERS // size))
    for start in range(0, len(observations), block):
        rows = slice(start, start + block)
        parts.append(along(observations[rows], directions[numbers[rows]]))
    found = np.concatenate(parts)
    infinite = np.isinf(found)
    if infinite.any():
        bad = int(infinite.any(axis=(1, 2, 3)).sum())
        raise ExpertError(
            f"{expert.name} has infinite derivatives at {bad} of {len(found)} states",
            "finite ones, or NaN where there is none",
            f"look at the law there, such as the root of 0; or {_PROBED}",
        )
    return found


Along = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(B, n) states and (B, k, n) directions -> (B, k, order, m) float32 derivatives."""


def _of_module(module: torch.nn.Module, order: int) -> Along:
    like = next(module.parameters(), torch.zeros(()))
    every = torch.func.vmap(torch.func.vmap(_derivatives_along(module, order), in_dims=(None, 0)))

    def along(states: np.ndarray, directions: np.ndarray) -> np.ndarray:
        where = [
            torch.from_numpy(np.ascontiguousarray(part)).to(like.device, like.dtype)
            for part in (states, directions)
        ]
        with torch.no_grad():
            return every(*where).float().cpu().numpy()

    return along


def _derivatives_along(
    module: torch.nn.Module, order: int
) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """Return the function from a state and a direction to the (order, m) derivatives there."""

    def first(x: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        return torch.func.jvp(lambda y: module(y[None])[0], (x,), (direction,))[1]

    def derivatives(x: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        if order == 1:
            return first(x, direction)[None]
        both = torch.func.jvp(lambda y: first(y, direction), (x,), (direction,))
        return torch.stack(both[:2])

    return derivatives


def _of_the_expert(expert: Expert, order: int) -> Along:
    """Take the derivatives that the expert gives itself.

    Raises:
        ExpertError: If it gives none, or none of this order.
    """
    if expert.jacobian is None or order > 1:
        raise ExpertError(
            f"{expert.name} can't be differentiated" + (" twice" if expert.jacobian else ""),
            "a torch module, or an ONNX file made of the operators of an MLP"
            + ("" if order > 1 else ", or a second value, its (B, m, n) derivatives"),
            _PROBED,
        )

    def along(states: np.ndarray, directions: np.ndarray) -> np.ndarray:
        found = np.einsum("bmn,bkn->bkm", _jacobians(expert, states), directions)
        return found[:, :, None].astype(np.float32)

    return along


def _jacobians(expert: Expert, rows: np.ndarray) -> np.ndarray:
    """Ask for the derivatives at some states, as many at once as actions are asked."""
    starts = range(0, len(rows), expert.chunk)
    return np.concatenate([_asked(expert, rows[start : start + expert.chunk]) for start in starts])


def _asked(expert: Expert, rows: np.ndarray) -> np.ndarray:
    """Ask for the derivatives at some states in one call, counted as rows of probes."""
    assert expert.jacobian is not None
    expert.count(len(rows), "probe")
    expected = f"({len(rows)}, {expert.action_size or 'm'}, {rows.shape[1]}) finite derivatives"
    try:
        found = np.array(expert.jacobian(rows.copy()), np.float32)
    except Exception as error:
        raise ExpertError(
            f"{expert.name} can't be differentiated: {in_one_line(error)}",
            expected,
            _PROBED,
        ) from error
    right = found.ndim == 3 and found.shape[::2] == rows.shape
    if not right or found.shape[1] != (expert.action_size or found.shape[1]):
        raise ExpertError(
            f"{expert.name} gives derivatives of shape {found.shape}",
            expected,
            "derivatives of actions (rows) by coordinates (columns), for each observation",
        )
    if not np.isfinite(found).all():
        raise ExpertError(
            f"{expert.name} gives derivatives that are not finite", expected, "look at them there"
        )
    return found


def comparison_rows(observation_size: int) -> int:
    """Return the rows that `check_derivatives` asks for."""
    return _COMPARED + gain_rows(_COMPARED, observation_size)


def check_derivatives(expert: Expert, observations: np.ndarray) -> None:
    """Hold derivatives that the expert gives itself against differences at a few states.

    Raises:
        ExpertError: If they are others.
    """
    if expert.module is not None or expert.jacobian is None:
        return
    chosen = np.linspace(0, len(observations) - 1, _COMPARED).astype(int)
    rows = observations[chosen]
    scale = measure_scales(observations).units_beside(rows)
    given, found = _jacobians(expert, rows), gains(expert, rows, scale=scale)
    expert.count(found.queries, "probe")
    apart = np.sqrt(np.nanmean(((given - found.jacobian) * scale) ** 2, axis=0))
    size = np.linalg.norm(np.sqrt(np.nanmean((found.jacobian * scale) ** 2, axis=0)))
    bound = _APART * np.linalg.norm(found.error * scale) + _TOLERATED * size
    if np.linalg.norm(apart) > bound:
        action, column = np.unravel_index(apart.argmax(), apart.shape)
        raise ExpertError(
            f"{expert.name} gives derivatives that are not those of its actions: of action "
            f"{action} by coordinate {column} it says {given[0, action, column]:.3g}, differences "
            f"{found.jacobian[0, action, column]:.3g}",
            "(B, m, n) derivatives of the actions by the raw observations",
            'check signs, order and scaling, or probe it: probes="basis"',
        )
