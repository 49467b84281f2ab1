"""A student as C and in numpy: the same answers, and nothing that a board does not have."""

import os
import pickle
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY, mlp_onnx
from test_student import make

import fdtasil
from fdtasil.errors import ExpertError, ExportError, SettingError
from fdtasil.files.compiled import compiler
from fdtasil.rollouts.spaces import Spaces, layout_of
from fdtasil.student.architectures import ACTIVATIONS
from fdtasil.student.c_int8 import INT8, rounded
from fdtasil.student.c_source import FLOAT, c_memory, c_source, check_parity
from fdtasil.student.exports import export
from fdtasil.student.plain import PLAIN

needs_a_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
NEAR = 5 + 2 * np.random.default_rng(0).standard_normal((1000, 3)).astype(np.float32)
FAR = 10 * np.random.default_rng(1).standard_normal((1000, 3)).astype(np.float32)


def built(source, folder, *flags):
    file, program = folder / "student.c", folder / "student"
    file.write_bytes(source)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O2"]
    command = [compiler(), *strict, *flags, "-DSTUDENT_MAIN", "-o", program, file, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def asked(program, rows):
    lines = "\n".join(" ".join(f"{x:.9g}" for x in row) for row in rows)
    done = subprocess.run([program], input=lines, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return np.array([line.split() for line in done.stdout.splitlines()], np.float64)


@needs_a_compiler
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(), (8,), (64, 32, 16)], ids=str)
def test_compiled_it_answers_as_the_student(hidden, activation, tmp_path):
    student = make(hidden, activation)
    program = built(export(student, NEAR, {"environment": "Toy-v0"}, "s.c"), tmp_path)
    half = student.plain.half
    for rows in (NEAR, FAR):
        with torch.no_grad():
            expected = student(torch.from_numpy(rows)).numpy()
        assert np.abs((asked(program, rows) - expected) / half).max() < 1e-5


@needs_a_compiler
def test_a_sanitiser_finds_nothing_and_no_memory_is_asked_for(tmp_path):
    source = export(make((32, 32)), NEAR, {}, "student.c")
    program = built(source, tmp_path, *SANITISERS)
    assert asked(program, FAR[:50]).shape == (50, 2)
    object_ = tmp_path / "student.o"
    file = tmp_path / "student.c"
    subprocess.run([compiler(), "-std=c99", "-O2", "-c", "-o", object_, file], check=True)
    symbols = subprocess.run(["nm", object_], capture_output=True, text=True).stdout
    undefined = {line.split()[-1] for line in symbols.splitlines() if " U " in line}
    assert undefined <= {"tanhf", "erff", "expm1f"}
    shown = {line.split()[-1] for line in symbols.splitlines() if " T " in line}
    assert shown == {"student"}


SANITISERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover")


@pytest.mark.slow
@needs_a_compiler
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(), (64, 64), (24, 7, 5)], ids=str)
def test_in_eight_bits_it_answers_as_its_rounded_weights(hidden, activation, tmp_path):
    student = make(hidden, activation)
    source = export(student, NEAR, {"environment": "Toy-v0"}, "student.int8.c")
    answers = asked(built(source, tmp_path, *SANITISERS), NEAR)
    small = rounded(student.plain)
    assert answers == pytest.approx(small(NEAR), abs=2e-3)
    assert np.abs(answers - student.act(NEAR)).mean() < 0.05
    assert np.abs(small(NEAR) - student.plain(NEAR)).max() > 1e-4
    for (weights, _), (whole, _) in zip(small.layers, student.plain.layers, strict=True):
        assert len(np.unique(weights[0])) <= 255
        step = np.abs(whole).max(axis=1, keepdims=True) / 127
        assert (np.abs(weights - whole) <= 0.51 * step).all()


@needs_a_compiler
def test_eight_bits_take_a_quarter_of_the_flash(tmp_path):
    sizes = []
    for name in ("student.int8.c", "student.c"):
        file, object_ = tmp_path / "s.c", tmp_path / "s.o"
        file.write_bytes(export(make((128, 128), "relu"), NEAR, {}, name))
        subprocess.run([compiler(), "-std=c99", "-Os", "-c", "-o", object_, file], check=True)
        sizes.append(object_.stat().st_size)
    assert sizes[0] < 0.32 * sizes[1]


@needs_a_compiler
@pytest.mark.parametrize("hidden", [(), (8,), (40, 24)], ids=str)
@pytest.mark.parametrize(("name", "layers"), [("student.c", FLOAT), ("student.int8.c", INT8)])
def test_its_memory_is_what_a_compiler_lays_out(name, layers, hidden, tmp_path):
    student = make(hidden, "relu")
    source = export(student, NEAR, {}, name)
    constants, memory = c_memory(student.plain, layers)
    assert f"constants: {constants:,} bytes" in source.decode()
    assert f"memory: {memory:,} bytes" in source.decode()
    file, object_ = tmp_path / "s.c", tmp_path / "s.o"
    file.write_bytes(source)
    subprocess.run([compiler(), "-std=c99", "-O0", "-c", "-o", object_, file], check=True)
    said = subprocess.run(["nm", "-S", object_], capture_output=True, text=True).stdout
    sizes = [line.split() for line in said.splitlines() if len(line.split()) == 4]
    held = {kind: sum(int(size, 16) for _, size, of, _ in sizes if of == kind) for kind in "br"}
    assert (held["r"], held["b"]) == (constants, memory)


@needs_a_compiler
@pytest.mark.parametrize("width", [600, 3000])
def test_a_sum_of_a_wide_layer_stays_within_32_bits(width, tmp_path):
    """All weights and all inputs the largest that there are: what a sum can come to."""
    student = make((width,), "relu", low=(-np.inf, -np.inf), high=(np.inf, np.inf))
    with torch.no_grad():
        for layer, value in ((student.network[0], 1.0), (student.network[2], 0.001)):
            layer.weight.fill_(value)
            layer.bias.zero_()
    rows = NEAR[(NEAR - student.plain.mean).sum(axis=1) > 1]
    source = export(student, rows, {}, "student.int8.c")
    answers = asked(built(source, tmp_path, *SANITISERS), rows[:50])
    assert answers == pytest.approx(student.act(rows[:50]), rel=1e-2)


def test_a_student_that_eight_bits_change_is_refused():
    student = make((8, 8), "relu", low=(-np.inf, -np.inf), high=(np.inf, np.inf))
    with torch.no_grad():
        student.network[4].weight.mul_(1000)  # of actions in units of 1
    with pytest.raises(ExportError, match=r"in int8 the student's actions change by \d"):
        export(student, FAR, {}, "student.int8.c")


@pytest.mark.slow
@needs_a_compiler
@pytest.mark.fault(223)
@pytest.mark.parametrize("name", ["student.c", "student.int8.c"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_what_is_no_number_is_answered_with_none(activation, name, tmp_path):
    """A sensor that fails must not look like one that works."""
    program = built(export(make((16, 16), activation), NEAR, {}, name), tmp_path)
    rows = NEAR[:3].copy()
    rows[0, 1] = np.nan
    answers = asked(program, rows)
    assert np.isnan(answers[0]).all()
    assert np.isfinite(answers[1:]).all()


@needs_a_compiler
def test_the_header_fits(tmp_path):
    student = make((8,))
    (tmp_path / "student.h").write_bytes(export(student, NEAR, {}, "student.h"))
    (tmp_path / "student.c").write_bytes(export(student, NEAR, {}, "student.c"))
    (tmp_path / "robot.c").write_text(
        '#include "student.h"\n'
        "float robot(void) { float x[STUDENT_OBSERVATIONS] = {0}, u[STUDENT_ACTIONS];\n"
        "student(x, u); return u[STUDENT_ACTIONS - 1]; }\n"
    )
    files = [tmp_path / "robot.c", tmp_path / "student.c"]
    subprocess.run(
        [compiler(), "-std=c99", "-Wall", "-Werror", "-c", *files], cwd=tmp_path, check=True
    )


def linked(folder, linker, *files):
    """Return what a program of object files prints, as numbers."""
    subprocess.run([linker, "-o", "program", *files, "-lm"], cwd=folder, check=True)
    said = subprocess.run([folder / "program"], capture_output=True, text=True, check=True)
    return [float(number) for number in said.stdout.split()]


@needs_a_compiler
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_a_program_in_cpp_calls_it(tmp_path):
    student = make((8,))
    for name in ("student.h", "student.c"):
        (tmp_path / name).write_bytes(export(student, NEAR, {}, name))
    (tmp_path / "robot.cpp").write_text(
        '#include <cstdio>\n#include "student.h"\n'
        "int main() { const float x[STUDENT_OBSERVATIONS] = {5, 1, 2}; float u[STUDENT_ACTIONS];\n"
        'student(x, u); for (float one : u) std::printf("%.9g ", double(one)); }\n'
    )
    subprocess.run([compiler(), "-std=c99", "-c", "student.c"], cwd=tmp_path, check=True)
    answer = linked(tmp_path, "g++", "robot.cpp", "student.o")
    assert answer == pytest.approx(student.predict([5, 1, 2])[0], abs=1e-5)


@needs_a_compiler
def test_two_students_are_one_program(tmp_path):
    students = {"walk": make((8,)), "stand": make((4, 4), "relu", seed=1)}
    for (name, student), suffix in zip(students.items(), (".c", ".int8.c"), strict=True):
        (tmp_path / f"{name}.c").write_bytes(export(student, NEAR, {}, f"student{suffix}"))
        command = [compiler(), "-std=c99", f"-Dstudent={name}", "-c", f"{name}.c"]
        subprocess.run(command, cwd=tmp_path, check=True)
    (tmp_path / "robot.c").write_text(
        "#include <stdio.h>\nvoid walk(const float *, float *);\n"
        "void stand(const float *, float *);\n"
        "int main(void) { float x[3] = {5, 1, 2}, u[4]; int i; walk(x, u); stand(x, u + 2);\n"
        'for (i = 0; i < 4; i++) printf("%.9g ", u[i]); return 0; }\n'
    )
    answers = linked(tmp_path, compiler(), "robot.c", "walk.o", "stand.o")
    expected = [student.predict([5, 1, 2])[0] for student in students.values()]
    assert answers == pytest.approx(np.concatenate(expected), abs=2e-2)


@needs_a_compiler
def test_unbounded_actions_are_linear(tmp_path):
    student = make((16,), low=(-np.inf, -1.0), high=(np.inf, 1.0))
    program = built(export(student, NEAR, {}, "student.c"), tmp_path)
    assert asked(program, FAR) == pytest.approx(student.act(FAR), rel=1e-5, abs=1e-5)


@needs_a_compiler
def test_a_comment_ends_where_it_should(tmp_path):
    built(export(make((4,)), NEAR, {"name": "*/ int main; /*\n#error"}, "student.c"), tmp_path)


@needs_a_compiler
def test_a_file_that_answers_otherwise_is_refused():
    plain = make((8,)).plain
    wrong = c_source(plain, {}).replace("input[j];", "input[0];")
    with pytest.raises(ExportError, match="differ by"):
        check_parity(wrong, plain, NEAR)
    with pytest.raises(ExportError, match="can't compile"):
        check_parity("int main(", plain, NEAR)


def test_weights_that_are_not_finite_are_refused():
    student = make((8,))
    with torch.no_grad():
        student.network[0].weight[0, 0] = torch.nan
    with pytest.raises(ExportError, match="not finite"):
        export(student, NEAR, {}, "student.c")
    with pytest.raises(SettingError, match=r"\.onnx or \.safetensors or .*\.int8\.c or \.c or"):
        export(student, NEAR, {}, "student.exe")


def test_every_activation_is_there_in_all_three():
    assert PLAIN.keys() == ACTIVATIONS.keys()
    x = np.linspace(-12, 12, 4001, dtype=np.float32)
    for name, bend in PLAIN.items():
        expected = ACTIVATIONS[name]()(torch.from_numpy(x)).numpy()
        assert bend(x) == pytest.approx(expected, abs=2e-6), name


def test_one_row_is_answered_in_numpy_with_the_weights_as_they_are():
    rows = NEAR
    student = make((32, 16))
    for _ in range(3):
        expected = student.act(rows[:1])
        assert student.predict(rows[:1])[0] == pytest.approx(expected, abs=1e-5)
        assert student.predict(rows[0])[0] == pytest.approx(expected[0], abs=1e-5)
        with torch.no_grad():
            student.network[0].weight += 0.1
    student.network[2] = torch.nn.Linear(32, 16, device="meta").to_empty(device="cpu")
    torch.nn.init.zeros_(student.network[2].weight)
    torch.nn.init.ones_(student.network[2].bias)
    assert student.predict(rows[0])[0] == pytest.approx(student.act(rows[:1])[0], abs=1e-5)


@needs_a_compiler
def test_the_compiled_code_is_judged_in_the_loop(quick, linear, tmp_path):
    path = quick.export(tmp_path / "student.c")
    with pytest.raises(ExpertError, match=r"compiled and run here"):
        fdtasil.evaluate(path, linear, TOY, episodes=2)
    policy = fdtasil.load_expert(path, trust="c")
    judged = fdtasil.evaluate(policy, linear, TOY, episodes=2)
    expected = fdtasil.evaluate(quick.student, linear, TOY, episodes=2)
    assert judged.student_return == pytest.approx(expected.student_return, rel=1e-4)
    again = pickle.loads(pickle.dumps(policy.answer))
    rows = quick.demonstrations.observations[:20]
    assert np.array_equal(again(rows), policy.ask(rows, "act"))


@needs_a_compiler
def test_from_a_shell(quick_folder, inside, tmp_path):
    out = tmp_path / "student.c"
    done = inside("export", quick_folder, out)
    assert done.returncode == 0, done.stderr
    assert f"written: {out}" in done.stdout
    assert "microseconds here" in done.stdout
    assert "#define STUDENT_OBSERVATIONS 5" in out.read_text()
    expert = mlp_onnx(tmp_path / "e.onnx")
    line = ("evaluate", out, TOY, "--expert", expert, "--episodes", 2, "--horizon", 10)
    assert "your permission" in inside(*line).stderr
    judged = inside(*line, "--trust", "c")
    assert judged.returncode == 0, judged.stderr
    assert "normalised return" in judged.stdout


def test_a_c_file_of_others_is_refused(tmp_path):
    (tmp_path / "other.c").write_text("int main(void) { return 0; }\n")
    with pytest.raises(ExpertError, match="does not say its sizes"):
        fdtasil.load_expert(tmp_path / "other.c", trust="c")
    with pytest.raises(ExpertError, match="your permission"):
        fdtasil.load_expert(tmp_path / "other.c")


@needs_a_compiler
def test_a_c_file_that_can_not_be_compiled_is_refused_when_it_is_opened(quick, tmp_path):
    path = quick.export(tmp_path / "student.c")
    path.write_text(path.read_text() + "\nthis is no C;\n")
    with pytest.raises(ExpertError, match="can't compile the C file"):
        fdtasil.load_expert(path, trust="c")


@pytest.mark.fault(211)
@needs_a_compiler
def test_threads_do_not_mix_the_buffers_of_compiled_code(quick, tmp_path):
    path = quick.export(tmp_path / "student.c")
    rows = np.random.default_rng(0).standard_normal((4096, 5)).astype(np.float32)
    threads = fdtasil.load_expert(path, trust="c", workers=4, threads=True, batch=256)
    alone = fdtasil.load_expert(path, trust="c")
    assert np.array_equal(threads.ask(rows, "act"), alone.ask(rows, "act"))


@pytest.mark.fault(245)
@needs_a_compiler
@pytest.mark.parametrize("text", ["1 2\n1 2 3\n", "1 2 3 4\n", "1,2,3\n", "1 2 x\n", "1"])
def test_a_line_of_other_numbers_ends_the_program(text, tmp_path):
    """Elsewhere it would shift all that follow."""
    program = built(export(make((8,)), NEAR, {}, "student.c"), tmp_path)
    for before in ("", "\n1 2 3\n"):
        ended = subprocess.run([program], input=before + text, capture_output=True, text=True)
        assert ended.returncode == 2
        assert f"line {before.count(chr(10)) + 1}: expected 3 numbers" in ended.stderr
        assert len(ended.stdout.splitlines()) == len(before.split()) // 3


@pytest.mark.fault(244)
@pytest.mark.parametrize("wrong", [0.5, [0.5], np.ones((3, 1)), np.zeros(4), np.zeros((2, 4))])
def test_in_numpy_alone_another_shape_is_refused(wrong):
    policy = make((8,)).plain
    with pytest.raises(ValueError, match=r"not \(\.\.\., 3\)"):
        policy(wrong)
    assert policy(np.zeros((2, 3))).shape == (2, 2)


def test_the_comment_says_what_stands_where():
    parts = gymnasium.spaces.Dict(
        goal=gymnasium.spaces.Box(-1, 1, (1,)), pose=gymnasium.spaces.Box(-1, 1, (2,))
    )
    box = gymnasium.spaces.Box(-1, 1, (2,))
    spaces = Spaces(layout_of(parts, "observations"), layout_of(box, "actions"))
    ones, start = np.ones(3), torch.Generator()
    student = fdtasil.Student(
        fdtasil.Mlp(8), 0 * ones, ones, -ones[:2], ones[:2], start, spaces=spaces
    )
    for name in ("student.c", "student.h"):
        assert "bservation: 0:1 goal, 1:3 pose" in export(student, NEAR, {}, name).decode()
    told = export(make((8,)), NEAR, {"fdtasil.history": "1"}, "student.h").decode()
    assert "0:3 now, then for each of 0 steps before" in told


@pytest.mark.parametrize("name", ["student.c", "student.h", "student.py"])
def test_a_file_says_what_a_student_sees_of_the_environments_observation(name):
    def told(metadata):
        return export(make((8,)), NEAR, metadata, name).decode()

    assert "0:3 now, then for each of 0 steps" in told({"fdtasil.history": "1"})
    assert "environment's numbers 0,2,5" in told({"fdtasil.observation_columns": "0,2,5"})
    many = ",".join(map(str, range(100)))
    assert "numbers 100 of them, by" in told({"fdtasil.observation_columns": many})
    odd = told({"fdtasil.observation_function": "the function polar\nimport os */"})
    assert "what the function polar?import os" in odd
    assert "\nimport os" not in odd
    assert name == "student.py" or "import os */" not in odd


def test_a_student_of_a_function_says_so(linear, tmp_path):
    def polar(rows):
        return np.hypot(rows[:, :1], rows[:, 1:2])

    result = fdtasil.distill(linear, TOY, 0, student_obs=polar, **QUICK)
    result.export(tmp_path / "student.h")
    assert "what the function polar makes of" in (tmp_path / "student.h").read_text()


@pytest.mark.fault(321)
def test_the_order_of_many_parts_is_told_whole(tmp_path):
    names = [f"sensor_group_{number:02}" for number in range(14)]
    box = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    seen = layout_of(gymnasium.spaces.Dict(dict.fromkeys(names, box)), "observations")
    done = layout_of(gymnasium.spaces.Box(-1, 1, (1,), np.float32), "actions")
    student = fdtasil.Student(
        fdtasil.Mlp(4), np.zeros(42), np.ones(42), -np.ones(1), np.ones(1), torch.Generator(),
        spaces=Spaces(seen, done),
    )  # fmt: skip
    states = np.zeros((2, 42), np.float32)
    for name in ("s.h", "s.py", *(["s.c"] if compiler() else [])):
        text = export(student, states, {}, name).decode()
        assert all(name in text for name in names)
        assert max(map(len, text.split("*/")[0].splitlines())) < 110 or name == "s.py"


@needs_a_compiler
@pytest.mark.fault(321)
def test_letters_beyond_ascii_are_written_in_every_locale(tmp_path):
    code = (
        "from fdtasil.files.compiled import answers_of\n"
        "source = '/* \\u03b8 */ int main(void) { return 0; }'\n"
        "print(len(answers_of(source, 'X', [[0.0]])))"
    )
    odd = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**os.environ, **odd}, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr


@pytest.mark.fault(321)
@pytest.mark.parametrize(
    "name", ["s.int8.py", "s.int8.h", "s.int8.tflite", "s.int8.v2.onnx", "s.INT8.onnx", "s.INT8.c"]
)
def test_eight_bits_are_refused_where_there_are_none(name, quick):
    with pytest.raises(SettingError, match=r"\.int8\.onnx or \.int8\.c at the end"):
        quick.export_bytes(name)


@needs_a_compiler
@pytest.mark.fault(326)
def test_a_file_that_says_what_it_sees_is_judged_by_that(tmp_path):
    law = lambda rows: np.asarray(rows, np.float32) @ GAIN.T  # noqa: E731
    result = fdtasil.distill(law, TOY, 0, student_obs=[3, 0, 2, 1, 4], **QUICK)
    about = {"episodes": 2, "horizon": 20}
    for name in ("s.c", "s.onnx"):
        path = result.export(tmp_path / name)
        policy = fdtasil.load_expert(str(path), trust="c") if name == "s.c" else path
        found = fdtasil.evaluate(policy, law, TOY, **about)
        assert found.action_error == pytest.approx(result.evaluation.action_error, abs=1e-4)
        with pytest.raises(SettingError, match="as the file says itself"):
            fdtasil.evaluate(policy, law, TOY, student_obs=[0, 1, 2, 3, 4], **about)
