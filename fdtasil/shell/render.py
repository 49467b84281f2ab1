"""`fdtasil render`: policies side by side in a film."""

from pathlib import Path

from fdtasil.errors import SettingError
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.film import choose_renderer, render
from fdtasil.shell.call import wanted
from fdtasil.shell.command import EnvironmentId

__all__ = ["command"]


def command(
    env: EnvironmentId,
    policies: tuple[str, ...],
    /,
    *,
    out: Path = Path("film.mp4"),
    seed: int = 0,
    horizon: int | None = None,
    every: int = 1,
    height: int = 360,
    env_kwargs: str | None = None,
    reset_options: str | None = None,
) -> None:
    """Film policies side by side, from one start.

    Args:
        env: Gymnasium id (module:Id imports the module first).
        policies: NAME=FILE of each, in their order from the left: an ONNX file, a zip, an address.
        out: Ends with .mp4, .webp or .gif.
        seed: Of the start.
        horizon: Steps after which the episode is cut; default: the environment's time limit.
        every: Steps between two pictures.
        height: Of a picture, in pixels.
        env_kwargs: What the environment is made with, as JSON.
        reset_options: What each reset is given as its options, as JSON.
    """
    choose_renderer()
    named: dict[str, str] = {}
    for text in policies:
        name, equals, file = text.partition("=")
        if not equals or not name or name in named:
            raise SettingError(
                f"the policy {text!r}", "NAME=FILE, each name once", "write student=student.onnx"
            )
        named[name] = file
    file = out.absolute()  # an environment may change the folder
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    assert place is not None
    render(named, place, file, seed=seed, horizon=horizon, every=every, height=height)
    print(f"written: {out}")
