"""What an environment argument means: an id, an instance or a factory, and its two spaces."""

import copy
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import gymnasium
import numpy as np

from fdtasil.checks import check_count
from fdtasil.compute import in_turn
from fdtasil.errors import EnvironmentFault, SettingError, first_line, warn
from fdtasil.rollouts.flattening import Flat, bounds_of, unbounded
from fdtasil.rollouts.spaces import Layout, Spaces, UnknownSpace, layout_of
from fdtasil.rollouts.vector import Together, vector_of
from fdtasil.rollouts.wanted import Environment

__all__ = [
    "EnvironmentLike",
    "EnvironmentPool",
    "bounds_text",
    "resolve_horizon",
    "simulator_warnings",
]

EnvironmentLike = (
    str | gymnasium.Env | gymnasium.vector.VectorEnv | Callable[[], Any] | Environment
)
"""An id, an environment, one of many that step together (stable-baselines3's too), a function
that makes one of them, or an id with what it is made with."""


@dataclass(frozen=True)
class Boxes:
    """The spaces of an environment, flat.

    Attributes:
        observation_size: n, the length of an observation.
        low: (m,) float32, lower action bounds in environment units; -inf where there is none.
            Bounds that float32 does not have are rounded inwards.
        high: (m,) float32, upper action bounds.
        observation_low: (n,) float64, lower bounds of the observations; -inf where there is none.
        observation_high: (n,) float64, upper ones. None where nobody asks for them.
    """

    observation_size: int
    low: np.ndarray
    high: np.ndarray
    observation_low: np.ndarray | None = None
    observation_high: np.ndarray | None = None

    @property
    def action_size(self) -> int:
        """m, the length of an action."""
        return len(self.low)

    @property
    def bounded(self) -> np.ndarray:
        """(m,) bool, the actions that have both bounds."""
        return np.isfinite(self.low) & np.isfinite(self.high)


def bounds_text(low: np.ndarray, high: np.ndarray) -> str:
    """Return the bounds of actions in words: one number where all are equal, else the first."""
    return f"{_ends_text(low)} to {_ends_text(high)}"


def _ends_text(bounds: np.ndarray) -> str:
    if (bounds == bounds[0]).all():
        return f"{bounds[0]:g}"
    more = ", ..." if len(bounds) > _SHOWN else ""
    return f"[{', '.join(f'{bound:g}' for bound in bounds[:_SHOWN])}{more}]"


_SHOWN = 6  # bounds that differ


@dataclass(frozen=True)
class OwnBounds:
    """The action bounds as the environment has them: its own dtype, not rounded.

    Attributes:
        low: (m,) lower bounds.
        high: (m,) upper bounds.
    """

    low: np.ndarray
    high: np.ndarray

    def put_inside(self, actions: np.ndarray) -> tuple[np.ndarray, int]:
        """Return actions as the environment takes them, and how many rows had to be clipped.

        Args:
            actions: (B, m) float32.
        """
        # float32 has no 0.1: an action at such a bound is beyond it by a rounding, and is not
        # counted.
        low, high = (np.asarray(bound, np.float32) for bound in (self.low, self.high))
        clipped = np.minimum(np.maximum(actions, low), high)
        count = int((clipped != actions).any(axis=1).sum())
        own = clipped.astype(self.low.dtype, copy=False)
        if own.dtype == np.float32:
            return own, count
        return np.minimum(np.maximum(own, self.low), self.high), count


class EnvironmentPool:
    """Equal copies of one environment, made when they are needed and kept for the next rollout.

    Args:
        environment: A gymnasium id (`module:Id` imports the module first), a gymnasium
            environment, a vector environment (gymnasium's or stable-baselines3's), a function
            without arguments that makes one, or an `Environment`. An environment that is passed
            in is used as it is, and is not closed.

    Attributes:
        name: What messages call it.
        made: How it is made and reset, in words; None where its id says it all.
        time_limit: Steps after which it ends an episode itself, or None.
        spaces: Its spaces.
        boxes: The same, flat.
        bounds: Of its actions, in its own dtype.
        together: The environment, where it is a vector environment; else None.
        options: Given to each reset, or None.
        independent: Whether its copies are known not to disturb each other.
        trials: What it did when it was tried, by seed; see `trials.py`.

    Raises:
        EnvironmentFault: If it can't be made, or its spaces have no flat form.

    Example:
        >>> with EnvironmentPool("Pendulum-v1") as pool:
        ...     pool.boxes.observation_size, pool.boxes.action_size
        (3, 1)
    """

    def __init__(self, environment: EnvironmentLike) -> None:
        wanted = environment if isinstance(environment, Environment) else Environment(environment)
        self.options, given = wanted.reset_options, wanted.environment
        self.made = wanted.made
        self._owned = isinstance(given, str) or (
            callable(given) and not isinstance(given, gymnasium.Env)
        )
        self._single = False
        self._advice = (
            _OF_AN_ID
            if isinstance(given, str)
            else "call it on its own; an expert comes before the environment"
        )
        if wanted.kwargs:
            self._advice = f"check the names in kwargs ({', '.join(map(str, wanted.kwargs))})"
        if isinstance(given, str) and given not in gymnasium.registry and os.path.isfile(given):
            raise EnvironmentFault(
                f"the file {given} in the place of the environment",
                "the expert, then a gymnasium id",
                f"write {given} Pendulum-v1, say",
            )
        self._make = wanted.factory()
        self._members: list[gymnasium.Env] = []
        self._kept: list[gymnasium.Env] = []  # only to be closed
        self.independent = False
        self.trials: dict[int, Any] = {}
        self.together: Together | None = None
        first = self._new()
        try:
            self._open(first)
        except BaseException:
            self._members, self.together = [], None
            self._close(first)
            raise

    def _open(self, first: Any) -> None:
        """Read what the first one is."""
        self.together = vector_of(first)
        if self.together is None:
            env = self._checked(first)
            self.name = env.spec.id if env.spec else type(env.unwrapped).__name__
            self.time_limit = _time_limit(env)
            self.spaces = _spaces_of(env, self.name)
            self._members = [self._flat(env)]
            self.boxes, self.bounds = _read_boxes(self._members[0], self.name)
        else:
            self.name, self.time_limit = self.together.name, self.together.time_limit
            self.spaces = _spaces_of(self.together, self.name)
            self.boxes, self.bounds = _read_boxes(self.together, self.name, self.spaces)

    @property
    def reset_options(self) -> dict[str, Any]:
        """The options of a reset as its arguments: a copy, which it may change, or none."""
        return {} if self.options is None else {"options": copy.deepcopy(self.options)}

    def take(self, count: int) -> list[gymnasium.Env]:
        """Return up to `count` copies; fewer where only one exists, or can be open at once."""
        refused = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the first copy has said it all
            while self._owned and not self._single and len(self._members) < count:
                try:
                    made = self._flat(self._checked(self._new()))
                except EnvironmentFault as error:  # a port, or a window, that is in use
                    refused, self._single = error, True
                    break
                if any(made.unwrapped is member.unwrapped for member in self._members):
                    self._owned = False  # a factory that hands out one and the same
                    break
                self._members.append(made)
        if refused is not None:
            warn(
                f"{self.name} can't be made {len(self._members) + 1} times ({refused.found}): "
                f"episodes are played in {len(self._members)} at once"
            )
        return self._members[:count]

    def wrap(self, wrapper: Callable[[gymnasium.Env], gymnasium.Env]) -> None:
        """Put a wrapper around every copy, those that are made later too."""
        if self.together is not None:
            raise EnvironmentFault(
                f"{self.name} is a vector environment, and a memory or a history is kept",
                "one environment, or a function that makes one",
                'write for example env="Ant-v5"; copies of it are played side by side',
            )
        before = self._flat
        self._flat = lambda made: wrapper(before(made))
        self._members = [wrapper(member) for member in self._members]
        self.boxes, self.bounds = _read_boxes(self._members[0], self.name)

    def keep_to_one(self) -> None:
        """Hand out the first copy alone from now on."""
        self._kept += self._members[1:]
        del self._members[1:]
        self._single = True

    def close(self) -> None:
        """Close the copies that the pool made; what can't be closed is warned of."""
        together = [] if self.together is None else [self.together]
        for member in [*self._members, *self._kept, *together]:
            self._close(member)

    def _close(self, member: Any) -> None:
        if not self._owned or not hasattr(member, "close"):
            return
        try:
            member.close()
        except Exception as error:  # of the user's; what was done in it is not lost for that
            kind, name = type(error).__name__, getattr(self, "name", "the environment")
            warn(f"{name} can't be closed: {kind}: {first_line(error)}")

    def __enter__(self) -> "EnvironmentPool":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _new(self) -> Any:
        try:
            with simulator_warnings():
                return self._make()
        except EnvironmentFault:
            raise
        except Exception as error:  # a factory is the caller's code and may raise anything
            unknown = isinstance(error, gymnasium.error.UnregisteredEnv)
            raise EnvironmentFault(
                f"the environment can't be made: {first_line(error)}",
                "a gymnasium id, an environment, or a function without arguments that makes one",
                f"{_OF_AN_ID}{_REGISTER}" if unknown else self._advice,
            ) from error

    def _checked(self, made: object) -> gymnasium.Env:
        if isinstance(made, gymnasium.Env):
            return made
        raise EnvironmentFault(
            f"the environment factory returned {type(made).__name__}",
            "a gymnasium.Env, or a vector environment of gymnasium or stable-baselines3",
            "return gymnasium.make(...) from it",
        )

    def _flat(self, made: gymnasium.Env) -> gymnasium.Env:  # pyright: ignore[reportRedeclaration]
        """Return a copy with flat spaces, and with what `wrap` puts around it."""
        return made if self.spaces.plain else Flat(made, self.spaces)


_OF_AN_ID = "try gymnasium.make(...) on its own; ids of other packages are 'module:Id'"
_REGISTER = "; that module must call gymnasium.register(id=..., entry_point=...)"


def resolve_horizon(horizon: int | None, pool: EnvironmentPool) -> int:
    """Return the number of steps after which an episode is cut, by us or by the environment.

    Raises:
        SettingError: If it is not a positive integer, or neither the caller nor the environment
            sets one.
    """
    limit = pool.time_limit
    if horizon is None and limit is None:
        raise SettingError(
            f"no horizon for {pool.name}, whose episodes no TimeLimit ends",
            "a positive number of steps",
            "write for example horizon=300",
        )
    steps = check_count("horizon", limit if horizon is None else horizon)
    if limit is not None and steps > limit:
        warn(f"horizon={steps}: {pool.name} ends its episodes at {limit} steps, which is used")
        return limit
    return steps


@contextmanager
def simulator_warnings() -> Iterator[None]:
    """Pass MuJoCo's warnings on to Python, each once, when the block ends.

    MuJoCo itself would print each for every copy of the environment, and write it into a file
    MUJOCO_LOG.TXT of the working folder. Those of a deprecated attribute in gymnasium's own model
    files tell a user nothing; those of unstable physics are counted by rollouts.
    """
    import mujoco

    # getattr: the type stubs do not know these two functions.
    get, put = (getattr(mujoco, f"{verb}_mju_user_warning") for verb in ("get", "set"))
    messages = dict[str, None]()
    with in_turn():  # the process has one such function
        before = get()
        put(lambda message: messages.update({message: None}))
        try:
            yield
        finally:
            put(before)
    for message in messages:
        if "deprecated" not in message and "simulation is unstable" not in message:
            warn(f"MuJoCo: {message}")


def _time_limit(environment: gymnasium.Env) -> int | None:
    """Return the least number of steps after which the environment itself cuts an episode."""
    limits = [environment.spec.max_episode_steps] if environment.spec else []
    layer = environment
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, gymnasium.wrappers.TimeLimit):
            limits.append(layer._max_episode_steps)  # it has no other name
        layer = layer.env
    return min((limit for limit in limits if limit), default=None)


def _spaces_of(environment: gymnasium.Env | Together, name: str) -> Spaces:
    for role in ("observation_space", "action_space"):
        if getattr(environment, role, None) is None:
            raise EnvironmentFault(
                f"{name} has no {role}",
                "both spaces, as attributes",
                f"write self.{role} = gymnasium.spaces.Box(low, high, (size,)) in its __init__",
            )
    try:
        return Spaces.of(environment)
    except UnknownSpace as unknown:
        raise EnvironmentFault(
            f"{name} has {unknown}",
            "a Box, Discrete, MultiDiscrete or MultiBinary space, or a Dict or Tuple of them "
            "(of actions, boxes of floats)",
            "choose or wrap the environment so",
        ) from None


def _read_boxes(
    environment: gymnasium.Env | Together, name: str, spaces: Spaces | None = None
) -> tuple[Boxes, OwnBounds]:
    """Return the flat spaces of an environment that has such, or whose layouts are given."""
    if spaces is None:
        seen, acted = (
            layout_of(space, "")
            for space in (environment.observation_space, environment.action_space)
        )
    else:
        seen, acted = spaces.observations, spaces.actions
    ends = _action_bounds(environment, acted)
    own = OwnBounds(*map(unbounded, ends))
    low, high = _rounded(own.low, np.inf), _rounded(own.high, -np.inf)
    if not (low < high).all():
        first = int((~(low < high)).argmax())
        raise EnvironmentFault(
            f"{name}: action {first} has the bounds {low[first]:g} to {high[first]:g}",
            "lower bounds below upper bounds",
            "drop the fixed actions with a gymnasium.ActionWrapper",
        )
    wide = (
        unbounded(bound.astype(np.float64))
        for bound in bounds_of(environment.observation_space, seen)
    )
    return Boxes(seen.size, low, high, *wide), own


def _action_bounds(
    environment: gymnasium.Env | Together, layout: Layout
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of actions; those that ClipAction hides are the ones it clips to."""
    layer, inside = environment, layout
    while isinstance(layer, gymnasium.Wrapper):
        clips = isinstance(layer, gymnasium.wrappers.ClipAction)
        if isinstance(layer, Flat):
            inside = layer.spaces.actions
        elif not clips and layer.action_space != layer.env.action_space:
            break
        layer = layer.env
        if clips:
            return bounds_of(layer.action_space, inside)
    return bounds_of(environment.action_space, layout)


def _rounded(bound: np.ndarray, inwards: float) -> np.ndarray:
    """Return bounds as float32, none of them beyond what was given."""
    near = bound.astype(np.float32)
    beyond = near < bound if inwards > 0 else near > bound
    return np.where(beyond, np.nextafter(near, np.float32(inwards)), near)
