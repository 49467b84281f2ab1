"""States that a shipped expert visits, alone and pushed about by noise."""

from collections.abc import Sequence

import numpy as np

from fdtasil.experts.expert import Expert
from fdtasil.experts.load import load_expert
from fdtasil.rollouts.behaviours import Behaviour, Decision
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.rollout import rollout
from fdtasil.seeding import episode_seeds, generator

from .box import SHIPPED


def shipped_expert(environment: str) -> Expert:
    """Open the expert that the repository ships for an environment."""
    return load_expert(SHIPPED / f"{environment}.onnx")


def pushed(expert: Expert, noise: Sequence[float]) -> Behaviour:
    """Return the behaviour of an expert whose actions are disturbed, each episode in its way.

    Args:
        expert: Who acts.
        noise: Standard deviations of the disturbance, one of which each episode draws anew at
            every step, so that calm and wild stretches follow each other.
    """

    def act(observations: np.ndarray, randoms: Sequence[np.random.Generator]) -> Decision:
        answer = expert.ask(observations, "act")
        kicks = [r.choice(noise) * r.standard_normal(answer.shape[1]) for r in randoms]
        return Decision(answer + np.asarray(kicks, np.float32), answer)

    return act


def visited(
    expert: Expert,
    environment: str,
    episodes: int,
    horizon: int,
    noise: Sequence[float] = (0.0,),
    seed: int = 0,
) -> np.ndarray:
    """Return the (N, n) states of some episodes in which the expert's actions are disturbed."""
    with EnvironmentPool(environment) as pool:
        starts = episode_seeds(seed, "visits", 0, episodes)
        randoms = [generator(seed, "visits", "noise", e) for e in range(episodes)]
        record = rollout(pushed(expert, noise), pool, starts, horizon, randoms)
    return record.observations[record.valid]
