"""What a run is about: an expert, an environment, given demonstrations; any two may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from fdtasil.datasets import Dataset
from fdtasil.environments import EnvironmentLike, EnvironmentPool
from fdtasil.errors import SettingError
from fdtasil.experts import Expert, ExpertLike, load_expert
from fdtasil.experts.http_expert import is_http_url
from fdtasil.experts.hub import is_hub_uri
from fdtasil.presets import Preset
from fdtasil.probes import EXACT, FORWARD, Probes
from fdtasil.sb3 import Trust
from fdtasil.trainers import Trainer, trainer_of

__all__ = ["Subject", "open_subject", "source_of", "trainer_for"]


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


def source_of(
    spec: int | str | Probes,
    preset: Preset,
    order: int,
    given: Dataset | None,
    *,
    usual: int | str,
) -> Probes | None:
    """Return the derivative source of a run: what is asked for, or what is stored.

    Args:
        spec: The argument `probes`.
        preset: Fills in what it leaves open.
        order: Of the Taylor loss.
        given: Demonstrations; their stored answers are used as they are.
        usual: The value of `spec` that means nothing was said.

    Returns:
        The source, or None for plain behaviour cloning.

    Raises:
        SettingError: If order, source and stored answers do not go together.
    """
    if order not in (1, 2) or isinstance(order, bool):
        raise SettingError(f"order={order!r}", "1 or 2 (probes=0 is order 0)", "write order=1")
    asked = preset.complete(Probes.parse(spec))
    stored = given.probes if given is not None else None
    if asked is None:
        return None
    if given is None or stored is None or given.answers is None:
        return asked.with_order(order, None if preset.calibrates(asked) else FORWARD)
    asked = replace(  # what was left open was found by a calibration, and is stored
        asked, radius=asked.radius or stored.radius, stencil=asked.stencil or stored.stencil
    ).with_order(order)
    if spec != usual and asked != stored:
        raise SettingError(
            f"probes={asked.describe()!r} with stored answers to {stored.describe()!r}",
            "the source that is stored, or probes=0",
            "leave probes= out, or record demonstrations of its own",
        )
    if order == 2 and stored.stencil is EXACT and given.answers.values.shape[2] < 2:
        raise SettingError(
            "order=2 with stored derivatives of first order",
            "demonstrations made with order=2",
            "record them with order=2, or pass order=1",
        )
    # Nobody is asked anew: stored answers are what there is.
    return replace(stored.with_order(order), resample=False)


def trainer_for(trainer: str | Trainer, given: Dataset | None) -> Trainer | None:
    """Return who acts in which round; nobody does where the demonstrations are given.

    Raises:
        SettingError: If there is no such trainer, or one is asked for that has nothing to do.
    """
    chosen = trainer_of(trainer)
    if given is None:
        return chosen
    if chosen.name != "bc":
        raise SettingError(
            f"trainer={chosen.name!r} with given demonstrations",
            "nobody who acts: nothing is recorded",
            "leave trainer= out, or leave demonstrations= out",
        )
    return None
