"""A student that sees the last observations and actions, with a buffer of its own."""

import numpy as np

from fdtasil.checks import check_count
from fdtasil.errors import SettingError
from fdtasil.rollouts.history import Window, present_size
from fdtasil.student.asking import as_numbers, check_choosing
from fdtasil.student.policy import Student

__all__ = ["History"]


class History:
    """Asks a student step by step, and keeps what it is to see of the steps before.

    Args:
        student: Trained with `history=`.
        history: H, as in that call.

    Raises:
        SettingError: If the student was trained with another, as far as sizes tell.

    Example:
        >>> import numpy as np
        >>> import fdtasil, torch
        >>> n, m = 2, 1
        >>> size = n + 2 * (n + m)  # of a history of three
        >>> student = fdtasil.Student(fdtasil.Mlp(8), np.zeros(size), np.ones(size),
        ...                           -np.ones(m), np.ones(m), torch.Generator())
        >>> policy = History(student, 3)
        >>> policy.observation_size, policy.predict(np.zeros(n), episode_start=True)[0].shape
        (2, (1,))
    """

    def __init__(self, student: Student, history: int) -> None:
        if not isinstance(student, Student):
            found = f"a {type(student).__name__} in the place of a student"
            raise SettingError(found, "a Student", "write History(result.student, history)")
        history, m = check_count("history", history), student.action_size
        self.observation_size, rest = present_size(student.observation_size, history, m)
        if rest or self.observation_size < 1:
            raise SettingError(
                f"history={history} of a student that sees {student.observation_size} numbers",
                f"H observations and H - 1 actions of {m}",
                "pass the history that it was trained with",
            )
        self._student, self._history = student, history
        self._window = Window(history, self.observation_size, m)

    def __repr__(self) -> str:
        m = self._student.action_size
        seen = f"{self._history} observations of {self.observation_size}"
        return f"History({seen} -> {m} actions)"

    def reset(self) -> None:
        """Forget what was seen, before an episode begins."""
        self._window.clear()

    def predict(
        self,
        observation: np.ndarray,
        state: None = None,
        episode_start: bool | np.ndarray = False,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, None]:
        """Answer one observation (n,), and remember it.

        A vector environment of one is answered too, as stable-baselines3 asks: an observation
        (1, n) and an episode_start (1,) with one action (1, m).

        Raises:
            SettingError: If it has another shape.

        Args:
            observation: (n,) raw observation.
            state: Not used; what is remembered is kept here.
            episode_start: Whether an episode begins, before which there is nothing.
            deterministic: Not used; the student always is.
        """
        episodes = np.shape(episode_start)
        if episodes not in ((), (1,)):
            raise SettingError(
                f"episode_start of shape {episodes}",
                "one episode, which a History follows",
                "make the vector environment with n_envs=1",
            )
        if np.any(episode_start):
            self.reset()
        n = self.observation_size
        step = "pass result.dataset.spaces.observations.row(observation)"
        seen = as_numbers(observation, f"({n},), its flat form", step)
        together = episodes == (1,) and seen.shape == (1, n)
        seen = seen[0] if together else seen
        if seen.shape != (n,):
            raise SettingError(
                f"an observation of shape {seen.shape}",
                f"({n},), one observation of a history of {self._history}",
                "pass the environment's own, of a vector environment of one with its "
                "episode_start; another history would ask for another size",
            )
        rows = self._window.behind(seen)[None].astype(np.float32)
        action, spaces = self._student.answer(rows)[0], self._student.spaces
        if spaces is None:
            self._window.push(seen, action)
            return action[None] if together else action, None
        check_choosing(action[None], spaces.actions)
        self._window.push(seen, spaces.actions.done(action))
        actions = spaces.actions
        return actions.values(action[None]) if together else actions.value(action), None
