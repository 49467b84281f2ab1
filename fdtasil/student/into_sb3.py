"""A student inside an agent of stable-baselines3, to go on by reinforcement learning."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from fdtasil.checks import check_choice, check_count
from fdtasil.errors import ExportError, first_line, shown
from fdtasil.experts.sb3.randomness import randomness_kept
from fdtasil.rollouts.spaces import layout_of
from fdtasil.student.architectures import ACTIVATIONS, Mlp
from fdtasil.student.policy import Student

__all__ = ["ALGORITHMS", "agent_of"]

Layers = list[tuple[torch.Tensor, torch.Tensor]]


def _sac(policy: Any) -> Sequence[nn.Linear]:
    return [*_linear(policy.actor.latent_pi), policy.actor.mu]


def _td3(policy: Any) -> Sequence[nn.Linear]:
    return _linear(policy.actor.mu)


def _ppo(policy: Any) -> Sequence[nn.Linear]:
    return [*_linear(policy.mlp_extractor.policy_net), policy.action_net]


ALGORITHMS: dict[str, tuple[Callable[[Any], Sequence[nn.Linear]], bool]] = {
    "SAC": (_sac, False),
    "TD3": (_td3, False),
    "PPO": (_ppo, True),
}
"""Where each keeps its actor's layers, and whether it takes choices (else bounded numbers): the
tanh and the bounds of a student are those of SAC and TD3, and PPO has none."""


_MOST = 1e-3
"""How far answers of an agent and a student may be apart, in halves of an action's range."""


def agent_of(student: Student, env: Any, algorithm: str, seed: int, states: np.ndarray) -> Any:
    """Return an agent whose actor is the student; its critics are fresh.

    The student's normaliser goes into the first layer, so the agent takes raw observations.

    Args:
        student: The student, of numbers with bounds, or of choices for "PPO".
        env: A gymnasium id or environment, as stable-baselines3 takes it.
        algorithm: "SAC", "TD3", or "PPO".
        seed: Of the agent.
        states: (B, n) of its training, on which both are compared.

    Raises:
        SettingError: If there is no such algorithm.
        ExportError: If the student is no actor of it, or the agent answers otherwise.
    """
    layers_of, chooses = ALGORITHMS[check_choice("algorithm", algorithm, ALGORITHMS)]
    network, layers = student.architecture, _folded(student)
    choices = bool(student.spaces is not None and student.spaces.actions.choices)
    bounded = bool(torch.isfinite(student.low).all() and torch.isfinite(student.high).all())
    flat = student.spaces is None or student.spaces.observations.plain
    good = isinstance(network, Mlp) and flat and (choices if chooses else bounded)
    if not good or layers is None or not isinstance(network, Mlp):
        kind = "choices" if choices else "numbers with bounds" if bounded else "unbounded numbers"
        kind += "" if flat else ", on a dictionary or a stack,"
        raise ExportError(
            f"a student of {kind} as an actor of {algorithm}",
            "an Mlp on flat observations, with bounded numbers for SAC and TD3, choices for PPO",
            'take "PPO"' if choices else "go on with the student's own weights",
        )
    _check_folded(student, layers, states, choices=choices)
    import stable_baselines3

    widths = list(network.hidden) if isinstance(network.hidden, tuple) else [network.hidden]
    arch: Any = {"pi": widths, "vf": widths} if chooses else widths
    settings = {"net_arch": arch, "activation_fn": type(ACTIVATIONS[network.activation]())}
    seed = check_count("seed", seed, 0, 2**32 - 1)
    make = getattr(stable_baselines3, algorithm)
    try:
        with randomness_kept():
            agent = make("MlpPolicy", env, policy_kwargs=settings, seed=seed, device="cpu")
    except Exception as error:  # of gymnasium, or of the library
        raise ExportError(
            f"stable-baselines3 makes no {algorithm} in this environment: {first_line(error)}",
            "the environment that the student was trained in, with actions that the library takes",
            "pass its id, or the environment itself, in a wrapper that flattens its actions",
        ) from error
    try:
        _check_normaliser(agent)
        _check_spaces(student, agent, choices)
        _take_over(student, agent, layers, layers_of(agent.policy))
    except ExportError:
        if isinstance(env, str):  # the library made it
            agent.env.close()
        raise
    if algorithm == "TD3":
        agent.policy.actor_target.load_state_dict(agent.policy.actor.state_dict())
    return agent


def _take_over(student: Student, agent: Any, layers: Layers, actor: Sequence[nn.Linear]) -> None:
    """Give the layers of an agent's actor the weights of a student.

    Raises:
        ExportError: If they are of other sizes.
    """
    if type(agent.action_space).__name__ == "MultiBinary":  # a logit of yes, for no and yes
        weight, bias = layers[-1]
        layers[-1] = weight[1::2] - weight[::2], bias[1::2] - bias[::2]
    pairs = list(zip(actor, layers, strict=True))
    if any(mine.weight.shape != weight.shape for mine, (weight, _) in pairs):
        raise ExportError(
            f"a student of {student.observation_size} observations and {student.action_size} "
            "actions as an actor of this environment",
            f"layers of shapes {', '.join(str(tuple(mine.weight.shape)) for mine, _ in pairs)}",
            "pass the environment that it was trained in; it must see the whole observation",
        )
    with torch.no_grad():
        for mine, (weight, bias) in pairs:
            mine.weight.copy_(weight)
            mine.bias.copy_(bias)


def _check_normaliser(agent: Any) -> None:
    """Refuse to normalise observations twice."""
    around = agent.get_vec_normalize_env()
    if around is not None and around.norm_obs:
        raise ExportError(
            "an environment in VecNormalize, which normalises what the student normalises itself",
            "one that gives its own observations",
            "pass it without VecNormalize (its .venv), or with norm_obs=False for rewards alone",
        )


def _check_spaces(student: Student, agent: Any, choices: bool) -> None:
    """Refuse an environment whose actions mean something else."""
    space = agent.action_space
    if choices:
        _check_choices(student, space)
        return
    low, high = (np.asarray(end, np.float32).ravel() for end in (space.low, space.high))
    ours = student.low.numpy(), student.high.numpy()
    if low.shape == ours[0].shape and np.allclose((low, high), ours, rtol=1e-5, atol=0):
        return
    raise ExportError(
        f"a student of actions from {ours[0]} to {ours[1]}",
        f"{low} to {high}, as the environment",
        "pass the environment that it was trained in",
    )


def _check_choices(student: Student, space: Any) -> None:
    """Refuse other choices, and those that do not begin at 0, which the library does not know."""
    assert student.spaces is not None, "it has choices"
    ours, (theirs,) = student.spaces.actions.parts, layout_of(space, "actions").parts
    if [part.sizes for part in ours] != [theirs.sizes]:
        raise ExportError(
            f"a student of choices among {', '.join(str(part.sizes) for part in ours)}",
            f"{theirs.sizes}, as the environment",
            "pass the environment that it was trained in",
        )
    if any(theirs.first):
        kind, sizes = type(space).__name__, "nvec" if hasattr(space, "nvec") else "n"
        raise ExportError(
            f"the actions {shown(space)}, which stable-baselines3 counts from 0",
            "choices that begin at 0",
            "pass gymnasium.wrappers.TransformAction(env, lambda action: action + "
            f"env.action_space.start, gymnasium.spaces.{kind}(env.action_space.{sizes}))",
        )


def _folded(student: Student) -> Layers | None:
    """Return weights and biases on raw observations, for actions in -1..1 before their tanh."""
    if not isinstance(student.network, nn.Sequential):
        return None
    linear = _linear(student.network)
    first, *rest = ((one.weight.detach(), one.bias.detach()) for one in linear)
    weight = first[0] / student.scale
    bias = first[1] - (weight.double() @ student.mean.double()).float()
    layers = [(weight, bias), *rest]
    if student.spaces is not None and student.spaces.actions.choices:
        # Scores in units of their own; the logits of a distribution are these.
        half = student.action_units
        weight, bias = layers[-1]
        layers[-1] = weight * half[:, None], bias * half
    return layers


def _check_folded(student: Student, layers: Layers, states: np.ndarray, *, choices: bool) -> None:
    """Refuse a first layer in which float32 rounds away what moves beside what does not.

    Raises:
        ExportError: If the answers differ.
    """
    policy = student.plain
    assert policy is not None, "an Mlp on the CPU"
    half, centre = policy.half, policy.centre
    if choices:  # an agent's logits are the scores of the layers alone
        half, centre = np.ones_like(half), np.zeros_like(centre)
    folded = replace(
        policy,
        mean=np.zeros_like(policy.mean),
        scale=np.ones_like(policy.scale),
        layers=[(weight.numpy(), bias.numpy()) for weight, bias in layers],
        half=half,
        centre=centre,
    )
    apart = float((np.abs(folded(states) - policy(states)) / policy.half).max())
    if not apart <= _MOST:
        number = int((student.mean.abs() / student.scale).argmax())
        raise ExportError(
            f"an agent whose answers are {apart:.1g} of half the range away from the student's: "
            f"observation {number} is about {float(student.mean[number]):.3g}, and moves little",
            f"at most {_MOST:g}, and agents have no normaliser",
            "subtract that number in the environment, and distil there",
        )


def _linear(network: Any) -> list[nn.Linear]:
    return [layer for layer in network if isinstance(layer, nn.Linear)]
