"""What an expert is, before anything is learnt from it: `fdtasil inspect`."""

from pathlib import Path

from fdtasil.checks import check_count
from fdtasil.experts.gate import examine_expert
from fdtasil.experts.load import load_expert
from fdtasil.files.storage import write_bytes
from fdtasil.probes.calibration import calibrate
from fdtasil.probes.scales import measure_scales
from fdtasil.results.figures import draw_calibration
from fdtasil.rollouts.behaviours import follow, random_behaviour
from fdtasil.rollouts.environments import EnvironmentPool, resolve_horizon
from fdtasil.rollouts.rollout import rollout
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import episode_seeds, generator
from fdtasil.shell.command import EnvironmentId, ExpertPath, import_module_of

__all__ = ["inspect_expert"]

_STATES = 32
_CHANCE = "  (no worse than the expert: does it belong to this environment and version?)"


def inspect_expert(
    expert: ExpertPath,
    env: EnvironmentId,
    /,
    *,
    output: str | None = None,
    episodes: int = 5,
    horizon: int | None = None,
    seed: int = 0,
    picture: Path | None = None,
) -> None:
    """Show what an expert is: its contract with the environment, and the return it reaches.

    Args:
        expert: ONNX file, zip of a stable-baselines3 agent, or address.
        env: Gymnasium id (module:Id imports the module first).
        output: Name of the ONNX output with the actions.
        episodes: Episodes that the return is measured over.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the episodes.
        picture: PNG file to draw the ladder of radii into.
    """
    check_count("episodes", episodes)
    import_module_of(env)
    with EnvironmentPool(env) as pool:
        boxes, length = pool.boxes, resolve_horizon(horizon, pool)
        opened = load_expert(expert, boxes.observation_size, boxes.action_size, output=output)
        starts = episode_seeds(seed, "evaluation", 0, episodes)
        recorded = rollout(follow(opened.policy("act")), pool, starts, length)
        noise = [generator(seed, "random actions", episode) for episode in range(episodes)]
        chance = rollout(random_behaviour(pool), pool, starts, length, noise).returns.mean()
        visited = recorded.observations[recorded.valid]
        findings = examine_expert(opened, recorded.spread(_STATES), boxes)
        usual = PRESETS["standard"].radius
        random = generator(seed, "calibration")
        found = calibrate(opened, visited, measure_scales(visited), random, usual)
    returns, falls = recorded.returns, int(recorded.terminated.sum())
    rows = [
        ("expert", expert),
        ("sha256", opened.sha256),
        ("environment", pool.name),
        ("observations", boxes.observation_size),
        ("actions", f"{boxes.action_size}, from {boxes.low.min():g} to {boxes.high.max():g}"),
        ("analytic", "a torch twin agrees with it" if opened.module else "not available"),
        *((f.name, f"{'FAILED: ' if f.problem else ''}{f.measured}") for f in findings),
        ("regime", found.regime),
        ("noise floor", f"{found.noise_floor:.1e} of the action, root mean square"),
        ("suggested radius", f"{found.radius:.2g} standard deviations, {found.stencil} stencil"),
        ("return", f"{returns.mean():.1f} +- {returns.std():.1f} over {episodes} episodes"),
        ("random actions", f"{chance:.1f}{_CHANCE if returns.mean() <= chance else ''}"),
        ("ended early", f"{falls} of {episodes}, of at most {length} steps"),
    ]
    print("\n".join(f"{name:20}{value}" for name, value in rows))
    if picture is not None:
        write_bytes(picture, draw_calibration(found))
        print(f"{'picture':20}{picture}")
    problem = next((finding.problem for finding in findings if finding.problem), None)
    if problem:
        raise problem
