"""Episodes while they are recorded: every answer of an environment is looked at here."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from numbers import Real
from types import NoneType
from typing import Any

import gymnasium
import numpy as np

from fdtasil.errors import EnvironmentFault, ExpertError, first_line, warn
from fdtasil.rollouts.behaviours import Decision, silent_rows
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes
from fdtasil.rollouts.narrowing import Narrowing
from fdtasil.rollouts.physics import clock, data_of, was_reset
from fdtasil.rollouts.spaces import Mismatch

__all__ = ["HOLD", "Recording"]

HOLD = 10
"""Steps in a row that an action is held for where who acts has no answer; then it ends."""


class Recording:
    """The arrays of `Episodes` while they are being filled.

    Args:
        seeds: (E,) reset seed of each episode.
        horizon: T, steps after which an episode is cut.
        pool: The environment.
    """

    def __init__(self, seeds: Sequence[int], horizon: int, pool: EnvironmentPool) -> None:
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        self._pool, self._bounds, self._name = pool, pool.bounds, pool.name
        self.options = pool.options
        self._seeds, episodes = [int(seed) for seed in seeds], len(seeds)
        self.observations = np.zeros((episodes, horizon, n), np.float32)
        self.actions = np.zeros((episodes, horizon, m), np.float32)
        self.expert_actions = np.zeros((episodes, horizon, m), np.float32)
        self.answered = np.zeros((episodes, horizon), bool)
        self.refused = np.zeros((episodes, horizon), bool)
        self.given_up = np.zeros(episodes, bool)
        self._held = np.zeros(episodes, np.int64)  # steps in a row
        self._silent_at = np.full(episodes, -2)
        self.rewards = np.zeros((episodes, horizon))
        self.valid = np.zeros((episodes, horizon), bool)
        self.terminated = np.zeros(episodes, bool)
        self.physics_resets = np.zeros(episodes, np.int64)
        self.clipped_actions = 0
        self._narrowing = Narrowing(n, pool.name)
        self._data: list[object] = [None] * episodes

    def reset(self, environment: gymnasium.Env, episode: int) -> np.ndarray:
        """Return the first observation of an episode."""
        try:
            answer = environment.reset(seed=self._seeds[episode], **self._pool.reset_options)
        except Mismatch as mismatch:
            raise self._promised(episode, None, mismatch) from None
        except Exception as error:
            advice = _reset_advice(error)
            raise self._crash(episode, None, "reset()", error, advice) from error
        pair = isinstance(answer, tuple) and len(answer) == 2
        if not pair or not isinstance(answer[1], Mapping | NoneType):
            raise EnvironmentFault(
                f"{self._where(episode, None)}: reset() returned {_described_reset(answer)}",
                "(observation, info)",
                "end reset() with: return observation, {}  (an environment of the old gym "
                "package: wrap it so)",
            )
        observation = _own(answer[0])
        self._data[episode] = data_of(environment)
        return observation

    def step(
        self, environment: gymnasium.Env, action: np.ndarray, episode: int, step: int
    ) -> tuple[np.ndarray, bool]:
        """Record a step's outcome; return the observation and whether the episode goes on."""
        data = self._data[episode]
        before = clock(data)
        try:
            answer = environment.step(action)
        except Mismatch as mismatch:
            raise self._promised(episode, step, mismatch) from None
        except ExpertError:  # of one whose memory is carried along
            raise
        except Exception as error:
            raise self._crash(episode, step, "step()", error) from error
        try:
            observation, reward, terminated, truncated, _ = answer
            self.rewards[episode, step] = _number(reward)
            self.terminated[episode] = fallen = bool(_number(terminated))
            going = not (fallen or bool(_number(truncated)))
        except (TypeError, ValueError, OverflowError) as error:
            raise self._fault(
                episode,
                step,
                f"step() returned {_described(answer)}",
                "(observation, reward, terminated, truncated, info), the reward one number",
            ) from error
        self.physics_resets[episode] += was_reset(data, before, first=step == 0)
        return _own(observation), going

    def seed(self, episode: int) -> int:
        """Return the reset seed of an episode."""
        return self._seeds[episode]

    @contextmanager
    def blames(self, episode: int, step: int | None, call: str) -> Iterator[None]:
        """Turn what is raised inside into an error that says in which episode."""
        try:
            yield
        except Mismatch as mismatch:
            raise self._promised(episode, step, mismatch) from None
        except Exception as error:
            raise self._crash(episode, step, call, error) from error

    def note(
        self,
        alive: Sequence[int],
        step: int,
        rewards: np.ndarray,
        terminated: np.ndarray,
        reset: np.ndarray,
    ) -> None:
        """Record a step's (B,) rewards, ends and resets of episodes that step together."""
        self.rewards[alive, step] = rewards
        self.terminated[alive] = terminated
        self.physics_resets[alive] += reset

    def check_rewards(self, alive: Sequence[int], step: int) -> None:
        """Raise where a reward is not finite: it would make every mean so."""
        rewards = self.rewards[alive, step]
        if not np.isfinite(rewards).all():
            row = int((~np.isfinite(rewards)).argmax())
            raise self._fault(alive[row], step, f"the reward is {rewards[row]}", "a finite number")

    def observed(
        self,
        observations: Sequence[np.ndarray] | np.ndarray,
        alive: Sequence[int],
        step: int | None,
    ) -> np.ndarray:
        """Return observations as one float32 array; looked at together, for it is quicker so.

        Args:
            observations: One for each of the episodes `alive`.
            alive: Numbers of the episodes.
            step: That they were returned by, or None for the reset.
        """
        size = self.observations.shape[2]
        try:
            # numpy would drop the masks of masked arrays.
            one = type(observations) is np.ndarray  # one array is looked at as a whole
            whole = one or not any(map(np.ma.is_masked, observations))
            batch = np.array(observations) if whole else np.empty(0)
        except ValueError:  # of several lengths
            batch = np.empty(0)
        if batch.shape == (len(alive), size) and batch.dtype.kind in "fiu":
            narrow = batch.astype(np.float32, copy=False)
            if np.isfinite(narrow).all():
                if narrow is not batch:
                    self._narrowing.see(batch, narrow)
                return narrow
        for episode, observation in zip(alive, observations, strict=True):
            problem = _problem(observation, size)
            if problem is not None:
                raise self._fault(episode, step, problem, f"{size} finite numbers, as promised")
        raise AssertionError("good observations make a good batch")

    def hold(
        self, alive: Sequence[int], step: int, decision: Decision
    ) -> tuple[Decision, np.ndarray]:
        """Let those who have no answer go on as they did in the last step, for a while.

        Returns:
            The decision with actions everywhere, and (B,) bool, whose episodes go on.
        """
        assert decision.silent is not None, "asked only where somebody is silent"
        numbers = np.asarray(alive)
        before = np.where(self._silent_at[numbers] == step - 1, self._held[numbers], 0)
        self._held[numbers] = np.where(decision.silent, before + 1, 0)
        self._silent_at[numbers[decision.silent]] = step
        self.given_up[numbers] = self._held[numbers] > HOLD
        # At the start there is no last action: the one nearest to none.
        last = self.actions[numbers, step - 1] if step else np.zeros_like(decision.action)
        actions = np.where(decision.silent[:, None], last, decision.action)
        return decision._replace(action=actions), ~self.given_up[numbers]

    def decide(
        self, alive: list[int], step: int, observations: np.ndarray, decision: Decision
    ) -> np.ndarray:
        """Record a step's decision; return its actions as the environment takes them."""
        expected = (len(alive), self.actions.shape[2])
        if decision.action.shape == expected and not np.isfinite(decision.action).all():
            row = int((~np.isfinite(decision.action).all(axis=1)).argmax())
            raise EnvironmentFault(
                f"{self._where(alive[row], step)}: the policy's action is not finite",
                f"{expected[1]} finite numbers",
                "check the policy's weights, and its answer to the observations of that episode",
            )
        if decision.action.shape != expected:
            raise EnvironmentFault(
                f"a policy answered with actions of shape {decision.action.shape}",
                f"{expected}, as the environment takes",
                "check that policy and environment belong together",
            )
        self.observations[alive, step] = observations
        self.actions[alive, step] = decision.action
        self.valid[alive, step] = True
        if decision.expert_action is not None:
            none = silent_rows(decision.expert_action)
            self.answered[alive, step] = True if none is None else ~none
            self.refused[alive, step] = False if none is None else none
            self.expert_actions[alive, step] = decision.expert_action
        allowed, clipped = self._bounds.put_inside(decision.action)
        self.clipped_actions += clipped
        return allowed

    def episodes(self) -> Episodes:
        """Return what was recorded; warn of physics that reset themselves.

        Raises:
            EnvironmentFault: If float32 holds nothing of how the observations move.
        """
        self._narrowing.judge()
        unstable = np.count_nonzero(self.physics_resets)
        if unstable:
            warn(
                f"{self._name}: the simulation became unstable and reset itself in {unstable} of "
                f"{len(self._seeds)} episodes; their returns are of more than one start"
            )
        return Episodes(
            self.observations,
            self.actions,
            self.expert_actions,
            self.answered,
            self.rewards,
            self.valid,
            np.asarray(self._seeds, np.int64),
            self.terminated,
            self.clipped_actions,
            self.physics_resets,
            self.refused,
            self.given_up,
        )

    def _where(self, episode: int, step: int | None) -> str:
        when = "" if step is None else f", step {step}"
        return f"{self._name}, episode {episode} (seed {self._seeds[episode]}){when}"

    def _promised(self, episode: int, step: int | None, mismatch: Mismatch) -> EnvironmentFault:
        found = f"an observation with {mismatch}"
        return self._fault(episode, step, found, "what its observation_space promises")

    def _fault(
        self, episode: int, step: int | None, problem: str, expected: str
    ) -> EnvironmentFault:
        return EnvironmentFault(
            f"{self._where(episode, step)}: {problem}",
            expected,
            "mend the environment, or end the episode before it diverges",
        )

    def _crash(
        self,
        episode: int,
        step: int | None,
        call: str,
        error: Exception,
        advice: str | None = None,
    ) -> EnvironmentFault:
        said = f"{call} raised {type(error).__name__}: {first_line(error)}"
        return EnvironmentFault(
            f"{self._where(episode, step)}: {said}",
            "an environment that runs without raising",
            advice or "run it on its own from that seed, and mend it",
        )


def _described(answer: object) -> str:
    if not isinstance(answer, tuple):
        return f"a {type(answer).__name__}"
    if len(answer) != 5:
        return f"{len(answer)} things"
    parts = zip(("reward", "terminated", "truncated"), answer[1:4], strict=True)
    return ", ".join(f"{name}={_printed(value)}" for name, value in parts)[:200]


def _printed(value: object) -> str:
    try:
        return repr(value)
    except Exception as error:  # int has a longest text, and a class of the user's may raise
        return f"a {type(value).__name__} ({first_line(error)})"


def _reset_advice(error: Exception) -> str | None:
    """Return what to do about a reset() that raises for a reason that is often met, or None."""
    said = first_line(error)
    if isinstance(error, TypeError) and "unexpected keyword argument" in said:
        return "write def reset(self, *, seed=None, options=None): gymnasium passes both by name"
    frame, inside = error.__traceback__, {}
    while frame is not None:
        inside, frame = frame.tb_frame.f_locals, frame.tb_next
    looked_up = isinstance(error, AssertionError | KeyError) and inside.get("options", "") is None
    if "options" in said or "'NoneType' object" in said or looked_up:
        return (
            "if it needs options, pass fdtasil.Environment(env, reset_options={...}), "
            "--reset-options in a shell"
        )
    return None


def _described_reset(answer: object) -> str:
    """Return in words what reset() returned."""
    if isinstance(answer, tuple) and len(answer) == 2:
        return f"a {type(answer[1]).__name__} in place of info"
    if isinstance(answer, tuple):
        return f"{len(answer)} things"
    shape = f" of shape {np.shape(answer)}" if isinstance(answer, np.ndarray) else ""
    return f"a {type(answer).__name__}{shape}"


def _own(observation: Any) -> Any:
    """Return an observation that stays as it is when the environment writes into its buffer."""
    if isinstance(observation, np.ndarray):
        return observation.copy()
    with suppress(Exception):  # what can't be copied is no vector, and is named so in a moment
        return copy.deepcopy(observation)
    return observation


def _number(value: object) -> float:
    """Return a reward or an end as a number; numpy's and torch's of one element are as good.

    Raises:
        TypeError, ValueError: If it is none: float("1") and bool("False") would pass for one.
        OverflowError: If it is too large for a float.
    """
    if not isinstance(value, Real):
        if np.ma.is_masked(value) or np.asarray(value).dtype.kind not in "biuf":
            raise TypeError
        if np.size(value) != 1:  # pyright: ignore[reportArgumentType]
            raise ValueError
        return float(np.asarray(value).reshape(()))
    return float(value)


def _problem(observation: object, size: int) -> str | None:
    """Return what is wrong with an observation, or None."""
    if np.ma.is_masked(observation):
        return "some of the observation's values are masked"
    values = np.asarray(observation)
    if values.dtype.kind not in "fiu":
        return f"the observation is a {type(observation).__name__} of {values.dtype}"
    if values.shape != (size,):
        return f"the observation has shape {values.shape}"
    bad = ~np.isfinite(values.astype(np.float32))
    if not bad.any():
        return None
    first = int(bad.argmax())
    return (
        f"{bad.sum()} of the observation's {size} values are not finite in float32, "
        f"the first is value {first}: {values[first]}"
    )
