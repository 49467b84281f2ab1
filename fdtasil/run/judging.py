"""A policy that is judged, opened for an environment."""

from fdtasil.experts.expert import Expert, Hints
from fdtasil.experts.load import ExpertLike, open_expert
from fdtasil.experts.structure import in_spaces
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.spaces import Spaces, flat_layout

__all__ = ["judged_in"]


def judged_in(
    policy: ExpertLike, pool: EnvironmentPool, size: int | None, *, whole: bool
) -> Expert:
    """Open a policy that is judged; one that sees a part of the observation takes flat rows."""
    spaces = pool.spaces.unless_plain
    judged = open_expert(policy, Hints(size, pool.boxes.action_size, spaces=spaces))
    if spaces is not None and (not whole or judged.columns is not None):
        spaces = Spaces(flat_layout(size or 1), spaces.actions)
    return in_spaces(judged, spaces)
