"""Approximate MPC by do-mpc, inside its environment; see `ask_peer`.

The plant, its limits and its cost are those of `examples/constrained_cart_pole.py`.
"""

import contextlib
import json
import sys
import time
from pathlib import Path

import casadi
import numpy as np
import torch
from do_mpc.approximateMPC import AMPCSampler, ApproxMPC, Trainer
from do_mpc.controller import MPC
from do_mpc.model import Model

sys.path.append(str(Path(__file__).parents[2] / "examples"))
import constrained_cart_pole as plant

CALLS = 2_000


def planner():
    """Return do-mpc's planner of that plant: the cost differs by that of the state it is at."""
    model = Model("discrete", "SX")
    state, force = model.set_variable("_x", "x", (4, 1)), model.set_variable("_u", "u")
    after = plant.stepped(casadi.vertsplit(state), force, casadi.sin, casadi.cos)
    model.set_rhs("x", casadi.vertcat(*after))
    model.setup()
    mpc = MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = plant.AHEAD, plant.STEP
    mpc.settings.store_full_solution = False
    mpc.settings.nlpsol_opts = {"ipopt.max_iter": 60}
    mpc.settings.supress_ipopt_output()
    far = casadi.dot(casadi.DM(plant.WEIGHTS), state**2)
    mpc.set_objective(mterm=far, lterm=far + plant.EFFORT * force**2)
    for side, sign in (("lower", -1), ("upper", 1)):
        mpc.bounds[side, "_x", "x"] = sign * np.array([plant.RAIL, np.inf, np.inf, np.inf])
        mpc.bounds[side, "_u", "u"] = sign * plant.FORCE
    mpc.setup()
    return mpc


def sample(mpc, box, count):
    """Solve at `count` states by chance in a box; what has no solution is left out."""
    sampler = AMPCSampler(mpc)
    sampler.settings.lbx, sampler.settings.ubx = -box, box
    sampler.settings.closed_loop_flag, sampler.settings.trajectory_length = True, 1
    sampler.settings.n_samples, sampler.settings.dataset_name = count, "drawn"
    sampler.setup()
    sampler.default_sampling()


def train(mpc, box, job):
    """Train a network on what was sampled."""
    approximate = ApproxMPC(mpc)
    approximate.settings.n_hidden_layers = job["hidden_layers"]
    approximate.settings.n_neurons = job["width"]
    approximate.settings.lbx, approximate.settings.ubx = torch.tensor(-box), torch.tensor(box)
    approximate.setup()
    trainer = Trainer(approximate)
    trainer.settings.dataset_name, trainer.settings.n_epochs = "drawn", job["epochs"]
    trainer.settings.batch_size = job["batch_size"]
    trainer.settings.scheduler_flag = True
    trainer.scheduler_settings.cooldown = 0
    trainer.scheduler_settings.patience = job["patience"]
    trainer.setup()
    trainer.default_training()
    return approximate, trainer.history["epoch"][-1] + 1


def weights_of(approximate, box):
    """Return the network's layers, and how its input and output are scaled."""
    found = {"mean": -box.ravel(), "scale": 2 * box.ravel()}
    found |= {"low": np.array([-plant.FORCE]), "range": np.array([2 * plant.FORCE])}
    layers = [layer for layer in approximate.net.layers if isinstance(layer, torch.nn.Linear)]
    for number, layer in enumerate(layers):
        found[f"weight {number}"] = layer.weight.detach().numpy()
        found[f"bias {number}"] = layer.bias.detach().numpy()
    return found


def microseconds(approximate, states):
    """Return the median time of a call, as a control loop calls it."""
    times = []
    for number in range(CALLS):
        state = states[number % len(states)][:, None]
        started = time.perf_counter()
        approximate.make_step(state)
        times.append(time.perf_counter() - started)
    return 1e6 * float(np.median(times))


def main():
    with open("job.json") as file:
        job = json.load(file)
    states = np.load("given.npz")["states"].astype(float)
    torch.set_num_threads(1)
    np.random.seed(job["seed"])  # do-mpc draws from numpy's global state
    box, mpc = np.array(job["box"])[:, None], planner()
    begun = time.process_time()
    sample(mpc, box, job["solves"])
    sampling, results, found = time.process_time() - begun, {}, {}
    for name, training in job["trainings"].items():
        torch.manual_seed(job["seed"])
        begun = time.process_time()
        approximate, epochs = train(mpc, box, training)
        results[name] = {
            "seconds": sampling + time.process_time() - begun,
            "sampling_seconds": sampling,
            "epochs": epochs,
            "microseconds": microseconds(approximate, states),
        }
        answers = np.array([approximate.make_step(state[:, None])[0] for state in states])
        arrays = {"answers": answers, **weights_of(approximate, box)}
        found |= {f"{name}/{key}": array for key, array in arrays.items()}
    np.savez("found.npz", **found)
    with open("result.json", "w") as file:
        json.dump(results, file)


with open("log.txt", "w") as log, contextlib.redirect_stdout(log):
    main()
