"""The deterministic actor of a SAC agent as plain numpy arrays, and its evaluation.

Needs only numpy and gymnasium, so an exporter can read and check an expert without the library
that trained it.
"""

from dataclasses import dataclass, fields

import gymnasium
import numpy as np


@dataclass(frozen=True)
class Actor:
    """The deterministic actor; weights are (outputs, inputs), as torch's Linear keeps them.

    action = low + (tanh(w_mean relu(w1 relu(w0 x + b0) + b1) + b_mean) + 1) / 2 (high - low)
    """

    w0: np.ndarray
    b0: np.ndarray
    w1: np.ndarray
    b1: np.ndarray
    w_mean: np.ndarray
    b_mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __call__(self, observation):
        hidden = np.maximum(observation @ self.w0.T + self.b0, 0)
        hidden = np.maximum(hidden @ self.w1.T + self.b1, 0)
        squashed = np.tanh(hidden @ self.w_mean.T + self.b_mean)
        return self.low + (squashed + 1) / 2 * (self.high - self.low)


def extract_actor(model):
    """The Actor of a stable-baselines3 or sbx SAC model."""
    if not hasattr(model.policy, "actor_state"):  # stable-baselines3, in torch
        layers = [model.actor.latent_pi[0], model.actor.latent_pi[2], model.actor.mu]
        weights = [[p.detach().numpy() for p in (layer.weight, layer.bias)] for layer in layers]
    else:
        # flax numbers the layers as they are called: hidden, hidden, mean, log_std; its kernels
        # are (inputs, outputs).
        parameters = model.policy.actor_state.params["params"]
        layers = [parameters[f"Dense_{i}"] for i in range(3)]
        weights = [[np.asarray(layer["kernel"]).T, np.asarray(layer["bias"])] for layer in layers]
    arrays = [array for pair in weights for array in pair]
    arrays += [model.action_space.low, model.action_space.high]
    return Actor(*(np.array(array, dtype=np.float32, order="C") for array in arrays))


def save_actor(actor, path):
    np.savez(path, **{field.name: getattr(actor, field.name) for field in fields(Actor)})


def load_actor(path):
    with np.load(path) as arrays:
        return Actor(**arrays)


def check_actor(model, actor):
    """The largest difference to the library's own actions on up to 2,000 observations seen."""
    buffer = model.replay_buffer
    seen = buffer.observations[: buffer.buffer_size if buffer.full else buffer.pos]
    observations = seen.reshape(-1, seen.shape[-1])[-2000:]
    expected, _ = model.predict(observations, deterministic=True)
    difference = float(np.abs(actor(observations) - expected).max())
    if difference > 1e-4:  # float32 rounding stays below 1e-5
        raise RuntimeError(f"the extracted actor differs from the model by {difference:.2g}")
    return difference


def evaluate(actor, environment_id, episodes, seed):
    """Returns and lengths of whole episodes, each from its own fixed seed."""
    environment = gymnasium.make(environment_id)
    returns, lengths = [], []
    for episode in range(episodes):
        observation, _ = environment.reset(seed=seed + episode)
        total, length, over = 0.0, 0, False
        while not over:
            action = actor(observation.astype(np.float32))
            observation, reward, terminated, truncated, _ = environment.step(action)
            total, length, over = total + float(reward), length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
    environment.close()
    return {
        "episodes": episodes,
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "min_return": float(np.min(returns)),
        "mean_length": float(np.mean(lengths)),
    }
