"""How each algorithm of stable-baselines3 keeps its policy, and what can be read of it as text."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import nn

from fdtasil.errors import ExpertError, shown
from fdtasil.experts.sb3.trust import ITSELF, TRUST

__all__ = [
    "Recipe",
    "check_policy",
    "find_recipe",
    "has_usual_policy",
    "read_activation",
]

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Recipe:
    """Where an algorithm keeps what its deterministic policy is made of.

    Attributes:
        algorithm: Name of the class.
        marks: Entries of the record that tell the algorithm: the value, or None for any value.
        policies: The policy classes whose computation is known, with their modules.
        layers: Prefixes of the weights, in the order in which they are applied.
        unused: Prefixes of weights that the deterministic policy does not use.
        activation: The default between the layers.
        squashed: Whether a tanh and a rescaling to the action bounds come last; otherwise the
            actions are clipped to the bounds.
        package: Where the class is imported from, with trust only.
        quantiles: Entry of the record with the number of quantiles that stand for each score.
    """

    algorithm: str
    marks: Mapping[str, float | None]
    policies: frozenset[str]
    layers: tuple[str, ...]
    unused: tuple[str, ...]
    activation: type[nn.Module]
    squashed: bool
    package: str = field(default="stable_baselines3")
    quantiles: str | None = None


def _known(module: str, policy: str) -> frozenset[str]:
    """Return the classes of an algorithm's policies on vectors, and on dictionaries of them."""
    return frozenset({f"{module}.{policy}", f"{module}.MultiInputPolicy"})


_GAUSSIAN = {
    "layers": ("actor.latent_pi", "actor.mu"),
    "unused": ("actor.log_std", "critic", "critic_target"),
    "activation": nn.ReLU,
    "squashed": True,
}
_DETERMINISTIC = {
    "policies": _known("stable_baselines3.td3.policies", "TD3Policy"),
    "layers": ("actor.mu",),
    "unused": ("actor_target", "critic", "critic_target"),
    "activation": nn.ReLU,
    "squashed": True,
}
_ON_POLICY = {
    "policies": frozenset(
        {
            "stable_baselines3.common.policies.ActorCriticPolicy",
            "stable_baselines3.common.policies.MultiInputActorCriticPolicy",
            "stable_baselines3.ppo.policies.PPOPolicy",  # until 0.7
        }
    ),
    # Before 1.8 the policy and the value function could share their first layers.
    "layers": ("mlp_extractor.shared_net", "mlp_extractor.policy_net", "action_net"),
    "unused": ("log_std", "mlp_extractor.value_net", "value_net"),
    "activation": nn.Tanh,
    "squashed": False,
}
_OF_CHOICES = {"activation": nn.ReLU, "squashed": False}
# Nothing in a zip names its algorithm: the settings it was saved with tell. The first one fits.
RECIPES = (
    Recipe(
        "TQC",
        {"top_quantiles_to_drop_per_net": None},
        _known("sb3_contrib.tqc.policies", "TQCPolicy"),
        package="sb3_contrib",
        **_GAUSSIAN,
    ),
    Recipe(
        "SAC",
        # CrossQ has the first two as well, and batch normalisation in its actor.
        {"target_entropy": None, "ent_coef": None, "target_update_interval": None},
        _known("stable_baselines3.sac.policies", "SACPolicy"),
        **_GAUSSIAN,
    ),
    Recipe(
        "QRDQN",
        {"exploration_fraction": None, "n_quantiles": None},
        _known("sb3_contrib.qrdqn.policies", "QRDQNPolicy"),
        ("quantile_net.quantile_net",),
        ("quantile_net_target",),
        package="sb3_contrib",
        quantiles="n_quantiles",
        **_OF_CHOICES,
    ),
    Recipe(
        "DQN",
        {"exploration_fraction": None, "target_update_interval": None},
        _known("stable_baselines3.dqn.policies", "DQNPolicy"),
        ("q_net.q_net",),
        ("q_net_target",),
        **_OF_CHOICES,
    ),
    Recipe("DDPG", {"policy_delay": 1, "target_noise_clip": 0.0}, **_DETERMINISTIC),
    Recipe("TD3", {"policy_delay": None, "target_noise_clip": None}, **_DETERMINISTIC),
    Recipe("TRPO", {"cg_max_steps": None}, package="sb3_contrib", **_ON_POLICY),
    Recipe("PPO", {"clip_range": None, "n_epochs": None}, **_ON_POLICY),
    Recipe("A2C", {"vf_coef": None, "gae_lambda": None}, **_ON_POLICY),
)

# Those without weights and random numbers; stable-baselines3 makes them without arguments.
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    f"<class '{kind.__module__}.{kind.__qualname__}'>": kind
    for kind in (
        *(nn.CELU, nn.ELU, nn.GELU, nn.Hardswish, nn.Hardtanh, nn.Identity, nn.LeakyReLU, nn.Mish),
        *(nn.ReLU, nn.ReLU6, nn.SELU, nn.SiLU, nn.Sigmoid, nn.Softplus, nn.Softsign, nn.Tanh),
    )
}
# Those that lay the numbers of an observation side by side; images in it have weights.
_SIDE_BY_SIDE = {
    "<class 'stable_baselines3.common.torch_layers.CombinedExtractor'>",
    "<class 'stable_baselines3.common.torch_layers.FlattenExtractor'>",
    "<class 'stable_baselines3.common.policies.FlattenExtractor'>",  # until 0.8
}
# Settings of a policy that do not change what its deterministic actor computes (layer sizes are
# seen in the weights). Any other may, and is refused.
_HARMLESS = {
    *("clip_mean", "device", "features_extractor_kwargs", "full_std", "log_std_init", "n_critics"),
    *("n_quantiles", "net_arch", "normalize_images", "optimizer_class", "optimizer_kwargs"),
    *("ortho_init", "sde_net_arch", "share_features_extractor", "use_expln"),
    *("enable_critic_lstm", "lstm_hidden_size", "n_lstm_layers", "shared_lstm"),
}
# Policies that are not read, trusted or not, and what to do instead.
_UNFIT = {
    r"sb3_contrib\..*recurrent.*(Cnn|MultiInput)": (
        "a policy with memory on images or dictionaries",
        "choose or train an agent with memory on flat observations",
    ),
    r"(stable_baselines3|sb3_contrib)\..*Cnn": ("a policy on images", f"{ITSELF} with probes=0"),
    r"sb3_contrib\..*maskable.*MultiInput": (
        "a policy with masks on dictionaries of observations",
        ITSELF,
    ),
    r"sbx\.": ("a policy of sbx, whose weights are JAX's", ITSELF),
    r"stable_baselines\.": ("a policy of stable-baselines 2, of TensorFlow", ITSELF),
}


def check_policy(record: Record, source: str) -> None:
    """Refuse a policy on images, with masks on dictionaries, or of another library.

    Raises:
        ExpertError: If it is one.
    """
    policy = _policy_class(record)
    for pattern, (reason, next_step) in _UNFIT.items():
        if re.match(pattern, policy):
            raise ExpertError(
                f"{source} holds {reason} ({policy})",
                "a policy of stable-baselines3 on flat observations, without memory",
                next_step,
            )


def find_recipe(record: Record, source: str) -> Recipe:
    """Return the recipe of the algorithm that wrote the record.

    Raises:
        ExpertError: If it is none of those known.
    """
    for recipe in RECIPES:
        if all(
            key in record and value in (None, record[key]) for key, value in recipe.marks.items()
        ):
            return recipe
    raise ExpertError(
        f"{source} holds no agent of a known algorithm (its policy: {_policy_class(record)})",
        f"one of {', '.join(sorted(recipe.algorithm for recipe in RECIPES))}",
        ITSELF,
    )


def has_usual_policy(record: Record, recipe: Recipe) -> bool:
    """Whether the policy is the algorithm's own class for flat observations."""
    return _policy_class(record) in recipe.policies


def read_activation(record: Record, recipe: Recipe, source: str) -> type[nn.Module]:
    """Check that the policy is a plain MLP, and return the activation between its layers.

    Raises:
        ExpertError: If it is another policy, with the reason.
    """
    if not has_usual_policy(record, recipe):
        expected = " or ".join(sorted(recipe.policies))
        raise _cannot(source, f"has the policy class {_policy_class(record)}", expected)
    settings = record.get("policy_kwargs") or {}
    if not isinstance(settings, dict):
        raise ExpertError(
            f"{source}: policy_kwargs is no dictionary", "the policy's settings", TRUST
        )
    if record.get("use_sde") or settings.get("use_sde"):
        raise _cannot(source, "uses gSDE", "a policy with plain Gaussian noise or none")
    if settings.get("squash_output"):
        raise _cannot(source, "squashes its output", "the usual output of its algorithm")
    extractor = _text(settings, "features_extractor_class")
    if extractor is not None and extractor not in _SIDE_BY_SIDE:
        expected = "FlattenExtractor, or CombinedExtractor"
        raise _cannot(source, f"has the feature extractor {extractor}", expected)
    activation = _text(settings, "activation_fn")
    if activation is not None and activation not in _ACTIVATIONS:
        names = ", ".join(kind.__name__ for kind in _ACTIVATIONS.values())
        raise _cannot(source, f"has the activation {activation}", f"one of {names}")
    checked = {"use_sde", "squash_output", "features_extractor_class", "activation_fn"}
    # The two entries in colons are the pickle of the whole dictionary, and its type.
    unknown = set(settings) - _HARMLESS - checked - {":type:", ":serialized:"}
    if unknown:
        raise _cannot(
            source,
            f"has the setting {', '.join(sorted(unknown))}",
            "the policy_kwargs of stable-baselines3's own MLP policies",
        )
    return recipe.activation if activation is None else _ACTIVATIONS[activation]


def _text(settings: Record, name: str) -> str | None:
    return None if settings.get(name) is None else str(settings[name])


def _policy_class(record: Record) -> str:
    entry = record.get("policy_class", record.get("policy"))  # in stable-baselines 2 the latter
    entry = entry if isinstance(entry, dict) else {}
    # A class is recorded by its dictionary, which has its module but not its name: only the
    # names of its functions tell.
    function = re.match(r"<function (\w+)\.__init__ at ", str(entry.get("__init__")))
    return shown(f"{entry.get('__module__')}.{function[1] if function else '?'}")


def _cannot(source: str, found: str, expected: str) -> ExpertError:
    return ExpertError(
        f"{source} {shown(found)}, which can't be read without unpickling", expected, TRUST
    )
