"""Training: what a step costs, what it visits, when it asks."""

import platform
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_tasks import linear_task, new_student, stream

from fdtasil.compute import pick_device, torch_settings
from fdtasil.errors import FdtasilWarning, FitError, SettingError
from fdtasil.probes.answers import Answers
from fdtasil.probes.scales import measure_scales
from fdtasil.run.presets import preset_of
from fdtasil.student.batches import Batches
from fdtasil.student.fit import Fit, Hooks, fit, hold_out


def train(spec=None, student=None, **changes):
    demonstrations, probes, ask = linear_task(spec=spec)
    student = student or new_student()
    settings = Fit(**{"steps": 300, **changes})
    history = fit(student, demonstrations, probes, ask, settings, stream)
    return student, history


@pytest.mark.parametrize("spec", [None, "4", "basis,central", "orthogonal:6", "sphere:2,resample"])
def test_every_source_learns(spec):
    _, history = train(spec, steps=600)
    assert [entry["step"] for entry in history] == [100, 200, 300, 400, 500, 600]
    assert history[-1]["action_error"] < 0.2 * history[0]["action_error"]
    assert (history[-1]["derivative_error"] > 0) == (spec is not None)


def test_probes_teach_the_derivative():
    """On fresh probes around few states, which plain cloning knows nothing about."""
    demonstrations, probes, ask = linear_task(states=12, spec="8")
    settings = Fit(steps=500)
    errors = {}
    for name, source in {"cloning": None, "probes": probes}.items():
        student = new_student()
        fit(student, demonstrations, source, ask if source else None, settings, stream)
        fresh = ask(99)
        points = demonstrations.observations[:, None] + fresh.displacements[fresh.numbers]
        answers = student.act(points.reshape(-1, 6)).reshape(fresh.values[:, :, 0].shape)
        errors[name] = np.abs(answers - fresh.values[:, :, 0]).mean()
    assert errors["probes"] < 0.5 * errors["cloning"]


def test_the_cost_of_a_step_does_not_grow_with_the_stored_probes():
    """50 stored probes against none, in turn in one process: the issue's bound is 3."""
    sizes = {"n": 17, "m": 6}
    cost = {}
    with torch_settings(torch.device("cpu")):
        for spec in (None, "50") * 3:
            demonstrations, probes, ask = linear_task(states=1000, spec=spec, **sizes)
            student = new_student(**sizes, hidden=(512, 512))
            settings = Fit(steps=60)
            start = time.process_time()
            fit(student, demonstrations, probes, ask, settings, stream)
            cost[spec] = min(cost.get(spec, np.inf), time.process_time() - start)
    assert cost["50"] / cost[None] < 3


@pytest.mark.parametrize(("spec", "epochs"), [("5", 5), ("sphere:6,per_step=2", 3)])
def test_every_epoch_visits_each_state_once_and_every_probe_comes_up(spec, epochs):
    demonstrations, probes, ask = linear_task(states=50, spec=spec)
    answers = ask(0)
    batches = Batches(demonstrations, probes, ask, stream, torch.device("cpu"))
    seen = []
    for epoch in range(epochs):
        dealt = list(batches.epoch(epoch, torch.arange(50), 4))
        states = torch.cat([batch.observations for batch in dealt]).numpy()
        assert np.array_equal(
            np.sort(states, axis=0), np.sort(demonstrations.observations, axis=0)
        )
        used = torch.cat([batch.probes.values[:, :, 0] for batch in dealt])
        seen.append(used.flatten(0, 1).numpy())
    stored = answers.values[:, :, 0].reshape(-1, 2)
    used = np.concatenate(seen)
    assert np.array_equal(stored[np.lexsort(stored.T)], used[np.lexsort(used.T)])


def test_a_minibatch_mixes_the_directions():
    """Each state begins with another one: a basis is not gone through one by one by all."""
    demonstrations, probes, ask = linear_task(states=50, spec="basis")
    batches = Batches(demonstrations, probes, ask, stream, torch.device("cpu"))
    for batch in batches.epoch(0, torch.arange(50), 2):
        moved = (batch.probes.displacements[:, 0] != 0).sum(dim=0)
        assert 0 < moved.min() <= moved.max() < 15


def test_every_epoch_has_an_order_and_minibatches_of_its_own():
    """A gradient over neighbours in time, or over the same states again, is less than a sample."""
    demonstrations, _, _ = linear_task(states=50)
    batches = Batches(demonstrations, None, None, stream, torch.device("cpu"))
    given = {tuple(row): number for number, row in enumerate(demonstrations.observations)}
    halves = []
    for epoch in range(3):
        first, _ = batches.epoch(epoch, torch.arange(50), 2)
        halves.append(frozenset(given[tuple(row)] for row in first.observations.numpy()))
    assert len(set(halves)) == 3
    assert frozenset(range(25)) not in halves


@pytest.mark.parametrize(("spec", "samples"), [("3", 1), ("3,resample", 4), ("3,per_step=2,resample", 7)])  # fmt: skip  # noqa: E501
def test_the_expert_is_asked_as_often_as_predicted(spec, samples):
    spec = f"sphere:{spec}"
    demonstrations, probes, ask = linear_task(states=50, spec=spec)
    asked = []

    def counted(sample):
        asked.append(sample)
        return ask(sample)

    settings = Fit(steps=20, batch_size=25)
    fit(new_student(), demonstrations, probes, counted, settings, stream)
    visits = settings.schedule().visits(50)
    assert visits == 10
    assert asked == list(range(samples))
    assert probes.samples(6, visits) == samples


@pytest.mark.fault(95, 97, 98)
@pytest.mark.parametrize(("states", "batches"), [(1, [1]), (7, [7]), (101, [51, 50])])
def test_few_states_and_a_state_left_over(states, batches):
    demonstrations, _, _ = linear_task(states=states)
    settings = Fit(steps=5)
    history = fit(new_student(), demonstrations, None, None, settings, stream)
    assert history[-1]["step"] == 5
    assert np.isfinite(list(history[-1].values())).all()
    dealt = Batches(demonstrations, None, None, stream, torch.device("cpu"))
    every = dealt.epoch(0, torch.arange(states), settings.schedule().steps_an_epoch(states))
    assert [len(batch.observations) for batch in every] == batches


def test_an_epoch_visits_the_states_that_are_not_held_out():
    """Two of four episodes, of fifty states each: one minibatch an epoch."""
    demonstrations = replace(linear_task()[0], episode=np.repeat(np.arange(4), 50))
    steps, epochs = [], []
    hooks = Hooks(begin=steps.append, checkpoint=lambda state: epochs.append(state.step))
    settings = Fit(epochs=3, validation=0.5)
    fit(new_student(), demonstrations, None, None, settings, stream, hooks=hooks)
    assert (steps, epochs) == ([3], [1, 2])


def test_the_weights_of_the_best_validation_are_left():
    """Labels of noise are learnt by heart: what is held out tells so."""
    random = np.random.default_rng(0)
    noise, episode = random.standard_normal((40, 2)), np.repeat(np.arange(4), 10)
    demonstrations = replace(
        linear_task(states=40)[0], actions=noise.astype(np.float32), episode=episode
    )
    settings, student = Fit(300, batch_size=7, learning_rate=0.01, validation=0.25), new_student()
    history = fit(student, demonstrations, None, None, settings, stream)
    losses = [entry["validation_loss"] for entry in history]
    assert min(losses) < losses[-1]
    _, held = hold_out(demonstrations, settings, stream("held out"))
    apart = student.act(demonstrations.observations[held]) - noise[held]
    found = np.linalg.norm(apart / student.action_units.numpy(), axis=1).mean()
    assert found == pytest.approx(min(losses), rel=1e-4)


@pytest.mark.parametrize(("spec", "expected"), [("3", 4000), ("3,resample", 12_000)])
def test_what_is_asked_anew_is_trained_on_for_longer(spec, expected):
    class Begun(Exception):
        pass

    def begin(steps):
        raise Begun(steps)

    demonstrations, probes, ask = linear_task(spec=spec)
    with pytest.raises(Begun) as told:
        fit(new_student(), demonstrations, probes, ask, Fit(), stream, hooks=Hooks(begin=begin))
    assert told.value.args == (expected,)


@pytest.mark.fault(100)
def test_a_loss_that_is_not_finite_stops_the_training():
    demonstrations, _, _ = linear_task()
    demonstrations.actions[3, 0] = np.nan
    with pytest.raises(FitError, match=r"the loss became nan at step [12]\n"):
        fit(new_student(), demonstrations, None, None, Fit(), stream)


@pytest.mark.fault(100)
def test_a_state_that_is_not_finite_is_never_handed_on():
    """One NaN label: its epoch spoils all weights, long before the history has an entry."""
    demonstrations, _, _ = linear_task()
    demonstrations.actions[3, 0] = np.nan
    kept = []
    hooks = Hooks(checkpoint=lambda state: kept.append(state.to_bytes()))
    with pytest.raises(FitError, match="at step") as error:
        fit(new_student(), demonstrations, None, None, Fit(), stream, hooks=hooks)
    assert kept == []
    assert len(str(error.value).splitlines()) <= 6


@pytest.mark.fault(100)
def test_weights_that_overflow_in_the_last_step_are_found():
    """Its loss, of the weights before, is finite."""
    with pytest.raises(FitError, match="weights are not finite after step 1"):
        train(steps=1, learning_rate=1e38)
    with pytest.raises(FitError, match="the loss became"):
        train(steps=300, learning_rate=1e38)


@pytest.mark.fault(97)
def test_one_state_has_raw_scales():
    scales = measure_scales(np.float32([[3, 0, -1e6]]))
    assert scales.deviation.tolist() == scales.scale.tolist() == [1, 1, 1]
    assert scales.live.all()


def test_equal_seeds_give_equal_weights():
    first, _ = train("4")
    second, _ = train("4")
    assert first.to_bytes() == second.to_bytes()


def test_steps_and_epochs_are_two_ways_to_say_one_thing():
    assert Fit(epochs=3).schedule().total_steps(200) == 6
    assert Fit(epochs=3).schedule().visits(200) == 3
    assert Fit(steps=7).schedule().visits(200) == 4
    with pytest.raises(SettingError, match="one of the two"):
        Fit(steps=1, epochs=1)


def test_the_settings_of_adamw_reach_it():
    """Ten steps of 0.001 at first, by a cosine: five and a half in all."""

    def weights(student):
        return torch.cat([p.detach().flatten() for p in student.parameters()])

    def moved(**changes):
        student, _ = train(steps=10, **changes)
        return weights(student)

    start, still = weights(new_student()), {"learning_rate": 1e-3, "weight_decay": 0}
    assert float((moved(**still) - start).abs().max()) == pytest.approx(5.5e-3, rel=0.1)
    for slow in ({"epsilon": 1e3}, {"max_gradient_norm": 1e-12}):
        assert float((moved(**still, **slow) - start).abs().max()) < 1e-5
    decayed = moved(learning_rate=1e-3, weight_decay=20, epsilon=1e3)
    assert float(decayed.norm() / start.norm()) == pytest.approx(1 - 20 * 5.5e-3, rel=0.01)


def test_a_preset_with_other_settings_keeps_the_rest():
    paper = preset_of("paper")
    assert paper.fit_with(steps=7) == replace(paper.fit, steps=7, epochs=None)
    assert paper.fit_with(epochs=3, weight=None) == replace(paper.fit, epochs=3)
    assert preset_of("standard").fit_with() == Fit()
    with pytest.raises(SettingError, match="one of the two"):
        paper.fit_with(steps=1, epochs=1)


def test_much_data_is_trained_on_for_longer_unless_steps_are_given():
    assert [Fit().schedule().total_steps(n) for n in (1, 1500, 6000)] == [4000, 4000, 8000]
    assert Fit().schedule().total_steps(2000) == 4600  # whole hundreds: of an entry each
    assert Fit(steps=7).schedule().total_steps(6000) == 7


@pytest.mark.parametrize(
    ("share", "episodes", "held"),
    [(0, 9, 0), (0.3, 1, 0), (0.3, 10, 3), (0.01, 10, 1), (0.9, 2, 1), (0.95, 3, 2)],
)
def test_validation_holds_one_episode_out_at_least_and_leaves_one_to_learn(share, episodes, held):
    assert Fit(validation=share).held_out(episodes) == held


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"batch_size": 2.5}, {"weight": -1.0}, {"learning_rate": float("nan")}]
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(SettingError):
        Fit(**wrong)


def test_answers_of_two_rounds_are_joined():
    _, _, ask = linear_task(states=5, spec="3")
    first, second = ask(0), ask(1)
    both = first + second
    assert isinstance(both, Answers)
    expected = [a.displacements[a.numbers] for a in (first, second)]
    assert np.array_equal(both.displacements[both.numbers], np.concatenate(expected))


def test_a_later_round_with_more_probes_keeps_all_of_them():
    """As a basis has, where a coordinate begins to move: the other states have some twice."""
    two, three = (linear_task(states=5, spec=f"sphere:{count}")[2](0) for count in (2, 3))
    for first, second in ((two, three), (three, two)):
        both = first + second
        for rows, one in ((np.arange(5), first), (np.arange(5, 10), second)):
            columns = [0, 1, 0] if one is two else [0, 1, 2]
            part, moved = both.at(rows), one.displacements[one.numbers]
            assert np.array_equal(part.displacements[part.numbers], moved[:, columns])
            assert np.array_equal(part.values, one.values[:, columns])


def test_torch_settings_are_put_back():
    torch.set_num_threads(2)
    torch.set_float32_matmul_precision("high")
    try:
        with torch_settings(torch.device("cpu"), threads=1) as precision:
            assert torch.get_num_threads() == 1
            assert precision == torch.get_float32_matmul_precision()
        assert torch.get_num_threads() == 2
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_num_threads(1)
        torch.set_float32_matmul_precision("highest")


_LARGE_STEPS = """
import resource, torch
from fdtasil.compute import torch_settings

states, layers = torch.randn(2_550, 17), [torch.nn.Linear(17, 512), torch.nn.Linear(512, 512)]
network = torch.nn.Sequential(layers[0], torch.nn.GELU(), layers[1], torch.nn.GELU())

def new_pages(steps):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(steps):
        network.zero_grad()
        network(states).square().mean().backward()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

with torch_settings(torch.device("cpu")):
    print(new_pages(6), new_pages(10))
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator than glibc's")
def test_a_step_takes_the_memory_that_the_last_one_freed():
    """A system that gives new pages each time takes a third of a step with fifty probes."""
    command = [sys.executable, "-c", _LARGE_STEPS]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    first, others = map(int, done.stdout.split())
    assert first > 10_000
    assert others < 10_000  # a tensor may move once; with new ones at every step, 40,000 and more


@pytest.mark.fault(105)
@pytest.mark.parametrize("device", ["gpu", "mps", "cuda", "", None])
def test_a_device_that_is_not_there_is_refused(device):
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(SettingError, match=f"device={device!r}"):
        pick_device(device)


@pytest.mark.fault(105)
def test_a_gpu_beyond_the_last_one_is_refused(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    assert pick_device("cuda").type == "cuda"
    with pytest.raises(SettingError, match=r"device='cuda:1', and this torch sees 1 GPU"):
        pick_device("cuda:1")


@pytest.mark.fault(91)
def test_answers_that_take_much_memory_are_announced_before_they_are_asked(monkeypatch):
    monkeypatch.setattr("fdtasil.probes.answers._MUCH", 1000)
    _, _, ask = linear_task(states=50, spec="5")
    with pytest.warns(FdtasilWarning, match=r"50 states x 5 probes, take 0\.0 GiB"):
        ask(0)
