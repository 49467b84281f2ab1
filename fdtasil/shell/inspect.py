"""`fdtasil inspect`: what an expert is, before anything is learnt from it."""

from pathlib import Path
from typing import Literal

from fdtasil.checks import check_count, check_suffix
from fdtasil.errors import printable, without_secrets
from fdtasil.experts.examination import Looked, look_closely
from fdtasil.files.storage import write_bytes
from fdtasil.probes.calibration import Calibration, calibrate
from fdtasil.probes.scales import action_units, measure_scales
from fdtasil.results.figures import draw_calibration
from fdtasil.rollouts.environments import EnvironmentPool, bounds_text
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import generator
from fdtasil.shell.call import opened, wanted
from fdtasil.shell.command import EnvironmentId, ExpertPath

__all__ = ["command"]

_CHANCE = "  (no worse than the expert: does it belong to this environment and version?)"


def command(
    expert: ExpertPath,
    env: EnvironmentId,
    /,
    *,
    output: str | None = None,
    inputs: str | None = None,
    trust: Literal["pickle", "c"] | None = None,
    episodes: int = 5,
    horizon: int | None = None,
    seed: int = 0,
    env_kwargs: str | None = None,
    reset_options: str | None = None,
    picture: Path | None = None,
) -> None:
    """Show what an expert is: its contract with the environment, and the return it reaches.

    Args:
        expert: ONNX file, zip of a stable-baselines3 agent, or address.
        env: Gymnasium id (module:Id imports the module first).
        output: Name of the ONNX output with the actions.
        inputs: What the inputs of an ONNX file are given, where it has several: a number always,
            or columns, as in time_step=0,obs=0:17.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.
        episodes: Episodes that the return is measured over.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the episodes.
        env_kwargs: What the environment is made with, as JSON.
        reset_options: What each reset is given as its options, as JSON.
        picture: PNG file to draw the ladder of radii into.
    """
    check_count("episodes", episodes)
    # Absolute from the beginning: an environment may change the working folder.
    file = None if picture is None else check_suffix(picture, ".png").absolute()
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    source = opened(expert, place, output=output, inputs=inputs, trust=trust)
    with EnvironmentPool(place) as pool:
        looked = look_closely(source, pool, horizon, seed, episodes)
        rows = [
            ("expert", without_secrets(expert)),
            ("environment", pool.name),
            *_contract(looked, pool),
        ]
    problem = next((finding.problem for finding in looked.findings if finding.problem), None)
    found = _calibrated(looked, pool, seed)
    if found is not None:
        rows += [
            ("regime", found.regime),
            ("noise floor", f"{found.noise_floor:.1e} of an action's unit, root mean square"),
            ("suggested radius", f"{found.radius:.2g} deviations, {found.stencil} stencil"),
            ("what is matched", found.match or "differences"),
        ]
    rows += _returns(looked)
    print("\n".join(printable(f"{name:20}{value}") for name, value in rows))
    if file is not None and found is not None:
        write_bytes(file, draw_calibration(found))
        print(f"{'picture':20}{picture}")
    if problem:
        raise problem


def _contract(looked: Looked, pool: EnvironmentPool) -> list[tuple[str, object]]:
    expert, size = looked.expert, pool.boxes.observation_size
    memory = expert.memory.size if expert is not None and expert.memory is not None else 0
    rows: list[tuple[str, object]] = [
        ("observations", f"{size - memory}{f', and {memory} of memory' if memory else ''}"),
        ("actions", _actions(pool)),
    ]
    if expert is not None:
        rows.insert(0, ("sha256", expert.origin.sha256))
        rows += [("analytic", "a torch twin agrees with it" if expert.module else "not available")]
    return rows + [
        (finding.name, f"{'FAILED: ' if finding.problem else ''}{finding.measured}")
        for finding in looked.findings
        if finding.name != "opening" or finding.problem
    ]


def _actions(pool: EnvironmentPool) -> str:
    boxes, choices = pool.boxes, pool.spaces.actions.choices
    if choices:
        counts = ", ".join(str(stop - start) for start, stop in choices)
        return f"{boxes.action_size} scores of choices, of {counts} each"
    return f"{boxes.action_size}, from {bounds_text(boxes.low, boxes.high)}"


def _calibrated(looked: Looked, pool: EnvironmentPool, seed: int) -> Calibration | None:
    if looked.own is None or looked.expert is None:
        return None
    visited, random = looked.own.observations[looked.own.valid], generator(seed, "calibration")
    scales, radius = measure_scales(visited), PRESETS["standard"].radius
    low, high, choices = pool.boxes.low, pool.boxes.high, pool.spaces.actions.choices
    units = action_units(low, high, looked.own.actions[looked.own.valid], choices)
    return calibrate(looked.expert, visited, scales, random, radius, units=units)


def _returns(looked: Looked) -> list[tuple[str, object]]:
    if looked.own is None or looked.chance is None:
        return []
    returns, chance = looked.own.returns, looked.chance.returns.mean()
    count, length = looked.own.valid.shape
    falls = int(looked.own.terminated.sum())
    return [
        ("return", f"{returns.mean():.1f} +- {returns.std():.1f} over {count} episodes"),
        ("random actions", f"{chance:.1f}{_CHANCE if returns.mean() <= chance else ''}"),
        ("ended early", f"{falls} of {count}, of at most {length} steps"),
    ]
