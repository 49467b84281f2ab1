"""A linear expert to fit, without an environment."""

from dataclasses import replace

import numpy as np

from fdtasil.demonstrations.states import Demonstrations
from fdtasil.experts.load import load_expert
from fdtasil.probes.answers import ask_probes
from fdtasil.probes.scales import measure_scales
from fdtasil.probes.source import Probes
from fdtasil.probes.surroundings import Surroundings
from fdtasil.run.presets import PRESETS
from fdtasil.seeding import torch_generator
from fdtasil.student.architectures import Mlp
from fdtasil.student.policy import Student


def linear_task(states=200, n=6, m=2, spec=None):
    random = np.random.default_rng(0)
    gain = random.standard_normal((m, n)).astype(np.float32) / 4
    observations = random.standard_normal((states, n)).astype(np.float32)
    expert = load_expert(lambda rows: rows @ gain.T)
    number, actions = np.zeros(states, np.int32), expert.ask(observations, "label")
    demonstrations = Demonstrations(
        observations, actions, number, number, actions, np.zeros(states), number > 0
    )
    if spec is None:
        return demonstrations, None, None
    probes = (
        replace(PRESETS["standard"], calibrated=False).complete(Probes.parse(spec)).with_order(1)
    )
    scales = measure_scales(observations)

    around = Surroundings.of(observations, probes, scales)

    def ask(sample):
        return ask_probes(expert, around, np.random.default_rng(sample))

    return demonstrations, probes, ask


def stream(name):
    return torch_generator(0, name)


def new_student(n=6, m=2, hidden=32):
    zeros, ones, bound = np.zeros(n), np.ones(n), np.full(m, 3.0)
    return Student(Mlp(hidden), zeros, ones, -bound, bound, torch_generator(0))
