"""What a run is about: an expert, an environment, given demonstrations; any two may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.errors import SettingError
from fdtasil.experts.expert import Expert
from fdtasil.experts.http_expert import is_http_url
from fdtasil.experts.hub.place import is_hub_uri
from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.experts.sb3.trust import Trust
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool

__all__ = ["Subject", "open_subject"]


@dataclass(frozen=True)
class Subject:
    """An expert and its environment, opened.

    Attributes:
        expert: The black box, or None where nobody is asked.
        expert_name: What to call it, or None.
        pool: The environment, or None where nothing is recorded.
        environment: What to call it.
        observation_size: n.
        action_size: m.
    """

    expert: Expert | None
    expert_name: str | None
    pool: EnvironmentPool | None
    environment: str
    observation_size: int
    action_size: int

    @property
    def comparable(self) -> bool:
        """Whether student and expert can be compared in the environment."""
        return self.expert is not None and self.pool is not None


@contextmanager
def open_subject(
    expert: ExpertLike | None,
    env: EnvironmentLike | None,
    given: Dataset | None,
    *,
    output: str | None,
    trust: Trust,
) -> Iterator[Subject]:
    """Open expert and environment for the length of a block.

    Raises:
        SettingError: If something is missing that nothing replaces.
        ExpertError: If the expert can't be opened.
        EnvironmentFault: If the environment can't be used, or does not fit the demonstrations.
    """
    if given is None and (expert is None or env is None):
        missing = "expert" if expert is None else "env"
        raise SettingError(
            f"no {missing}", "an expert and an environment, or demonstrations", f"pass {missing}="
        )
    with EnvironmentPool(env) if env is not None else nullcontext() as pool:
        if pool is not None:
            n, m, name = pool.boxes.observation_size, pool.boxes.action_size, pool.name
        else:
            assert given is not None
            n, m, name = *given.sizes, given.environment
        if given is not None and given.sizes != (n, m):
            raise SettingError(
                f"demonstrations with (observations, actions) of sizes {given.sizes}",
                f"{(n, m)}, as {name}",
                "pass the environment that they were recorded in, or none",
            )
        opened = None
        if expert is not None:
            opened = load_expert(expert, n, m, output=output, trust=trust)
        # The hub's files are called by their commit, which `expert` may leave open; the query of
        # an address may hold a secret, which its name leaves out.
        remote = is_hub_uri(expert) or is_http_url(expert)
        by_path = isinstance(expert, (str, Path)) and not remote
        named = str(expert) if by_path else opened and opened.name
        yield Subject(opened, named, pool, name, n, m)
