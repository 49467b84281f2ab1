"""`fdtasil gains`: the Jacobian of an expert at states of its own episodes."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from fdtasil.checks import check_count, check_suffix
from fdtasil.experts.examination import look_closely
from fdtasil.files.storage import write_bytes
from fdtasil.probes.gains import Gains, gains
from fdtasil.probes.scales import measure_scales
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.wanted import import_module_of
from fdtasil.shell.call import opened, wanted
from fdtasil.shell.command import EnvironmentId, ExpertPath

__all__ = ["command"]


def command(
    expert: ExpertPath,
    env: EnvironmentId,
    /,
    *,
    states: int = 10,
    out: Path | None = None,
    output: str | None = None,
    inputs: str | None = None,
    trust: Literal["pickle", "c"] | None = None,
    horizon: int | None = None,
    seed: int = 0,
    env_kwargs: str | None = None,
    reset_options: str | None = None,
) -> None:
    """Find the Jacobian of any expert at states that it visits, with an estimate of the error.

    Args:
        expert: ONNX file, zip of a stable-baselines3 agent, or address.
        env: Gymnasium id (module:Id imports the module first).
        states: How many, evenly spread over an episode of the expert.
        out: NumPy file (.npz) of states, Jacobians and errors.
        output: Name of the ONNX output with the actions.
        inputs: What the inputs of an ONNX file are given, where it has several: a number always,
            or columns, as in time_step=0,obs=0:17.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.
        horizon: Steps after which the episode is cut; default: the environment's time limit.
        seed: Of the episode.
        env_kwargs: What the environment is made with, as JSON.
        reset_options: What each reset is given as its options, as JSON.
    """
    check_count("states", states)
    # Absolute: an environment may change the folder.
    file = None if out is None else check_suffix(out, ".npz").absolute()
    import_module_of(env)
    place = wanted(env, env_kwargs, reset_options)
    source = opened(expert, place, output=output, inputs=inputs, trust=trust)
    with EnvironmentPool(place) as pool:
        looked = look_closely(source, pool, horizon, seed, 1, with_chance=False)
        problem = next((f.problem for f in looked.findings if f.problem), None)
        if looked.own is None:
            assert problem is not None, "an expert that can't act has a finding that says why"
            raise problem
        asked = looked.expert
        assert asked is not None, "who acted was opened"
        visited = looked.own.observations[looked.own.valid]
        scales = measure_scales(visited)
        chosen = looked.own.spread(min(states, len(visited)))
        found = gains(asked, chosen, scale=scales.units_beside(visited), seed=seed)
        found = replace(found, still=tuple(np.flatnonzero(~scales.live).tolist()))
        found = _without(found, list(pool.spaces.observations.held))
    print(found)
    if file is not None:
        write_bytes(file, _packed(chosen, found))
        print(f"written: {file}")


def _without(found: Gains, held: list[int]) -> Gains:
    """Leave out choices, flags and whole numbers: nothing is between two of them."""
    jacobian, error = found.jacobian.copy(), found.error.copy()
    jacobian[..., held] = error[..., held] = 0.0
    return replace(found, jacobian=jacobian, error=error)


def _packed(states: np.ndarray, found: Gains) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        observations=states,
        jacobian=found.jacobian,
        error=found.error,
        scale=found.scale,
        radius=found.radius,
    )
    return buffer.getvalue()
