"""Episodes while they are recorded: every answer of an environment is looked at here."""

from collections.abc import Sequence

import gymnasium
import numpy as np

from fdtasil.errors import EnvironmentFault, first_line, warn
from fdtasil.rollouts.behaviours import Decision
from fdtasil.rollouts.environments import EnvironmentPool
from fdtasil.rollouts.episodes import Episodes

__all__ = ["Recording"]


class Recording:
    """The arrays of `Episodes` while they are being filled.

    Args:
        seeds: (E,) reset seed of each episode.
        horizon: T, steps after which an episode is cut.
        pool: The environment.
    """

    def __init__(self, seeds: Sequence[int], horizon: int, pool: EnvironmentPool) -> None:
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        self._low, self._high, self._name = pool.boxes.low, pool.boxes.high, pool.name
        self._seeds, episodes = [int(seed) for seed in seeds], len(seeds)
        self.observations = np.zeros((episodes, horizon, n), np.float32)
        self.actions = np.zeros((episodes, horizon, m), np.float32)
        self.expert_actions = np.zeros((episodes, horizon, m), np.float32)
        self.answered = np.zeros((episodes, horizon), bool)
        self.rewards = np.zeros((episodes, horizon))
        self.valid = np.zeros((episodes, horizon), bool)
        self.terminated = np.zeros(episodes, bool)
        self.physics_resets = np.zeros(episodes, np.int64)
        self.clipped_actions = 0
        # Of MuJoCo's simulations, None elsewhere; asking an environment for it takes a while.
        self._data: list[object] = [None] * episodes

    def reset(self, environment: gymnasium.Env, episode: int) -> np.ndarray:
        """Return the first observation of an episode."""
        try:
            observation, _ = environment.reset(seed=self._seeds[episode])
        except Exception as error:
            raise self._crash(episode, None, "reset()", error) from error
        self._data[episode] = getattr(environment.unwrapped, "data", None)
        return observation

    def step(
        self, environment: gymnasium.Env, action: np.ndarray, episode: int, step: int
    ) -> tuple[np.ndarray, bool]:
        """Record a step's outcome; return the observation and whether the episode goes on."""
        data = self._data[episode]
        before = _clock(data)
        try:
            answer = environment.step(action)
        except Exception as error:
            raise self._crash(episode, step, "step()", error) from error
        try:
            observation, reward, terminated, truncated, _ = answer
            self.rewards[episode, step] = float(reward)
            self.terminated[episode] = bool(terminated)
            going = not (terminated or truncated)
        except (TypeError, ValueError) as error:
            raise self._fault(
                episode,
                step,
                f"step() returned {_described(answer)}",
                "(observation, reward, terminated, truncated, info), the reward one number",
            ) from error
        # MuJoCo resets an unstable simulation inside step() and says so only by its clock, and
        # where the clock had not come far by its warnings.
        now = _clock(data)
        if now < before or ((now == before or step == 0) and _unstable(data)):
            self.physics_resets[episode] += 1
        return observation, going

    def check_rewards(self, alive: Sequence[int], step: int) -> None:
        """Raise where a reward is not finite: it would make every mean so."""
        rewards = self.rewards[alive, step]
        if not np.isfinite(rewards).all():
            row = int((~np.isfinite(rewards)).argmax())
            raise self._fault(alive[row], step, f"the reward is {rewards[row]}", "a finite number")

    def observed(
        self, observations: Sequence[np.ndarray], alive: Sequence[int], step: int | None
    ) -> np.ndarray:
        """Return observations as one float32 array; looked at together, for it is quicker so.

        Args:
            observations: One for each of the episodes `alive`.
            alive: Numbers of the episodes.
            step: That they were returned by, or None for the reset.
        """
        size = self.observations.shape[2]
        try:
            batch = np.array(observations)
        except ValueError:  # of several lengths
            batch = np.empty(0)
        if batch.shape == (len(alive), size) and batch.dtype.kind in "fiu":
            batch = batch.astype(np.float32, copy=False)
            if np.isfinite(batch).all():
                return batch
        for episode, observation in zip(alive, observations, strict=True):
            problem = _problem(observation, size)
            if problem is not None:
                raise self._fault(episode, step, problem, f"{size} finite numbers, as promised")
        raise AssertionError("good observations make a good batch")

    def decide(
        self, alive: list[int], step: int, observations: np.ndarray, decision: Decision
    ) -> np.ndarray:
        """Record a step's decision; return its actions within the bounds."""
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
            self.expert_actions[alive, step] = decision.expert_action
            self.answered[alive, step] = True
        allowed = np.minimum(np.maximum(decision.action, self._low), self._high)
        self.clipped_actions += int((allowed != decision.action).any(axis=1).sum())
        return allowed

    def episodes(self) -> Episodes:
        """Return what was recorded; warn of physics that reset themselves."""
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
        )

    def _where(self, episode: int, step: int | None) -> str:
        when = "" if step is None else f", step {step}"
        return f"{self._name}, episode {episode} (seed {self._seeds[episode]}){when}"

    def _fault(
        self, episode: int, step: int | None, problem: str, expected: str
    ) -> EnvironmentFault:
        return EnvironmentFault(
            f"{self._where(episode, step)}: {problem}",
            expected,
            "mend the environment, or end the episode before it diverges",
        )

    def _crash(
        self, episode: int, step: int | None, call: str, error: Exception
    ) -> EnvironmentFault:
        said = f"{call} raised {type(error).__name__}: {first_line(error)}"
        return EnvironmentFault(
            f"{self._where(episode, step)}: {said}",
            "an environment that runs without raising",
            "run it on its own from that seed, and mend it",
        )


def _clock(data: object) -> float:
    """Return the time of a MuJoCo simulation; 0 where there is none."""
    time = getattr(data, "time", 0.0)
    return time if isinstance(time, float) else 0.0


def _unstable(data: object) -> bool:
    """Return whether MuJoCo has found a simulation unstable since the episode began."""
    numbers = getattr(getattr(data, "warning", None), "number", None)
    if numbers is None:
        return False
    import mujoco  # whoever has such data has loaded it

    kinds = (f"mjWARN_BAD{what}" for what in ("QPOS", "QVEL", "QACC"))
    return any(numbers[int(vars(mujoco)["mjtWarning"].__members__[kind])] for kind in kinds)


def _described(answer: object) -> str:
    if not isinstance(answer, tuple):
        return f"a {type(answer).__name__}"
    if len(answer) != 5:
        return f"{len(answer)} things"
    return f"reward={answer[1]!r}, terminated={answer[2]!r}, truncated={answer[3]!r}"[:200]


def _problem(observation: object, size: int) -> str | None:
    """Return what is wrong with an observation, or None."""
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
