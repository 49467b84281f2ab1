"""The runner of benchmarks: what is done is kept, what fails does not stop the rest."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

pytest.importorskip("joblib", reason="needs the extra: pip install 'fdtasil[bench]'")

from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.runner import FIGURES, Benchmark, known_results, read_rows, results_of, run
from benchmarks.statistics import (
    Difference,
    difference_column,
    interquartile_mean,
    interval,
    interval_text,
    paired_difference,
)
from fdtasil.results.fidelity import GOOD

ROOT = Path(__file__).parent.parent


def double(cell, device):
    if cell["number"] == 3:
        raise ValueError("three is refused")
    return {"double": 2 * cell["number"], "device": device}


TOY = Benchmark("toy", "Doubles.", lambda quick: [], double, lambda rows: {})
CELLS = [{"number": number, "seed": 0} for number in range(5)]


def doubles(path):
    return {row["cell"]["number"]: row["result"]["double"] for row in results_of(read_rows(path))}


@pytest.mark.slow
@pytest.mark.fault(120)
@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_cell_is_kept_and_does_not_stop_the_others(workers, tmp_path):
    path = tmp_path / "toy.jsonl"
    (failed,) = run(TOY, CELLS, path, workers=workers)
    assert failed["cell"]["number"] == 3
    assert "three is refused" in failed["error"]
    assert doubles(path) == {0: 0, 1: 2, 2: 4, 4: 8}
    assert {row["result"]["device"] for row in results_of(read_rows(path))} == {"cpu"}
    for row in read_rows(path):
        assert row.keys() >= {"versions", "machine", "seconds", "commit"}


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_row_names_the_commit_of_its_code_which_rows_do_not_change(tmp_path, monkeypatch):
    def git(*words):
        person = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
        subprocess.run(["git", *person, *words], cwd=tmp_path, check=True, capture_output=True)

    code, rows = tmp_path / "code.py", tmp_path / "results" / "others.jsonl"
    rows.parent.mkdir()
    rows.touch()
    code.touch()
    git("init")
    git("add", ".")
    git("commit", "-m", "All.")
    monkeypatch.setattr("benchmarks.runner.HERE", tmp_path)
    monkeypatch.setattr("benchmarks.runner.RESULTS", rows.parent)
    commits = []
    for changed in (rows, code):
        changed.write_text("1")
        run(TOY, CELLS[len(commits) :][:1], tmp_path / "toy.jsonl")
        commits.append(read_rows(tmp_path / "toy.jsonl")[-1]["commit"])
    assert re.fullmatch("[0-9a-f]+", commits[0])
    assert commits[1] == f"{commits[0]}-dirty"


def threads(cell, device):
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


@pytest.mark.torture  # a cluster has to be begun
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


def test_cells_learn_on_which_device_to_train_and_rows_name_it(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.get_device_name", lambda device: f"the GPU of {device}")
    run(TOY, CELLS[:2], tmp_path / "toy.jsonl", device="cuda")
    for row in read_rows(tmp_path / "toy.jsonl"):
        assert row["result"]["device"] == "cuda"
        assert row["machine"].endswith(", the GPU of cuda")


def test_statistics_on_known_samples():
    assert interquartile_mean([0, 1, 1, 100]) == 1
    low, high = interval(list(np.random.default_rng(0).normal(size=200)))
    assert -0.5 < low < 0 < high < 0.5
    assert interval([2.0]) == (2.0, 2.0)
    same = paired_difference({0: 1.0, 1: 2.0, 2: 9.0}, {0: 0.5, 1: 1.5})
    assert (same.mean, same.interval, same.chance) == (0.5, (0.5, 0.5), 0.0)
    found = paired_difference({0: 1.0, 1: 2.0, 2: 3.0}, {0: 0.0, 1: 0.0, 2: 0.0})
    reach = 4.303 / 3**0.5  # Student's t of two degrees of freedom
    assert found.interval == pytest.approx((2 - reach, 2 + reach), abs=1e-3)
    assert found.chance == pytest.approx(0.0742, abs=1e-4)
    with pytest.raises(ValueError, match="needs two"):
        paired_difference({0: 1.0}, {0: 1.0})
    assert interval_text([0.5, 0.25]) == "0.50, 0.25"


def test_a_column_marks_what_many_differences_together_leave():
    """Of four at 0.04, or of ten, one is expected by chance; one of 0.001 is not."""
    column = [Difference(0.1, (0.05, 0.15), chance) for chance in (0.001, 0.04, 0.04, 0.9)]
    cells, counted = difference_column([*column, None])
    plain = "+0.10 [+0.05, +0.15]"
    assert cells == [f"**{plain}**", plain, plain, plain, "-"]
    assert counted == "3 of 4 exclude 0, 1 bold"
    assert difference_column([None]) == (["-"], "")


@pytest.mark.slow
def test_the_shell(tmp_path, capsys, monkeypatch):
    """One process of its own, which takes seconds; the rest here."""
    command = [sys.executable, "-m", "benchmarks", "list"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert listed.returncode == 0
    assert "quality" in listed.stdout

    def shell(*arguments):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
        try:
            code = main()
        except SystemExit as error:
            code = error.code
        return code, capsys.readouterr().err

    code, said = shell("draw", "quality", "--results", str(tmp_path), "--out", str(tmp_path))
    assert code == 1
    assert "run it first" in said
    for arguments, said in {
        ("mujoco", "--device", "tpu"): "device='tpu'",
        ("mujoco", "--device", "cuda", "--backend", "ray"): "beside --backend ray",
        ("speed", "--device", "cuda"): "speed says itself",
    }.items():
        code, shown = shell("run", *arguments, "--out", str(tmp_path))
        assert code == 2
        assert said in shown


def test_the_quality_table_pairs_equal_seeds(tmp_path):
    from benchmarks.quality import BENCHMARK

    rows = [
        {
            "cell": {"expert": "e", "probes": p, "episodes": 5, "horizon": 300, "seed": s},
            "result": {
                "normalized_return": 0.9 if p else 0.5 + s / 10,
                "survival": 1.0,
                "expert_survival": 1.0,
                "steps": 4000,
            },
        }
        for p in (10, 0)
        for s in range(2)
    ]
    table = BENCHMARK.draw(json.loads(json.dumps(rows)))["quality.md"].decode()
    assert "## 5 x 300 steps" in table
    assert "10 probes 4,000" in table
    assert "| e | 0.50, 0.60 | 0.90, 0.90 | - |" in table
    assert "+0.350" in table


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in BENCHMARKS if (FIGURES / f"{name}.md").exists()]
)
def test_a_table_is_what_its_rows_say(name, tmp_path, monkeypatch):
    """No number of a table is written by hand, and old rows can still be drawn."""
    monkeypatch.setattr(sys, "argv", ["benchmarks", "draw", name, "--out", str(tmp_path)])
    assert main() == 0
    table = f"{name}.md"
    assert (tmp_path / table).read_text() == (FIGURES / table).read_text()


def test_what_a_diagnosis_compares_with_is_what_was_measured():
    table = (FIGURES / "fidelity.md").read_text()
    well, ill = re.findall(r"80 % have (\d+)% to (\d+)%", table)
    said = re.findall(r"(\d+) to (\d+) %", GOOD)
    assert said == [well, ill]


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


def arguments(cell):
    return {"tripled": 3 * cell["number"]}


def tripling(name, cells, ran):
    def triple(cell, device):
        ran.append(cell["number"])
        return arguments(cell)

    return Benchmark(name, "", lambda quick: cells, triple, dict, arguments=arguments)


def test_benchmarks_share_the_results_of_equal_distillations(tmp_path):
    """Whatever the cells are called: the arguments say whether two are the same."""
    ran, cells = [], [{"number": number} for number in range(3)]
    first = tripling("first", cells, ran)
    run(first, cells[:2], first.results(tmp_path))
    second = tripling("second", [{"name": "new", **cell} for cell in cells], ran)
    path, known = second.results(tmp_path), known_results([first, TOY], tmp_path)
    run(second, second.cells(False), path, known=known)
    assert ran == [0, 1, 2]
    rows = {row["cell"]["number"]: row for row in read_rows(path)}
    assert [rows[number]["result"]["tripled"] for number in range(3)] == [0, 3, 6]
    assert [rows[number].get("from") for number in range(3)] == ["first", "first", None]
    assert all(row["cell"]["name"] == "new" for row in rows.values())


@pytest.mark.parametrize(("name", "times"), [("machine", 1), ("versions", 2)])
def test_results_of_other_versions_are_not_shared(name, times, tmp_path):
    """Those of other machines are: a row names its own, and none is run twice for that."""
    ran, cells = [], [{"number": 0}]
    first, second = (tripling(title, cells, ran) for title in ("first", "second"))
    run(first, cells, first.results(tmp_path))
    known = {
        key: {**row, name: "another"} for key, row in known_results([first], tmp_path).items()
    }
    run(second, cells, second.results(tmp_path), known=known)
    assert ran == [0] * times


@pytest.mark.slow
def test_distillations_are_sent_to_other_processes(tmp_path):
    from benchmarks.distillation import distillations

    def short(cell):
        shape = {"episodes": 1, "horizon": 10, "steps": 5, "hidden": (8,)}
        return {"expert": "Swimmer-v5", "evaluation_episodes": 2, **shape, **cell}

    cells = [{"probes": count, "seed": 0} for count in (0, 2)]
    tiny = distillations("tiny", "", lambda quick: cells, short, dict)
    assert run(tiny, cells, tiny.results(tmp_path), workers=2) == []
    for row in read_rows(tiny.results(tmp_path)):
        assert row["result"]["queries"]["probe"] == 10 * row["cell"]["probes"]
        assert row["result"]["normalized_return"] is not None


def test_the_same_distillation_is_found_in_several_benchmarks():
    from benchmarks.__main__ import BENCHMARKS

    def known(benchmark):
        return {json.dumps(benchmark.arguments(c), sort_keys=True) for c in benchmark.cells(False)}

    for name in ("queries", "mujoco"):
        assert known(BENCHMARKS[name]) & known(BENCHMARKS["finite_difference"])


def test_return_against_queries():
    """Every purpose counts; a baseline is taken at the first of its budgets that asks no less."""
    from benchmarks.queries import BENCHMARK

    def result(cell):
        acted = 300 * cell["episodes"]
        queries, score = {"act": acted, "check": 96, "evaluate": 9000}, 0.001 * cell["episodes"]
        if cell["method"].isdigit():
            queries |= {"probe": acted * int(cell["method"]), "calibrate": 1008}
            score += 0.5
        if cell["method"] == "dagger":
            queries = {"act": acted - 100, "label": 100}
        return {"queries": queries, "normalized_return": score}

    rows = [{"cell": cell, "result": result(cell)} for cell in BENCHMARK.cells(False)]
    files = BENCHMARK.draw(rows)
    assert files["queries.png"].startswith(b"\x89PNG")
    table = files["queries.md"].decode()
    expert = rows[0]["cell"]["expert"]
    # 600 to act, 1,008 to calibrate, 6,000 probes: cloning asks 12,000 with 40, 24,000 with 80.
    head = f"| {expert} | 10 probes | 2 | 7,608 |"
    gains = ("**+0.46 [+0.46, +0.46]** (1.6 x)", *["**+0.42 [+0.42, +0.42]** (3.2 x)"] * 2)
    assert f"{head} {' | '.join(gains)} |" in table
    assert f"{head} 0.50 [0.50, 0.50] |" in table
    assert table.count(f"| {expert} | 50 probes | 20 | 307,008 |") == 1  # none asks that much
    assert f"| {expert} | DAgger | 20 | 6,000 |" in table
    assert BENCHMARK.draw(rows[1:60]) == {}


def disturbed_row(cell):
    from benchmarks.disturbances import DISTURBANCES

    share = {"plain": 0.5, "10": 0.9, "augmentation": 0.8, "fresh": 1.0}[cell["method"]]
    calm = {"physics_resets": 0, "expert_physics_resets": 0}
    usual = {"expert_return": 200.0, "student_return": 200 * share, **calm}
    fallen = {"expert_return": 100.0, "student_return": 100 * share, **calm}
    result = {name: usual if name == "none" else fallen for name in DISTURBANCES}
    result["mass x 1.2"] = {"refused": "all episodes ended at once"}
    return {"cell": cell, "result": result}


def test_what_figures_call_a_method():
    from benchmarks.grid import label

    assert label("1") == "1 probe"
    assert label("50") == "50 probes"
    assert label("plain") == "plain cloning"
    assert label("expert") == "expert"


def test_a_student_beside_its_expert_under_disturbances():
    from benchmarks.robustness import BENCHMARK

    rows = [disturbed_row(cell) for cell in BENCHMARK.cells(False)]
    files = BENCHMARK.draw(rows)
    assert files["robustness.png"].startswith(b"\x89PNG")
    table = files["robustness.md"].decode()
    name = rows[0]["cell"]["expert"]
    assert f"| {name} | none | 1.00 [1.00, 1.00] | 0.50 [0.50, 0.50] | 0.90 [0.90," in table
    assert f"| {name} | noise 0.1 | 0.50 [0.50, 0.50] | 0.25 [0.25, 0.25] | 0.45 [0.45," in table
    assert "| **+0.40 [+0.40, +0.40]** |" in table
    assert f"itself: {name} under mass x 1.2" in table
    rows[0]["result"]["noise 0.1"] = {**rows[0]["result"]["none"], "expert_return": 7.0}
    with pytest.raises(ValueError, match="the expert differs"):
        BENCHMARK.draw(rows)


@pytest.mark.torture
def test_every_disturbance_runs():
    from benchmarks.disturbances import DISTURBANCES
    from benchmarks.robustness import compare_under_disturbances

    found = compare_under_disturbances("Walker2d-v5", 0, {"probes": 0, "steps": 10})
    assert found.keys() == DISTURBANCES.keys()
    assert all(result["expert_return"] > 100 for result in found.values())
    returns = [result["expert_return"] for result in found.values()]
    assert len(set(returns)) == len(returns)


def episode(env, seed):
    first, _ = env.reset(seed=seed)
    zero = np.zeros(env.action_space.shape, np.float32)
    return np.array([first, *(env.step(zero)[0] for _ in range(60))])


@pytest.mark.parametrize("body", ["Walker2d-v5", "Ant-v5"])
@pytest.mark.parametrize("name", ["noise 0.2", "pushes 1 m/s", "mass x 1.2", "friction x 0.5"])
def test_equal_seeds_are_disturbed_equally(name, body):
    import gymnasium

    from benchmarks.disturbances import DISTURBANCES

    deviations = np.ones(gymnasium.make(body).observation_space.shape)
    env = DISTURBANCES[name](gymnasium.make(body), deviations)
    first, other, again = (episode(env, seed) for seed in (3, 4, 3))
    np.testing.assert_array_equal(first, again)
    usual, usual_other = (episode(gymnasium.make(body), seed) for seed in (3, 4))
    assert np.abs(first - usual).max() > 0.01
    if name == "noise 0.2":
        assert np.abs((first - usual) - (other - usual_other))[0].max() > 0.01
    if name == "pushes 1 m/s":  # nothing before the first push
        np.testing.assert_array_equal(first[:50], usual[:50])


def test_what_is_derived_from_masses_follows_them():
    """Humanoid observes quantities that the simulator derives from the masses beforehand."""
    import gymnasium

    from benchmarks.disturbances import DISTURBANCES

    usual = gymnasium.make("Humanoid-v5")
    heavier = DISTURBANCES["mass x 1.2"](gymnasium.make("Humanoid-v5"), np.ones(348))
    masses, model = usual.unwrapped.model.body_mass, heavier.unwrapped.model
    np.testing.assert_allclose(model.body_mass, 1.2 * masses)
    np.testing.assert_allclose(model.body_subtreemass[1], model.body_mass.sum())


def test_a_table_says_where_its_rows_were_made():
    from benchmarks.runner import provenance

    rows = [
        {"machine": machine, "commit": commit, "result": {}}
        for machine, commit in (("A", "1"), ("B", "2"), ("A", "3"), ("A", "1"))
    ]
    assert provenance(rows) == "Made on A (1, 3); B (2)."


def test_no_mean_is_taken_of_what_is_no_number():
    with pytest.raises(ValueError, match="no number"):
        interval_text([0.5, None, 0.7])


def test_a_board_without_its_tools_says_what_to_install(monkeypatch):
    from benchmarks.board import BOARDS, on_board

    monkeypatch.setenv("PATH", "")
    with pytest.raises(RuntimeError, match="apt-get install gcc-arm-none-eabi libnewlib"):
        on_board(BOARDS["Cortex-M4F"], "", "", np.zeros((1, 3), np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["student.c", "student.int8.c"])
@pytest.mark.parametrize("board", ["Cortex-M3", "Cortex-M4F", "Cortex-M33"])
def test_a_simulated_board_answers_as_the_student(board, name):
    from test_student import make

    from benchmarks.board import BOARDS, on_board
    from fdtasil.student.exports import export

    for tool in ("arm-none-eabi-gcc", "qemu-system-arm"):
        if shutil.which(tool) is None:
            pytest.skip(f"needs {tool}")
    rows = 5 + np.random.default_rng(0).standard_normal((10, 3)).astype(np.float32)
    student = make((16, 16))
    source, header = (export(student, rows, {}, file).decode() for file in (name, "student.h"))
    found = on_board(BOARDS[board], source, header, rows)
    assert found.answers == pytest.approx(
        student.act(rows), abs=1e-5 if name == "student.c" else 0.1
    )
    products = 3 * 16 + 16 * 16 + 16 * 2
    assert 2 * products < found.instructions < 400 * products
    weights = products * (4 if name == "student.c" else 1)
    assert weights < found.flash < weights + 8000
    assert 0 < found.ram < 1000
