"""The closed loop around single states: eigenvalues of its linearisation, in MuJoCo."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fdtasil.rollouts.behaviours import Policy
from fdtasil.rollouts.environments import EnvironmentPool, OwnBounds

__all__ = ["Linearisation", "linearise"]

_STATE = 1e-6  # of the simulator's differences, which are in float64
_POLICY = 1e-3  # of a policy's, which answers in float32


@dataclass(frozen=True)
class Linearisation:
    """The closed loop at single states of a path, each by itself.

    A step of the environment changes a small deviation v of positions and speeds to M v. At a
    state where the loop stays, deviations die out if all eigenvalues of M are below 1 in size. A
    path moves on, and what grows along it is not said by the eigenvalues of its steps. A
    coordinate that nothing depends on, such as the place along a track, has the eigenvalue 1.

    Attributes:
        steps: Step of the expert's episode, one for each state.
        expert: Size of the largest eigenvalue there, with the expert acting.
        student: The same, with the student acting at the same states.
    """

    steps: tuple[int, ...]
    expert: tuple[float, ...]
    student: tuple[float, ...]

    def __str__(self) -> str:
        sizes = (
            f"{name} {np.median(found):.3g} (at most {max(found):.3g})"
            for name, found in (("expert", self.expert), ("student", self.student))
        )
        return f"largest eigenvalue at {len(self.steps)} states, median: {', '.join(sizes)}"


def linearise(
    pool: EnvironmentPool,
    expert: Policy,
    student: Policy,
    seeds: Sequence[int],
    steps: Sequence[int],
) -> Linearisation | None:
    """Linearise the loop of each policy at states of the expert's own path.

    Both parts of a loop, the simulator and the policy, are differenced by themselves: what is
    near enough for the one is rounding in the float32 of the other.

    Args:
        pool: The environment.
        expert: (B, n) -> (B, m).
        student: The same.
        seeds: Of the starts.
        steps: Of each episode, those at whose state the loop is looked at.

    Returns:
        None where the environment is no MuJoCo environment of gymnasium, its observation is not
        what the simulator's state says, its actions are not the controls, or every episode ends
        before these steps.
    """
    if pool.together is not None:
        return None
    (env,) = pool.take(1)
    simulator: Any = env.unwrapped
    found: list[tuple[int, float, float]] = []
    if not _is_mujoco(simulator, pool.boxes.action_size):
        return None
    for seed in seeds:
        seen, _ = env.reset(seed=int(seed), **pool.reset_options)
        for step in range(max(steps) + 1):
            if not _same(_observed(simulator), np.ravel(seen), 1e-5):
                return None
            if step in steps:
                size_of = partial(_largest, simulator, pool.bounds)
                found.append((step, size_of(expert), size_of(student)))
            action = _acted(expert, seen, pool.bounds)
            seen, _, terminated, truncated, _ = env.step(action)
            if not _same(simulator.data.ctrl, action, 1e-6):
                return None
            if terminated or truncated:
                break
    if not found:
        return None
    looked, theirs, ours = zip(*found, strict=True)
    return Linearisation(looked, theirs, ours)


def _is_mujoco(simulator: Any, actions: int) -> bool:
    """Whether it is a simulation whose actions are its controls."""
    names = ("model", "data", "frame_skip", "_get_obs")
    return all(hasattr(simulator, name) for name in names) and simulator.model.nu == actions


def _same(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> bool:
    return ours.shape == theirs.shape and np.allclose(ours, theirs, atol=tolerance)


def _acted(policy: Policy, seen: Any, bounds: OwnBounds) -> np.ndarray:
    return bounds.put_inside(policy(np.ravel(seen)[None].astype(np.float32)))[0][0]


def _observed(simulator: Any) -> np.ndarray:
    return np.ravel(simulator._get_obs())  # it has no other name


def _largest(simulator: Any, bounds: OwnBounds, policy: Policy) -> float:
    """Return the size of the largest eigenvalue of the loop at the simulator's present state."""
    kept = simulator.data
    try:
        controls = _acted(policy, _observed(simulator), bounds)
        step = _of_simulator(simulator, kept, controls)
        reaction = _of_policy(simulator, kept, bounds, policy)
    finally:
        simulator.data = kept
    size = len(step)
    loop = step[:, :size] + step[:, size:] @ reaction
    return float(np.abs(np.linalg.eigvals(loop)).max())


def _of_simulator(simulator: Any, data: Any, controls: np.ndarray) -> np.ndarray:
    """Return the derivative (size, size + m) of a step of the environment by state and controls.

    By central differences: MuJoCo's own `mjd_transitionFD` refuses the integrator RK4, which most
    of gymnasium's models have.
    """
    mujoco, model, columns = _mujoco(), simulator.model, []
    size = 2 * model.nv + model.na
    for place in range(size + model.nu):
        ends = []
        for sign in (1, -1):
            along = np.zeros(size + model.nu)
            along[place] = sign * _STATE
            moved = _moved(model, data, along[:size])
            moved.ctrl[:] = controls + along[size:]
            mujoco.mj_step(model, moved, nstep=simulator.frame_skip)
            ends.append(moved)
        apart = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, apart, 1.0, ends[1].qpos, ends[0].qpos)
        rest = (ends[0].qvel - ends[1].qvel, ends[0].act - ends[1].act)
        columns.append(np.concatenate([apart, *rest]) / (2 * _STATE))
    return np.stack(columns, axis=1)


def _moved(model: Any, data: Any, along: np.ndarray) -> Any:
    """Return a copy of a simulation whose positions, speeds and activations are moved."""
    mujoco, moved, nv = _mujoco(), copy.copy(data), model.nv
    mujoco.mj_integratePos(model, moved.qpos, along[:nv], 1.0)
    moved.qvel[:] += along[nv : 2 * nv]
    moved.act[:] += along[2 * nv :]
    return moved


def _of_policy(simulator: Any, data: Any, bounds: OwnBounds, policy: Policy) -> np.ndarray:
    """Return the derivative (m, size) of a policy's action by the simulator's state."""
    mujoco, model = _mujoco(), simulator.model
    size, rows = 2 * model.nv + model.na, []
    for sign in (1, -1):
        for along in sign * _POLICY * np.eye(size):
            simulator.data = _moved(model, data, along)
            mujoco.mj_forward(model, simulator.data)
            mujoco.mj_rnePostConstraint(model, simulator.data)  # contact forces, as a step does
            rows.append(_observed(simulator))
    answers = bounds.put_inside(policy(np.stack(rows).astype(np.float32)))[0].astype(np.float64)
    return (answers[:size] - answers[size:]).T / (2 * _POLICY)


def _mujoco() -> Any:
    """Load MuJoCo late: it looks at MUJOCO_GL then. Its type stubs do not know all of it."""
    import mujoco

    return mujoco
