"""An environment that is not made yet, with what it is to be made and reset with."""

import importlib
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gymnasium

from fdtasil.checks import check_count, spelt
from fdtasil.errors import EnvironmentFault, SettingError, shown
from fdtasil.rollouts.vector import make_vector, vector_of

__all__ = ["Environment", "import_module_of"]


@dataclass(frozen=True)
class Environment:
    """An environment, and how it is made and reset.

    Attributes:
        environment: A gymnasium id, or whatever else `env=` may be.
        kwargs: What an id is made with, as in `gymnasium.make(id, **kwargs)`.
        reset_options: Given to every `reset(options=...)`; a copy each time.
        num_envs: Of an id, how many are made, each in a process of its own; 0 for copies in this
            process.

    Raises:
        SettingError: If an argument can't be used.

    Example:
        >>> import fdtasil, numpy as np
        >>> moon = fdtasil.Environment("Pendulum-v1", kwargs={"g": 1.6})
        >>> lazy = lambda observations: np.zeros((len(observations), 1))
        >>> fdtasil.evaluate(lazy, lazy, moon, episodes=2, horizon=20).episodes
        2
    """

    environment: Any
    kwargs: Mapping[str, Any] | None = None
    reset_options: Mapping[str, Any] | None = None
    num_envs: int = 0

    def __post_init__(self) -> None:
        check_count("num_envs", self.num_envs, least=0)
        for name in ("kwargs", "reset_options"):
            given = getattr(self, name)
            if given is not None and not isinstance(given, Mapping):
                raise SettingError(
                    spelt(name, given), "names with values", f'write {name}={{"name": 1.0}}'
                )
        if not isinstance(self.environment, str) and (self.kwargs or self.num_envs):
            name = "kwargs" if self.kwargs else "num_envs"
            raise SettingError(
                f"{name}= with env= that is no id",
                "an id of gymnasium, which is made with it",
                "pass a function that makes it so, such as lambda: MyEnv(limit=50)",
            )

    @property
    def made(self) -> str | None:
        """How it is made and reset, in words; None where its id says it all."""
        told = []
        if not isinstance(self.environment, str):
            called = getattr(self.environment, "__name__", None)
            told.append(f"made by {called}" if called else "made by the caller")
        elif ":" in self.environment:  # gymnasium forgets it
            told.append(f"module={self.environment.partition(':')[0]!r}")
        for name in ("kwargs", "reset_options"):
            if getattr(self, name):
                told.append(f"{name}={dict(getattr(self, name))!r}")
        return shown(", ".join(told)) if told else None

    def factory(self) -> Callable[[], Any]:
        """Return what makes one.

        Raises:
            EnvironmentFault: If there is no way to.
        """
        given, kwargs = self.environment, dict(self.kwargs or {})
        if isinstance(given, str) and self.num_envs:
            return lambda: make_vector(given, self.num_envs, kwargs)
        if isinstance(given, str):
            return lambda: gymnasium.make(given, **kwargs)
        if isinstance(given, gymnasium.Env) or vector_of(given) is not None:
            return lambda: given
        if callable(given):
            return given
        raise EnvironmentFault(
            f"env is a {type(given).__name__}",
            "a gymnasium id, an environment, or a function that makes one",
            'write for example env="HalfCheetah-v5"',
        )


def import_module_of(environment: str | None) -> None:
    """Import the module of "module:Id", and that of its environment, from the current folder.

    Nothing else is looked for there: a folder that somebody else filled runs no code by itself.
    """
    module, named, name = (environment or "").partition(":")
    here = os.getcwd()
    if not named or here in sys.path:
        return
    sys.path.append(here)
    try:
        with suppress(ImportError):  # gymnasium says what is missing
            importlib.import_module(module)
            known = gymnasium.registry.get(name)
            if known is not None and isinstance(known.entry_point, str):
                importlib.import_module(known.entry_point.partition(":")[0])
    finally:
        sys.path.remove(here)
