"""The checks that users run on experts and students of their own."""

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY
from test_gate import FAULTS
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import ExpertError
from fdtasil.rollouts.behaviours import farthest_apart
from fdtasil.testing import check_expert, check_student


def law(rows):
    return np.clip(np.asarray(rows, np.float32) @ GAIN.T, -1, 1)


NAMES = ["opening", "answers", "determinism", "batch independence", "large batches"]
NAMES += ["action bounds", "action scale", "batch sizes"]


def problems(findings):
    return {finding.name: str(finding.problem) for finding in findings if finding.problem}


def test_a_good_expert_passes_every_check(linear):
    findings = check_expert(linear, TOY)
    assert [finding.name for finding in findings] == [*NAMES, "return"]
    assert problems(findings) == {}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_every_fault_has_its_name(fault):
    expert, found = FAULTS[fault]
    said = problems(check_expert(expert, TOY))
    with pytest.raises(ExpertError, match=found.replace("16", r"\d+")):
        raise ExpertError(*next(iter(said.values())).split("\n")[:3])


@pytest.mark.fault(52)
def test_a_function_of_single_rows_is_found_by_as_many_rows_as_coordinates():
    def single(row):
        return (GAIN @ row).T if row.shape == (5, 5) else row @ GAIN.T

    assert list(problems(check_expert(single, TOY))) == ["batch sizes"]


@pytest.mark.fault(62)
def test_an_expert_of_another_task_is_no_better_than_chance():
    def wrong(rows):
        return np.sign(rows[:, :2]).astype(np.float32)

    assert list(problems(check_expert(wrong, TOY))) == ["return"]


def test_what_is_no_expert_does_not_open(tmp_path):
    assert list(problems(check_expert(tmp_path / "nothing.onnx", TOY))) == ["opening"]
    assert list(problems(check_student(tmp_path / "nothing.onnx", TOY))) == ["opening"]


def test_a_student_passes_every_check(quick, tmp_path):
    findings = check_student(quick.student, TOY)
    assert [finding.name for finding in findings] == [*NAMES, "far states", "export"]
    assert problems(findings) == {}
    exported = check_student(quick.to_onnx(tmp_path / "s.onnx"), TOY)
    assert [finding.name for finding in exported] == [*NAMES, "far states"]
    assert problems(exported) == {}


def test_a_student_without_bounds_is_found_far_out():
    layer = torch.nn.utils.skip_init(torch.nn.Linear, 5, 2, bias=False)
    with torch.no_grad():
        layer.weight.copy_(torch.from_numpy(GAIN))
    assert list(problems(check_student(layer, TOY))) == ["far states"]


@pytest.mark.fault(263)
def test_a_row_without_an_answer_hides_no_fault_of_the_others(linear):
    def planner(rows):
        answers = linear(rows) + 1e-2 * len(rows)
        answers[rows[:, 0] > np.float32(0.9)] = np.nan
        return answers

    def silent_and_fair(rows):
        answers = linear(rows)
        answers[rows[:, 0] > np.float32(0.9)] = np.nan
        return answers

    assert "batch sizes" in problems(check_expert(planner, TOY))
    assert "batch sizes" not in problems(check_expert(silent_and_fair, TOY))
    some, none = np.float32([[1, 2], [3, 4]]), np.float32([[1, np.nan], [3, 6]])
    assert farthest_apart(some, none) == farthest_apart(none, some) == 2
    assert farthest_apart(none[:1], some[:1]) == 0


@pytest.mark.slow
@pytest.mark.fault(354)
@pytest.mark.parametrize(
    "sees",
    [{}, {"student_obs": [0, 1, 2]}, {"student_obs": lambda rows: rows[:, :3]}, {"history": 2}],
)
@pytest.mark.parametrize("form", ["box", "dictionary"])
def test_a_student_is_checked_through_what_it_sees(sees, form, tmp_path):
    made = lambda: InForm(form)  # noqa: E731
    result = fdtasil.distill(in_form(law, form, "box"), made, 0, **QUICK, **sees)
    named = [*NAMES, "far states", "export"]
    for student, about in ((result, {}), (result.student, sees)):
        findings = check_student(student, made, horizon=20, **about)
        assert [finding.name for finding in findings] == named
        assert problems(findings) == {}
    if not callable(sees.get("student_obs")):
        assert problems(check_student(result.save(tmp_path / "run"), made, horizon=20)) == {}
        file = result.export(tmp_path / "s.onnx")
        assert problems(check_student(file, made, horizon=20)) == {}
