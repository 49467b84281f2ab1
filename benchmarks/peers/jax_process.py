"""The paper's loss in JAX, inside its environment: one core, whole trainings in one call.

A line on the standard input is 0 (plain cloning) or 1 (with probes); the answer is the
processor's seconds of a training.
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

*SIZES, RADIUS = sys.argv[1:]
N, M, HIDDEN, BATCH, STATES, PROBES, STEPS = map(int, SIZES)
WEIGHT = 0.5
OPTIMISER = optax.adamw(optax.cosine_decay_schedule(1e-3, STEPS), weight_decay=0.01)


def start():
    """Return weights and biases of two hidden layers."""
    key, orthogonal = jax.random.key(0), jax.nn.initializers.orthogonal()
    sizes = zip((N, HIDDEN, HIDDEN), (HIDDEN, HIDDEN, M), strict=True)
    keys = jax.random.split(key, 3)
    return [(orthogonal(k, size), jnp.zeros(size[1])) for k, size in zip(keys, sizes, strict=True)]


def act(layers, states):
    """Answer (B, n) states with (B, m) actions."""
    for weights, bias in layers[:-1]:
        states = jax.nn.gelu(states @ weights + bias, approximate=False)
    weights, bias = layers[-1]
    return jnp.tanh(states @ weights + bias)


def plain(layers, batch):
    """Return the mean norm of the actions' error."""
    states, actions, _, _ = batch
    return jnp.linalg.norm(act(layers, states) - actions, axis=-1).mean()


def taylor(layers, batch):
    """Return the same, and the norm of the differences' error along all probes of a state."""
    states, actions, along, values = batch
    points = jnp.concatenate([states, (states[:, None] + along).reshape(-1, N)])
    answers = act(layers, points)
    error = answers[: len(states)] - actions
    there = answers[len(states) :].reshape(values.shape) - values
    differences = (there - error[:, None]).reshape(len(states), -1)
    scaled = jnp.linalg.norm(differences, axis=-1).mean() / float(RADIUS) / PROBES**0.5
    return jnp.linalg.norm(error, axis=-1).mean() + WEIGHT * scaled


@partial(jax.jit, static_argnums=0)
def train(loss, data, order):
    """Take all steps; `order` (STEPS, B) says which states each sees."""

    def step(state, rows):
        layers, memory = state
        slopes = jax.grad(loss)(layers, [array[rows] for array in data])
        updates, memory = OPTIMISER.update(slopes, memory, layers)
        return (optax.apply_updates(layers, updates), memory), None

    layers = start()
    return jax.lax.scan(step, (layers, OPTIMISER.init(layers)), order)[0][0]


def main():
    random = np.random.default_rng(0)
    states = random.standard_normal((STATES, N), np.float32)
    along = random.standard_normal((STATES, PROBES, N), np.float32)
    along *= float(RADIUS) * N**0.5 / np.linalg.norm(along, axis=-1, keepdims=True)
    values = np.tanh((states[:, None] + along)[..., :M])
    data = [jnp.asarray(a) for a in (states, np.tanh(states[:, :M]), along, values)]
    rounds = -(-STEPS * BATCH // STATES)
    order = np.concatenate([random.permutation(STATES) for _ in range(rounds)])
    order = jnp.asarray(order[: STEPS * BATCH].reshape(STEPS, BATCH))
    for line in sys.stdin:
        begun = time.process_time()
        jax.block_until_ready(train((plain, taylor)[int(line)], data, order))
        print(time.process_time() - begun, flush=True)


main()
