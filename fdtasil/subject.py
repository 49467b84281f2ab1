"""What a run is about: an expert, an environment, given demonstrations; any two may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from fdtasil.datasets import Dataset
from fdtasil.environments import EnvironmentLike, EnvironmentPool
from fdtasil.errors import SettingError
from fdtasil.experts import Expert, ExpertLike, load_expert
from fdtasil.probes import Probes
from fdtasil.sb3 import Trust

__all__ = ["Subject", "open_subject", "source_of"]


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
        named = str(expert) if isinstance(expert, (str, Path)) else opened and opened.name
        yield Subject(opened, named, pool, name, n, m)


def source_of(asked: Probes | None, order: int, given: Dataset | None) -> Probes | None:
    """Return the derivative source of a run: what is asked for, or what is stored.

    Args:
        asked: Completed by the preset; None for plain behaviour cloning.
        order: Of the Taylor loss.
        given: Demonstrations; their stored answers are used as they are.

    Raises:
        SettingError: If order and source do not go together.
    """
    if order not in (1, 2) or isinstance(order, bool):
        raise SettingError(f"order={order!r}", "1 or 2 (probes=0 is order 0)", "write order=1")
    if asked is None:
        return None
    if given is None or given.probes is None:
        return asked.with_order(order)
    stored = given.probes
    if order == 2 and stored.stencil is not None and stored.stencil.exact:
        if given.answers is not None and given.answers.values.shape[2] < 2:
            raise SettingError(
                "order=2 with stored derivatives of first order",
                "demonstrations made with order=2",
                "record them with order=2, or pass order=1",
            )
    return replace(stored.with_order(order), resample=False)
