"""Rivals beside this library: what runs without them, and what is said where there are none."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("joblib", reason="needs the extra: pip install 'fdtasil[bench]'")

sys.path.append(str(Path(__file__).parents[1]))  # the benchmarks are not installed
from benchmarks.peers import BENCHMARK, cloning, control, environment, process, step
from benchmarks.peers.environment import PEERS, PeerMissing
from benchmarks.peers.weights import checked_policy, policy_of


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(environment, "FOLDER", tmp_path)
    return tmp_path


def test_peers_without_an_environment_are_left_out_aloud(folder, capsys):
    assert BENCHMARK.cells(False) == []
    said = capsys.readouterr().err
    for name in PEERS:
        assert f"python -m benchmarks.peers {name}" in said
    with pytest.raises(PeerMissing, match=r"make it: python -m benchmarks\.peers jax"):
        process.ask_peer("jax", {}, {})


def test_cells_are_those_of_the_peers_that_are_here(folder):
    (folder / "imitation").mkdir()
    (folder / "imitation" / "ready").touch()
    cells = BENCHMARK.cells(False)
    assert {cell["what"] for cell in cells} == {"cloning"}
    assert len({json.dumps(cell) for cell in cells}) == len(cells)
    assert [cell["seed"] for cell in cells] == sorted(cell["seed"] for cell in cells)
    assert len(BENCHMARK.cells(True)) < len(cells)


def test_a_job_and_its_arrays_go_there_and_back(tmp_path, monkeypatch):
    script = tmp_path / "toy_process.py"
    script.write_text(
        "import json, os, numpy as np\n"
        "job, given = json.load(open('job.json')), np.load('given.npz')\n"
        "if job['fails']: raise SystemExit('this peer has no answer')\n"
        "json.dump({'threads': os.environ['OMP_NUM_THREADS']}, open('result.json', 'w'))\n"
        "np.savez('found.npz', doubled=2 * given['numbers'])\n"
    )
    monkeypatch.setattr(process, "command_of", lambda name: [sys.executable, str(script)])
    numbers = np.arange(3.0)
    result, found = process.ask_peer("toy", {"fails": False}, {"numbers": numbers})
    assert result == {"threads": "1"}
    np.testing.assert_array_equal(found["doubled"], 2 * numbers)
    with pytest.raises(RuntimeError, match="this peer has no answer"):
        process.ask_peer("toy", {"fails": True}, {"numbers": numbers})


def test_a_peers_network_is_judged_only_if_it_answers_as_itself():
    random = np.random.default_rng(0)
    arrays = {"mean": np.ones(3), "scale": np.full(3, 2.0), "low": np.array([-4.0])}
    arrays |= {"range": np.array([8.0]), "weight 0": random.standard_normal((5, 3))}
    arrays |= {"bias 0": np.zeros(5), "weight 1": random.standard_normal((1, 5))}
    arrays["bias 1"] = np.zeros(1)
    states, low, high = random.standard_normal((20, 3)), np.array([-4.0]), np.array([4.0])
    hidden = np.tanh((states - 1) / 2 @ arrays["weight 0"].T)
    answers = np.clip(8 * hidden @ arrays["weight 1"].T - 4, -4, 4)
    np.testing.assert_allclose(policy_of(arrays, low, high)(states), answers)
    assert len(np.unique(answers)) > 2
    checked_policy(arrays, low, high, states, answers)
    with pytest.raises(RuntimeError, match="otherwise than itself"):
        checked_policy(arrays, low, high, states, answers + 0.1)


def cloned(method, seed, reached):
    cell = {"what": "cloning", "method": method, "expert": "Walker2d-v5", "episodes": 5}
    result = {"normalized_return": 0.5 + seed / 2, "environment_steps": 1500, "queries": 1500}
    return {
        "cell": {**cell, "seed": seed},
        "result": result | {"seconds": 10.0, "seconds_to_enough": reached},
    }


def controlled(name, seed, **cell):
    result = {"queries": 5000, "seconds": 60.0, "microseconds": 70.0, "violations": 0.02}
    result |= {"expert_state_error": 0.2, "own_state_error": 0.25, "normalized_return": 1.0}
    return {
        "cell": {"what": "control", "seed": seed, **cell},
        "result": {name: result | {"expert_violations": 0.01}},
    }


def test_tables_are_drawn_of_what_is_there():
    times = {f"fdtasil, {name}": [4.0, 6.0, 8.0] for name in step.OURS}
    times |= {f"JAX, {name}": [2.0, 2.0, 4.0] for name in list(step.OURS)[:2]}
    rows = [
        {"cell": {"what": "step", "seed": 0}, "result": {"milliseconds": times}},
        *(controlled("do-mpc, tuned", seed, solves=5000) for seed in (0, 1)),
        controlled("fdtasil, 10 probes", 0, episodes=3),
        *(cloned("imitation, BC", seed, None) for seed in (0, 1)),
        *(cloned("fdtasil", seed, 7.0 if seed else None) for seed in (0, 1)),
    ]
    table = BENCHMARK.draw(json.loads(json.dumps(rows)))["peers.md"].decode()
    assert "| plain | 6.00 | 2.00 | 2.00 |" in table
    assert "| do-mpc, tuned | 2 | 5,000 | 0.200, 0.200 |" in table
    assert "| fdtasil, 10 probes | 1 |" in table
    assert "| Walker2d-v5 | imitation, BC | 5 | 2 | 0.50, 1.00 |" in table
    assert "| 10 | not reached |" in table
    assert "| 10 | 7 (1 of 2 seeds) |" in table
    assert "HalfCheetah-v5" not in table


def test_every_method_of_a_table_has_cells():
    methods = {cell["method"] for cell in cloning.cells(False)}
    assert methods == {*cloning.OURS, *cloning.THEIRS}
    assert sum("solves" in cell for cell in control.cells(False)) == len(control.SEEDS) + 1
