"""From the arguments of `distill` to one configuration."""

from dataclasses import replace

from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.trainers import Trainer, trainer_of
from fdtasil.errors import SettingError
from fdtasil.probes.source import Probes
from fdtasil.probes.stencils import EXACT, FORWARD
from fdtasil.run.presets import Preset


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
