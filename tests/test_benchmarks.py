"""The runner of benchmarks: what is done is kept, what fails does not stop the rest."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

pytest.importorskip("joblib", reason="needs the extra: pip install 'fdtasil[bench]'")

from benchmarks.runner import Benchmark, read_rows, results_of, run
from benchmarks.statistics import interquartile_mean, interval, paired_difference

ROOT = Path(__file__).parent.parent


def double(cell):
    if cell["number"] == 3:
        raise ValueError("three is refused")
    return {"double": 2 * cell["number"]}


TOY = Benchmark("toy", "Doubles.", lambda quick: [], double, lambda rows: {})
CELLS = [{"number": number, "seed": 0} for number in range(5)]


def doubles(path):
    return {row["cell"]["number"]: row["result"]["double"] for row in results_of(read_rows(path))}


@pytest.mark.fault(120)
@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_cell_is_kept_and_does_not_stop_the_others(workers, tmp_path):
    path = tmp_path / "toy.jsonl"
    (failed,) = run(TOY, CELLS, path, workers=workers)
    assert failed["cell"]["number"] == 3
    assert "three is refused" in failed["error"]
    assert doubles(path) == {0: 0, 1: 2, 2: 4, 4: 8}
    for row in read_rows(path):
        assert row.keys() >= {"versions", "machine", "seconds", "commit"}


def threads(cell):
    import fdtasil  # noqa: F401  (as a cell's process does)
    from fdtasil.compute import torch_settings

    with torch_settings(torch.device("cpu")):
        pass
    pools = [pool["num_threads"] for pool in threadpool_info()]
    return {"torch": torch.get_num_threads(), "others": max(pools, default=1)}


@pytest.mark.fault(119)
def test_cells_side_by_side_have_one_thread_each(tmp_path):
    several = Benchmark("threads", "Counts.", lambda quick: [], threads, lambda rows: {})
    assert run(several, CELLS[:2], tmp_path / "t.jsonl", workers=2) == []
    for row in read_rows(tmp_path / "t.jsonl"):
        assert row["result"] == {"torch": 1, "others": 1}


def test_ray_gives_the_same_results(tmp_path):
    """Three cells on a Ray of this machine."""
    ray = pytest.importorskip("ray", reason="needs the extra: pip install 'fdtasil[ray]'")
    ray.init(
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}},
    )
    try:
        run(TOY, CELLS[:3], tmp_path / "ray.jsonl", workers=2, backend="ray")
    finally:
        ray.shutdown()
    run(TOY, CELLS[:3], tmp_path / "here.jsonl")
    assert doubles(tmp_path / "ray.jsonl") == doubles(tmp_path / "here.jsonl")


def test_what_is_done_is_skipped_and_a_cut_line_is_done_again(tmp_path):
    path = tmp_path / "toy.jsonl"
    run(TOY, CELLS[:2], path)
    whole = path.read_text()
    path.write_text(whole[: len(whole) - 20])  # as a kill in the middle of a line leaves it
    assert doubles(path) == {0: 0}
    run(TOY, CELLS[:3], path)
    assert doubles(path) == {0: 0, 1: 2, 2: 4}
    before = path.read_text()
    assert run(TOY, CELLS[:3], path) == []
    assert path.read_text() == before


def test_statistics_on_known_samples():
    assert interquartile_mean([0, 1, 1, 100]) == 1
    low, high = interval(list(np.random.default_rng(0).normal(size=200)))
    assert -0.5 < low < 0 < high < 0.5
    assert interval([2.0]) == (2.0, 2.0)
    mean, (low, high) = paired_difference({0: 1.0, 1: 2.0, 2: 9.0}, {0: 0.5, 1: 1.5})
    assert mean == low == high == 0.5
    with pytest.raises(ValueError, match="needs two"):
        paired_difference({0: 1.0}, {0: 1.0})


def test_the_shell(tmp_path):
    def shell(*arguments):
        command = [sys.executable, "-m", "benchmarks", *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)

    listed = shell("list")
    assert listed.returncode == 0
    assert "quality" in listed.stdout
    empty = shell("draw", "quality", "--results", str(tmp_path), "--out", str(tmp_path))
    assert empty.returncode == 1
    assert "run it first" in empty.stderr


def test_the_quality_table_pairs_equal_seeds(tmp_path):
    from benchmarks.quality import QUALITY

    rows = [
        {
            "cell": {"expert": "e", "probes": p, "episodes": 5, "horizon": 300, "seed": s},
            "result": {
                "normalized_return": 0.9 if p else 0.5 + s / 10,
                "survival": 1.0,
                "expert_survival": 1.0,
                "train_seconds": 7,
            },
        }
        for p in (10, 0)
        for s in range(2)
    ]
    table = QUALITY.draw(json.loads(json.dumps(rows)))["quality.md"].decode()
    assert "| e | 5 x 300 | 0.55" in table
    assert "+0.350" in table


@pytest.mark.parametrize("name", ["finite_difference", "mujoco"])
def test_methods_side_by_side(name):
    """Drawn of complete groups only: a method or seed that is missing leaves its group out."""
    from benchmarks.__main__ import BENCHMARKS

    benchmark = BENCHMARKS[name]
    budget = benchmark.cells(False)[0]["episodes"]
    rows = [
        {"cell": cell, "result": {"normalized_return": 0.5 + cell["seed"] / 10}}
        for cell in benchmark.cells(False)
        if cell["episodes"] == budget
    ]
    files = benchmark.draw(rows)
    table = files[f"{name}.md"].decode()
    assert "| 0.70 [0." in table
    assert "+0.00 [+0.00, +0.00]" in table
    assert all(data.startswith(b"\x89PNG") for file, data in files.items() if file.endswith("png"))
    assert benchmark.draw(rows[:20]) == {}
