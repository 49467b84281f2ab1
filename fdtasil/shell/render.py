"""`fdtasil render`: policies side by side in a film."""

from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any

import tyro

from fdtasil.errors import SettingError
from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.film import choose_renderer, render
from fdtasil.shell.call import MADE_FLAGS, judged, wanted
from fdtasil.shell.command import EnvironmentId, Flags, as_command

__all__ = ["command"]


def _render(
    env: str,
    policies: tuple[str, ...],
    out: Path,
    trust: Any,
    env_kwargs: str | None,
    reset_options: str | None,
    **arguments: Any,
) -> None:
    choose_renderer()
    if not policies:
        raise SettingError("no policy", "one at least", "write for example student=student.onnx")
    named: dict[str, ExpertLike] = {}
    for text in policies:
        name, equals, file = text.partition("=")
        if not equals or not name or name in named:
            raise SettingError(
                f"the policy {text!r}", "NAME=FILE, each name once", "write student=student.onnx"
            )
        named[name] = judged(file, trust)
    file = out.absolute()  # an environment may change the folder
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    render(named, place, file, **arguments)
    print(f"written: {out}")


_Policies = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME=FILE")]

command = as_command(
    _render,
    [
        Flags(render, only=("seed", "horizon", "every", "height")),
        Flags(load_expert, only=("trust",)),
    ],
    {
        "env": (
            EnvironmentId,
            Parameter.empty,
            "Gymnasium id (module:Id imports the module first).",
        ),
        "policies": (
            _Policies,
            Parameter.empty,
            "NAME=FILE of each, in their order from the left: an ONNX file, a zip, an address, "
            "the folder of a run.",
        ),
        "out": (Path, Path("film.mp4"), "Ends with .mp4, .webp or .gif."),
        **MADE_FLAGS,
    },
)
