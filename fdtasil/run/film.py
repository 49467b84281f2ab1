"""Policies side by side in a moving picture, from one start."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from fdtasil.checks import check_count, check_path, check_suffix
from fdtasil.errors import EnvironmentFault, SettingError, first_line
from fdtasil.experts.carrying import carry
from fdtasil.experts.load import ExpertLike, sized
from fdtasil.files.storage import write_bytes
from fdtasil.progress import Progress
from fdtasil.results.distilled import Distilled
from fdtasil.results.moving_pictures import WRITERS, panel
from fdtasil.rollouts.behaviours import Policy, follow_answers
from fdtasil.rollouts.environments import (
    EnvironmentLike,
    EnvironmentPool,
    resolve_horizon,
    simulator_warnings,
)
from fdtasil.rollouts.history import WithHistory
from fdtasil.rollouts.playing import InTurn
from fdtasil.rollouts.recording import Recording
from fdtasil.rollouts.rollout import first_observations
from fdtasil.rollouts.stepping import step_by_step
from fdtasil.rollouts.wanted import Environment
from fdtasil.run.judging import acting, finished_run, judged_in, judged_through

__all__ = ["choose_renderer", "render"]

_FPS = 30  # where the environment does not say


def render(
    policies: Mapping[str, ExpertLike | Distilled],
    env: EnvironmentLike,
    out: str | Path,
    *,
    seed: int = 0,
    horizon: int | None = None,
    every: int = 1,
    height: int = 360,
    progress: bool = True,
) -> Path:
    """Film policies side by side, from one start, with the return so far above each.

    Args:
        policies: By the name that stands above each: a result, the folder of a run,
            or anything else that an expert may be.
        env: A gymnasium id, an `Environment`, or a function that makes an environment with
            `render_mode="rgb_array"`.
        out: Ends with .mp4 (`pip install "fdtasil[video]"`), .webp or .gif. The last two are
            for short films: their pictures are in memory until all are drawn.
        seed: Of the start.
        horizon: Steps after which the episode is cut; default: the environment's time limit.
        every: Steps between two pictures; the film keeps the environment's pace.
        height: Of a picture, in pixels.
        progress: Show progress bars, in a terminal or a notebook.

    Raises:
        SettingError: If an argument can't be used.
        EnvironmentFault: If the environment draws no pictures.
        ExportError: If the film can't be written.

    Example::

        fdtasil.render({"expert": "expert.onnx", "student": "student.onnx"}, "Ant-v5", "film.mp4")
    """
    path = check_suffix(check_path("out", out), *WRITERS).absolute()
    if not isinstance(policies, Mapping) or not policies:
        found = f"policies is a {type(policies).__name__}" if policies else "no policies"
        raise SettingError(found, "names with policies", 'write {"student": student}')
    check_count("seed", seed, 0, 2**32 - 1)
    every, height = check_count("every", every), check_count("height", height, 32)
    bars = Progress(progress)
    with ExitStack() as open_, bars.bar("film", "picture", 1) as bar, simulator_warnings():
        players: list[_Player] = []
        for name, policy in policies.items():
            length = players[0].horizon if players else horizon  # what is wrong with it, once
            players.append(open_.enter_context(_Player(name, policy, env, seed, length)))
        if len({id(player.simulator) for player in players}) < len(players):
            raise SettingError(
                "a function that returns one and the same environment",
                "a new one for each policy",
                "make it inside the function: lambda: gymnasium.make(...)",
            )
        steps = players[0].horizon
        bar.lengthen(len(range(0, steps, every)))
        pictures = _pictures(players, steps, every, height, bar.move)
        fps = players[0].fps / every
        write_bytes(path, WRITERS[path.suffix.lower()](pictures, fps))
    return Path(out)


def choose_renderer() -> None:
    """Let MuJoCo draw without a display, where there is none and nobody has said how.

    MuJoCo reads it when it is imported.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


class _Player:
    """A policy in an environment of its own, and the episode that it plays."""

    def __init__(
        self,
        name: str,
        policy: ExpertLike | Distilled,
        env: EnvironmentLike,
        seed: int,
        horizon: int | None,
    ) -> None:
        self.name, self.over = str(name), False
        self.pool = EnvironmentPool(_drawing(env))
        try:
            if self.pool.together is not None:
                raise SettingError(
                    f"{self.pool.name}, a vector environment",
                    "one environment for each policy",
                    "pass its id, or a function that makes one",
                )
            self.horizon = resolve_horizon(horizon, self.pool)
            act = follow_answers(_policy_in(policy, self.pool, seed))
            (self._env,) = self.pool.take(1)
            _follow(self._env)
            self._record = Recording([seed], self.horizon, self.pool)
            playing = InTurn(self._record, {0: self._env})
            noise = [np.random.default_rng(seed)]
            first = playing.begin()
            self._steps = step_by_step(self._record, playing, first, act, noise, self.horizon)
            self.picture = self._drawn()
        except BaseException:
            self.pool.close()
            raise
        self.fps = float(self._env.metadata.get("render_fps") or _FPS)

    def __enter__(self) -> "_Player":
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.close()

    @property
    def simulator(self) -> gymnasium.Env:
        """What is stepped, without its wrappers."""
        return self._env.unwrapped

    @property
    def total(self) -> float:
        """The return so far."""
        return float(self._record.rewards[0].sum())

    @property
    def step(self) -> int:
        """How many steps it has taken."""
        return int(self._record.valid[0].sum())

    def move(self) -> None:
        """Take a step; an episode that is over stands still."""
        if self.over:
            return
        going = next(self._steps, None)
        self.over = going is None or not going[0]
        if self.over:  # where it ended is shown, whatever pictures are left out
            self.picture = self._drawn()

    def draw(self) -> np.ndarray:
        """Return the picture of now."""
        if not self.over:
            self.picture = self._drawn()
        return self.picture

    def _drawn(self) -> np.ndarray:
        try:
            found: Any = self._env.render()
        except Exception as error:  # each library of graphics has its own
            raise EnvironmentFault(
                f"{self.pool.name} can't be drawn: {first_line(error)}",
                "pictures without a display",
                "set MUJOCO_GL=egl (or osmesa, after apt-get install libosmesa6) before Python "
                "starts",
            ) from error
        if isinstance(found, np.ndarray) and found.ndim == 3 and found.shape[2] == 3:
            return found.astype(np.uint8, copy=False)
        raise EnvironmentFault(
            f"render() of {self.pool.name} returned a {type(found).__name__}",
            "a picture (height, width, 3)",
            'make it with render_mode="rgb_array"',
        )


def _follow(env: gymnasium.Env) -> None:
    """Use a MuJoCo model's own camera that follows, where nothing else does.

    Without one a robot walks out of the picture: gymnasium's free camera stands still, unless its
    settings name a body to track.
    """
    drawer: Any = getattr(env.unwrapped, "mujoco_renderer", None)
    if drawer is None or "trackbodyid" in (drawer.default_cam_config or {}):
        return
    if getattr(drawer, "camera_id", None) == -1:
        import mujoco

        known: Any = mujoco  # the type stubs do not know all of it
        kind = known.mjtObj.mjOBJ_CAMERA
        drawer.camera_id = known.mj_name2id(drawer.model, kind, "track")  # -1 if there is none


def _drawing(env: EnvironmentLike) -> EnvironmentLike:
    """Return an environment that draws."""
    wanted = env if isinstance(env, Environment) else Environment(env)
    if isinstance(wanted.environment, str):
        mode = {"render_mode": "rgb_array"}
        return replace(wanted, kwargs={**(wanted.kwargs or {}), **mode}, num_envs=0)
    if isinstance(wanted.environment, gymnasium.Env):
        raise SettingError(
            "an environment, for several policies to be filmed in",
            "a gymnasium id, or a function that makes an environment",
            "write lambda: gymnasium.make(..., render_mode='rgb_array')",
        )
    return wanted


def _policy_in(policy: ExpertLike | Distilled, pool: EnvironmentPool, seed: int) -> Policy:
    """Return what answers the environment's flat observations."""
    looked_at, student_obs, history = judged_through(finished_run(policy), None, 1)
    judged = judged_in(looked_at, pool, student_obs, history)
    if history > 1:
        layout = pool.spaces.actions
        pool.wrap(lambda made: WithHistory(made, history, layout))
    n, m = pool.boxes.observation_size, pool.boxes.action_size
    if student_obs is None and judged.origin.columns is None:
        opened, _, _ = carry(sized(judged, n, m), pool)
        return opened.policy("evaluate")
    return acting(judged, student_obs, first_observations(pool, [seed]), m)


def _pictures(
    players: Sequence[_Player],
    steps: int,
    every: int,
    height: int,
    told: Callable[[int], None],
) -> Iterator[np.ndarray]:
    """Yield the pictures of a film, all of one size."""
    for step in range(steps):
        if step % every == 0:
            yield np.concatenate([_panel(player, height) for player in players], axis=1)
            told(1)
        for player in players:
            player.move()
        if all(player.over for player in players):
            break
    yield np.concatenate([_panel(player, height) for player in players], axis=1)


def _panel(player: _Player, height: int) -> np.ndarray:
    told = f"{player.total:,.0f}" + f", ended at step {player.step}" * player.over
    return panel(player.draw(), height, player.name, told, faded=player.over)
