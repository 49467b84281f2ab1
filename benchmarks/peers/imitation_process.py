"""Cloning and DAgger by imitation, inside its environment; see `ask_peer`.

Reads job.json and given.npz, trains, and writes the policy's weights at every checkpoint.
"""

import json
import time
from functools import partial

import gymnasium
import numpy as np
import onnxruntime
import torch
from imitation.algorithms.bc import BC
from imitation.algorithms.dagger import ExponentialBetaSchedule, SimpleDAggerTrainer
from imitation.data.types import Transitions
from imitation.policies.base import NonTrainablePolicy, NormalizeFeaturesExtractor
from imitation.util.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv


class Starts(gymnasium.Wrapper):
    """An environment whose episodes begin with given seeds, one after another, then by chance."""

    def __init__(self, env, seeds):
        super().__init__(env)
        self.seeds, self.steps = list(seeds), 0

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=self.seeds.pop(0) if self.seeds else seed, options=options)

    def step(self, action):
        self.steps += 1
        return self.env.step(action)


class OnnxExpert(NonTrainablePolicy):
    """The expert's file, asked as imitation asks an expert."""

    def __init__(self, path, env):
        super().__init__(env.observation_space, env.action_space)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options)
        self.name = self.session.get_inputs()[0].name

    def _choose_action(self, observation):
        return self.session.run(None, {self.name: observation[None].astype(np.float32)})[0][0]


def policy_of(env, hidden, normalise):
    """Return a policy of stable-baselines3; BC's own optimiser trains it."""
    kind = {"features_extractor_class": NormalizeFeaturesExtractor} if normalise else {}
    spaces = env.observation_space, env.action_space
    return ActorCriticPolicy(*spaces, lambda _: 0.0, net_arch=list(hidden), **kind)


def weights_of(policy):
    """Return the layers of a policy's mean action, and what its observations are scaled by."""
    size = policy.observation_space.shape[0]
    norm = getattr(policy.features_extractor, "normalize", None)
    mean, scale = np.zeros(size), np.ones(size)
    if norm is not None:
        mean, scale = norm.running_mean.numpy(), (norm.running_var + norm.eps).sqrt().numpy()
    found = {"mean": mean.copy(), "scale": scale}
    layers = (*policy.mlp_extractor.policy_net, policy.action_net)
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for number, layer in enumerate(linear):
        found[f"weight {number}"] = layer.weight.detach().numpy().copy()
        found[f"bias {number}"] = layer.bias.detach().numpy().copy()
    return found


class Checkpoints:
    """Weights at every so manieth call, with the processor's seconds so far, less their saving."""

    def __init__(self, policy, env):
        self.policy, self.env = policy, env
        self.kept, self.away, self.calls = [], 0.0, 0
        self.started = time.process_time()

    def __call__(self, every):
        self.calls += 1
        if self.calls % every == 0:
            now = time.process_time()
            spent = now - self.started - self.away
            self.kept.append((spent, self.env.steps, weights_of(self.policy)))
            self.away += time.process_time() - now


def main():
    with open("job.json") as file:
        job = json.load(file)
    given = np.load("given.npz")
    torch.set_num_threads(1)
    torch.manual_seed(job["seed"])
    random = np.random.default_rng(job["seed"])
    env = Starts(
        gymnasium.make(job["environment"], max_episode_steps=job["horizon"]),
        given["starts"].tolist(),
    )
    policy = policy_of(env, job["hidden"], job["normalise"])
    quiet = configure("log", [])
    trainer = partial(
        BC,
        observation_space=env.observation_space,
        action_space=env.action_space,
        rng=random,
        policy=policy,
        batch_size=job["batch_size"],
        optimizer_kwargs={"lr": job["learning_rate"]},
        ent_weight=job["entropy_weight"],
        l2_weight=job["l2_weight"],
        device="cpu",
        custom_logger=quiet,
    )
    checkpoints = Checkpoints(policy, env)
    if job["rounds"] is None:
        clone(trainer, job, given, checkpoints)
    else:
        aggregate(trainer, job, env, random, quiet, checkpoints)
    write(checkpoints, policy, given["observations"])


def clone(trainer, job, given, checkpoints):
    """Clone the given demonstrations."""
    states, actions = given["observations"], given["actions"]
    # Cloning looks at no successor; its loader asks for one.
    infos, dones = np.array([{}] * len(states)), np.zeros(len(states), bool)
    bc = trainer(demonstrations=Transitions(states, actions, infos, states, dones))
    every = max(1, job["batches"] // job["checkpoints"])
    bc.train(n_batches=job["batches"], on_batch_end=lambda: checkpoints(every), progress_bar=False)


def aggregate(trainer, job, env, random, quiet, checkpoints):
    """Collect and clone in rounds; a checkpoint is the end of a round."""
    rounds, decay = job["rounds"], job["rounds"]["beta_decay"]
    dagger = SimpleDAggerTrainer(
        venv=DummyVecEnv([lambda: env]),
        scratch_dir="dagger",
        expert_policy=OnnxExpert(job["expert"], env),
        rng=random,
        beta_schedule=None if decay is None else ExponentialBetaSchedule(decay),
        bc_trainer=trainer(),
        custom_logger=quiet,
    )
    epochs, batches = rounds["epochs"], rounds["batches"]
    told = {"on_batch_end": lambda: checkpoints(batches)}
    if batches is None:
        told = {"on_epoch_end": lambda: checkpoints(epochs)}
    dagger.train(
        rounds["total"],
        rollout_round_min_episodes=rounds["episodes"],
        rollout_round_min_timesteps=rounds["steps"],
        bc_train_kwargs={
            "n_epochs": epochs,
            "n_batches": batches,
            "log_rollouts_venv": None,
            "progress_bar": False,
            **told,
        },
    )


def write(checkpoints, policy, states):
    """Write all checkpoints, the last one beside what the policy itself answers there."""
    result = {
        "seconds": [seconds for seconds, _, _ in checkpoints.kept],
        "environment_steps": [steps for _, steps, _ in checkpoints.kept],
    }
    with open("result.json", "w") as file:
        json.dump(result, file)
    found = {
        f"{number}/{name}": array
        for number, (_, _, weights) in enumerate(checkpoints.kept)
        for name, array in weights.items()
    }
    np.savez("found.npz", answers=policy.predict(states, deterministic=True)[0], **found)


main()
