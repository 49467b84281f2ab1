"""A call of `distill` from the flat arguments of a shell."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.results.distilled import Distilled
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.run.events import Log
from fdtasil.run.pipeline import distill
from fdtasil.run.presets import preset_of
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import Fit

__all__ = ["distil", "opened"]

Arguments = Mapping[str, Any]


def distil(arguments: Arguments, *, progress: bool = True) -> Distilled:
    """Distil: fields of `Fit` and `Mlp`, and options of `load_expert`, stand beside the others.

    Args:
        arguments: By name; None where one was left out.
        progress: Show progress bars, where there is a terminal.

    Raises:
        FdtasilError: As `distill`.
    """
    rest = dict(arguments)
    fit = {field.name: rest.pop(field.name) for field in fields(Fit)}
    said = {field.name: rest.pop(field.name) for field in fields(Mlp)}
    network = {name: value for name, value in said.items() if value is not None}
    output, inputs, trust = (rest.pop(name) for name in ("output", "inputs", "trust"))
    formats = rest.pop("log_formats")
    rest["expert"] = opened(rest["expert"], rest["env"], output=output, inputs=inputs, trust=trust)
    folder = Path(rest["out"] or rest["resume"] or ".")
    return distill(
        **rest,
        student=Mlp(**network) if network else None,
        fit=preset_of(rest["preset"]).fit_with(**fit),
        callback=Log(folder / "log", *formats) if formats else None,
        progress=progress,
    )


def opened(
    expert: str | None,
    env: str | None,
    *,
    output: str | None,
    inputs: str | None,
    trust: Any,
) -> ExpertLike | None:
    """Return an expert opened with options; as it is, where there are none.

    Raises:
        ExpertError: If it can't be opened.
    """
    if expert is None or (output is None and inputs is None and trust is None):
        return expert
    if env is None:
        return load_expert(expert, output=output, inputs=inputs, trust=trust)
    with EnvironmentPool(env) as pool:  # whose sizes tell which output holds the actions
        sizes = pool.boxes.observation_size, pool.boxes.action_size
    return load_expert(expert, *sizes, output=output, inputs=inputs, trust=trust)
