"""`fdtasil shrink`: students of several sizes from one run's answers."""

from pathlib import Path

from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.presets import preset_of
from fdtasil.run.shrinking import shrink
from fdtasil.shell.call import wanted
from fdtasil.shell.command import EnvironmentId, ExpertPath, RunFolder

__all__ = ["command"]


def command(
    run: RunFolder,
    expert: ExpertPath,
    env: EnvironmentId,
    /,
    *,
    out: Path | None = None,
    keep: float = 0.95,
    widths: tuple[int, ...] = (8, 16, 32, 64, 128, 256),
    layers: int = 2,
    activations: tuple[str, ...] = ("relu",),
    cloned: bool = True,
    evaluation_episodes: int = 20,
    horizon: int | None = None,
    steps: int | None = None,
    workers: int = 1,
    env_kwargs: str | None = None,
    reset_options: str | None = None,
) -> None:
    """Find the smallest student that keeps the expert's level, without recording again.

    Args:
        run: Folder of a finished run.
        expert: The expert of that run.
        env: Its environment.
        out: Folder of the runs, one for each student; what is finished in it is taken as it is.
            Left out, RUN-shrunk beside the run.
        keep: Share of the expert's return that the lower end of the interval must reach.
        widths: Of the hidden layers, one student each.
        layers: Hidden layers of each.
        activations: Of each size.
        cloned: Also train each without probes.
        evaluation_episodes: Paired episodes.
        horizon: Steps after which an episode is cut; left out, the run's.
        steps: Training steps of each; left out, as many as `distill` would take.
        workers: Students that are trained side by side.
        env_kwargs: What the environment is made with, as JSON.
        reset_options: What each reset is given as its options, as JSON.
    """
    place_of_runs = run.parent / f"{run.name}-shrunk" if out is None else out
    folder = place_of_runs.absolute()
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    assert place is not None
    sizes = [(width,) * layers for width in widths]
    found = shrink(
        run,
        expert,
        place,
        keep=keep,
        sizes=sizes,
        activations=activations,
        cloned=cloned,
        evaluation_episodes=evaluation_episodes,
        horizon=horizon,
        fit=None if steps is None else preset_of("standard").fit_with(steps=steps),
        out=folder,
        workers=workers,
    )
    print(found)
    print(f"saved in {place_of_runs}: sizes.json, sizes.png, and a run for each student")
