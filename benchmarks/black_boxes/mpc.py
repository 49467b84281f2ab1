"""A sampling model-predictive controller: it simulates what could be done, for every answer."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout

from fdtasil.experts.expert import Expert
from fdtasil.experts.load import load_expert

ENVIRONMENT = "Reacher-v5"
_LINKS = 0.1, 0.11  # metres from shoulder to elbow, from elbow to fingertip


@dataclass(frozen=True)
class SamplingController:
    """Path-integral control (MPPI) of an arm of two links that is to reach a target.

    Each row is planned from nothing: the same random sequences of torques are rolled out from
    the observed state, and averaged with weights that fall with their cost; the first torque of
    the average is the answer. So equal observations give equal answers, and no row sees another.

    Attributes:
        samples: Sequences of torques tried for each row.
        steps: Environment steps that are looked ahead.
        knots: Torques of a sequence, each held for an equal part of it.
        spreads: Standard deviations of the torques; each is that of an equal share of sequences.
        temperature: A sequence that costs this much more counts e times less.
        seed: Of the sequences.

    Example:
        >>> SamplingController(samples=4, steps=4)(np.zeros((3, 10), np.float32)).shape
        (3, 2)
    """

    samples: int = 64
    steps: int = 16
    knots: int = 3
    spreads: tuple[float, ...] = (0.1, 0.4, 1.0)
    temperature: float = 0.02
    seed: int = 0

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Answer (B, 10) observations with (B, 2) torques in [-1, 1]."""
        plans, model = _plans(self), _model()
        starts = np.repeat(_states(observations), len(plans), axis=0)
        torques = np.tile(plans, (len(observations), 1, 1))
        passed, _ = rollout.rollout(model, mujoco.MjData(model), starts, torques)
        costs = _costs(passed).reshape(len(observations), len(plans)) + _effort(plans)
        shares = np.exp((costs.min(axis=1, keepdims=True) - costs) / self.temperature)
        return shares / shares.sum(axis=1, keepdims=True) @ plans[:, 0]


def make_mpc(folder: Path, workers: int = 2, samples: int = 64) -> Expert:
    """Return the controller, asked by processes side by side; it needs no file.

    Args:
        folder: Not used.
        workers: Processes; 0 asks in this one.
        samples: Sequences tried for each row.
    """
    controller = SamplingController(samples=samples)
    return load_expert(controller, 10, 2, workers=workers, batch=8)


@cache
def _plans(controller: SamplingController) -> np.ndarray:
    """Return the (S, T, 2) sequences of torques; the first is to do nothing."""
    size = controller.samples, controller.knots, 2
    spread = np.resize(controller.spreads, controller.samples)
    torques = spread[:, None, None] * np.random.default_rng(controller.seed).standard_normal(size)
    torques[0] = 0.0
    knot = np.arange(controller.steps) * controller.knots // controller.steps
    return np.clip(torques[:, knot], -1, 1)


@cache
def _model() -> mujoco.MjModel:
    """Return the arm with one coarse physics step for each step of the environment."""
    import gymnasium

    environment = gymnasium.make(ENVIRONMENT).unwrapped
    model = environment.model
    model.opt.timestep *= environment.frame_skip
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return model


def _states(observations: np.ndarray) -> np.ndarray:
    """Return (B, 9) time, positions and velocities; the last two observations follow from them."""
    rows = observations.astype(np.float64)
    states = np.zeros((len(rows), 9))
    states[:, 1:3] = np.arctan2(rows[:, 2:4], rows[:, 0:2])
    states[:, 3:5] = rows[:, 4:6]  # the target hangs on two slides
    states[:, 5:7] = rows[:, 6:8]
    return states


def _costs(states: np.ndarray) -> np.ndarray:
    """Return the summed distance of fingertip to target, and a little for speed, of (B, T, 9)."""
    shoulder = states[..., 1]
    elbow = shoulder + states[..., 2]
    tip = sum(
        length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for length, angle in zip(_LINKS, (shoulder, elbow), strict=True)
    )
    distance = np.linalg.norm(tip - states[..., 3:5], axis=-1)
    speed = (states[..., 5:7] ** 2).sum(axis=-1)
    return distance.sum(axis=1) + 0.01 * speed.mean(axis=1)


def _effort(plans: np.ndarray) -> np.ndarray:
    return 0.1 * (plans**2).sum(axis=(1, 2))
