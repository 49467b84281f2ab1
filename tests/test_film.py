"""Films: one picture a step, a name and a return above each policy."""

import gymnasium
import numpy as np
import pytest
from conftest import QUICK, TOY, mlp_onnx
from PIL import Image
from toy_forms import InForm, in_form

import fdtasil
from fdtasil.errors import EnvironmentFault, ExportError, SettingError
from fdtasil.rollouts.recording import HOLD

pytestmark = pytest.mark.usefixtures("no_pictures")


class Drawn(InForm):
    """Paints the first position as a grey."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    render_mode = "rgb_array"

    def render(self):
        grey = int(np.clip(128 + 100 * self.position[0], 0, 255))
        return np.full((40, 60, 3), grey, np.uint8)


def push(rows):
    return np.ones((len(rows), 2), np.float32)


def rest(rows):
    return np.zeros((len(rows), 2), np.float32)


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_one_picture_a_step_side_by_side(suffix, tmp_path):
    file = fdtasil.render(
        {"pushed": push, "at rest": rest}, Drawn, tmp_path / f"f{suffix}", horizon=12, height=80
    )
    film = Image.open(file)
    assert 10 <= film.n_frames <= 13  # equal ones may be one, and the last state is shown
    assert film.size == (2 * 120, 80 + 40)
    frames = []
    for number in range(film.n_frames):
        film.seek(number)
        frames.append(np.asarray(film.convert("L"), np.float64)[60:110])
    left, right = (
        [frame[:, part].mean() for frame in frames] for part in (np.s_[:110], np.s_[130:])
    )
    assert left[-1] > left[0] + 20  # it moves, from the same start
    assert abs(left[0] - right[0]) < 3
    assert np.ptp(right) < np.ptp(left)


def test_every_other_step_and_an_early_end(tmp_path):
    walled = lambda: Drawn(wall=0.9)  # noqa: E731
    file = fdtasil.render({"pushed": push}, walled, tmp_path / "f.gif", horizon=60, every=2)
    assert Image.open(file).n_frames < 20


def test_an_mp4(tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file = fdtasil.render({"a": rest, "b": push}, Drawn, tmp_path / "f.mp4", horizon=10)
    about = next(imageio_ffmpeg.read_frames(str(file)))
    assert about["fps"] == 20
    assert about["size"][0] == 2 * about["source_size"][0] // 2


def test_a_student_with_a_history_keeps_it(tmp_path):
    law = lambda x: np.clip(-x[:, :2], -1, 1)  # noqa: E731
    result = fdtasil.distill(law, Drawn, 2, **QUICK, history=2)
    file = result.export(tmp_path / "s.onnx")
    film = fdtasil.render({"past": file}, Drawn, tmp_path / "f.gif", horizon=5)
    assert Image.open(film).n_frames > 1


def test_students_of_every_form(tmp_path):
    law = lambda x: np.clip(-x[:, :2], -1, 1)  # noqa: E731
    expert = in_form(law, "nested", "choice")
    made = lambda: Drawn("nested", "choice")  # noqa: E731
    result = fdtasil.distill(expert, made, 0, **QUICK)
    seen = fdtasil.distill(law, Drawn, 0, student_obs=[0, 1], **QUICK)
    for name, student in (("a", result), ("b", seen)):
        student.export(tmp_path / f"{name}.onnx")
    policies = {"expert": expert, "student": result.student, "file": str(tmp_path / "a.onnx")}
    assert fdtasil.render(policies, made, tmp_path / "f.gif", horizon=5).exists()
    assert fdtasil.render(
        {"some": str(tmp_path / "b.onnx")}, Drawn, tmp_path / "g.gif", horizon=5
    ).exists()


def test_runs_are_filmed_by_their_results_and_their_folders(tmp_path):
    law = lambda x: np.clip(-x[:, :2], -1, 1)  # noqa: E731
    past = fdtasil.distill(law, Drawn, 2, **QUICK, history=2)
    some = fdtasil.distill(law, Drawn, 0, **QUICK, student_obs=lambda rows: rows[:, :2])
    past.save(tmp_path / "run")
    film = fdtasil.render(
        {"result": some, "folder": tmp_path / "run"}, Drawn, tmp_path / "f.gif", horizon=3
    )
    assert Image.open(film).n_frames > 1
    shown = (fdtasil.render({"x": one}, Drawn, tmp_path / "x.gif", horizon=3) for one in
             (past, str(tmp_path / "run")))  # fmt: skip
    one, other = (file.read_bytes() for file in shown)
    assert one == other


def test_an_environment_that_breaks_is_told_as_everywhere(tmp_path):
    class Breaks(Drawn):
        def step(self, action):
            observation, *rest = super().step(action)
            return observation * np.nan, *rest

    with pytest.raises(EnvironmentFault, match=r"step 0: .* not finite"):
        fdtasil.render({"a": rest}, Breaks, tmp_path / "f.gif", horizon=3)


@pytest.mark.parametrize(
    ("policies", "env", "out", "kind"),
    [
        ({"a": rest}, Drawn, "f.avi", SettingError),
        ({}, Drawn, "f.gif", SettingError),
        (rest, Drawn, "f.gif", SettingError),
        ({"a": rest}, gymnasium.make("Pendulum-v1"), "f.gif", SettingError),
        ({"a": rest}, InForm, "f.gif", EnvironmentFault),
    ],
)
def test_what_can_not_be_filmed(policies, env, out, kind, tmp_path):
    with pytest.raises(kind):
        fdtasil.render(policies, env, tmp_path / out, horizon=3)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("suffix", "most"), [("webp", "16,383"), ("mp4", "16,384")])
def test_a_film_too_wide_for_its_format_is_refused_before_it_is_played(suffix, most, tmp_path):
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")

    class Wide(Drawn):
        played = 0

        def step(self, action):
            Wide.played += 1
            return super().step(action)

        def render(self):
            return np.zeros((1, 300, 3), np.uint8)

    with pytest.raises(ExportError, match=rf"19,200 x 104 pixels.*\n.*{most}"):
        fdtasil.render({"a": rest}, Wide, tmp_path / f"f.{suffix}", horizon=3, height=64)
    assert Wide.played == 0
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path, inside, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    expert = mlp_onnx(tmp_path / "e.onnx")
    gymnasium.register(
        "toy/Drawn-v0", entry_point=lambda render_mode: Drawn(), max_episode_steps=9
    )
    done = inside("render", "toy/Drawn-v0", f"one={expert}", f"two={expert}", cwd=tmp_path)
    assert done.returncode in (0, 1), done.stderr  # 1 without imageio-ffmpeg
    done = inside("render", "toy/Drawn-v0", f"one={expert}", "--out", "f.webp", cwd=tmp_path)
    assert "written: f.webp" in done.stdout, done.stderr
    for wrong in ([str(expert)], []):
        done = inside("render", TOY, *wrong, cwd=tmp_path)
        assert done.returncode == 2
        assert "NAME=FILE" in done.stderr or "student=student.onnx" in done.stderr


def test_one_environment_for_two_is_refused(tmp_path):
    one = Drawn()
    with pytest.raises(SettingError, match="one and the same"):
        fdtasil.render({"a": rest, "b": push}, lambda: one, tmp_path / "f.gif", horizon=3)
    many = lambda: gymnasium.vector.SyncVectorEnv([Drawn])  # noqa: E731
    with pytest.raises(SettingError, match="vector"):
        fdtasil.render({"a": rest}, many, tmp_path / "f.gif", horizon=3)


@pytest.mark.fault(262)
def test_a_planner_without_an_answer_goes_on_as_before(tmp_path):
    """For a while; NaN would become a black picture, or an action of its own."""
    acted, known = [], set()

    class Watched(Drawn):
        def step(self, action):
            acted.append(np.array(action))
            return super().step(action)

    def fails(rows):
        if len(acted) < 3:
            known.update(row.tobytes() for row in rows)
        answers = [0.5 if row.tobytes() in known else np.nan for row in rows]
        return np.repeat(np.float32(answers)[:, None], 2, axis=1)

    fdtasil.render({"planner": fails}, Watched, tmp_path / "f.gif", horizon=30)
    assert len(acted) == 3 + HOLD
    assert np.array_equal(acted, np.full((len(acted), 2), 0.5))


def test_a_gif_keeps_the_pace_that_viewers_show(tmp_path):
    class Fast(Drawn):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 125}  # noqa: RUF012

        def __init__(self):
            super().__init__(wall=99)

    for every, seconds in ((1, 0.32), (2, 0.32)):
        file = fdtasil.render({"p": push}, Fast, tmp_path / "f.gif", horizon=40, every=every)
        film, shown = Image.open(file), []
        for number in range(film.n_frames):
            film.seek(number)
            shown.append(film.info["duration"])
        assert min(shown) >= 20
        assert sum(shown[:-1]) == pytest.approx(1000 * seconds, abs=20)


@pytest.mark.fault(298)
def test_a_file_that_sees_through_a_function_is_not_filmed_without_it(tmp_path):
    run = {**QUICK, "student_obs": lambda rows: 3 * rows, "progress": False}
    written = fdtasil.distill(push, TOY, 0, **run).export(tmp_path / "s.onnx")
    with pytest.raises(SettingError, match=r"sees through the function .*file does not hold"):
        fdtasil.render({"student": written}, Drawn, tmp_path / "f.gif", horizon=5)


def test_where_an_episode_ends_is_shown(tmp_path):
    drawn = []

    class Counted(Drawn):
        def __init__(self):
            super().__init__(wall=0.9)

        def reset(self, *, seed=None, options=None):
            self.time = 0
            return super().reset(seed=seed, options=options)

        def step(self, action):
            self.time += 1
            answer = super().step(action)
            self.ended = self.time if answer[2] else None
            return answer

        def render(self):
            drawn.append((self.time, getattr(self, "ended", None)))
            return super().render()

    fdtasil.render({"pushed": push}, Counted, tmp_path / "f.gif", horizon=60, every=7)
    time, ended = drawn[-1]
    assert time == ended
