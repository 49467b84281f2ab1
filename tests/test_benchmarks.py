"""The runner of benchmarks: what is done is kept, what fails does not stop the rest."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_cell_is_kept_and_does_not_stop_the_others(workers, tmp_path):
    path = tmp_path / "toy.jsonl"
    (failed,) = run(TOY, CELLS, path, workers=workers)
    assert failed["cell"]["number"] == 3
    assert "three is refused" in failed["error"]
    assert doubles(path) == {0: 0, 1: 2, 2: 4, 4: 8}
    for row in read_rows(path):
        assert row.keys() >= {"versions", "machine", "seconds", "commit"}


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
