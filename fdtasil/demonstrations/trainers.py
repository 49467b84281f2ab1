"""Who acts in round i: that is all a trainer is."""

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np

from fdtasil.checks import check_choice, check_count, check_number, check_share, spelt
from fdtasil.errors import SettingError, shown, warn
from fdtasil.experts.expert import Expert
from fdtasil.rollouts.behaviours import Behaviour, Decision, Policy, has_none, silent_rows
from fdtasil.rollouts.episodes import Episodes

__all__ = [
    "TRAINERS",
    "BehaviourCloning",
    "DAgger",
    "Dart",
    "NoisyExpert",
    "Situation",
    "Trainer",
    "check_choices",
    "describe_trainer",
    "rounds_of",
    "trainer_of",
]

_ADDRESS = re.compile(r" at 0x[0-9A-Fa-f]+")
UPDATES = (1, 5, 20, 30)
"""Trajectories after which the paper's DAgger and DART train anew (TaSIL, appendix)."""


@dataclass(frozen=True)
class Situation:
    """What a trainer knows at the start of a round.

    Attributes:
        round: i.
        expert: Answers, and counts its rows under "act".
        half_range: (m,) half the range of each action; 1 where it has none.
        student: The last round's policy; None in round 0.
        record: Behaviour and number of episodes -> that many extra episodes of the round, which
            are not labelled; their expert rows count.
        chooses: Whether actions are scores of choices.
        places: Of the episodes that are played, in the round: others, recorded in the place of
            some, take over what those were for. None for all of them in turn.
    """

    round: int
    expert: Expert
    half_range: np.ndarray
    student: Policy | None
    record: Callable[[Behaviour, int], Episodes]
    chooses: bool = False
    places: Sequence[int] | None = None


class Trainer(Protocol):
    """Decides how the episodes are split into rounds, and who acts in each.

    Attributes:
        name: What reports call it.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    def rounds(self, episodes: int) -> list[int]:
        """Return the number of episodes of each round; their sum is `episodes`."""
        ...

    def behaviour(self, situation: Situation) -> Behaviour:
        """Return who acts in the situation's round."""
        ...

    def queries(self, episodes: int, horizon: int) -> dict[str, int]:
        """Return the rows asked for acting and for labels, where no episode ends early."""
        ...


@dataclass(frozen=True)
class BehaviourCloning:
    """The expert acts, once."""

    name: str = field(default="bc", init=False)

    def rounds(self, episodes: int) -> list[int]:
        """One round of all episodes."""
        return [episodes]

    def behaviour(self, situation: Situation) -> Behaviour:
        """The expert's own actions, which are the labels at the same time."""
        return _expert_acts(situation.expert)

    def queries(self, episodes: int, horizon: int) -> dict[str, int]:
        """One row for each step."""
        return {"act": episodes * horizon, "label": 0}


@dataclass(frozen=True)
class DAgger:
    """A mixture of expert and student acts; the expert labels (Ross et al. 2011).

    Attributes:
        updates: Numbers of episodes after which the student is trained anew.
        beta: Share of the expert: a number b for b**round, or a function of the round. With a
            share of 0 the student acts alone, and the states are labelled afterwards.
        mix: "blend" (TaSIL: the convex combination of the two actions) or "switch" (the original:
            one of the two, drawn at each step); choices are always switched.
    """

    updates: tuple[int, ...] = UPDATES
    beta: float | Callable[[int], float] = 0.5
    mix: Literal["blend", "switch"] = "blend"
    name: str = field(default="dagger", init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "updates", _checked_updates(self.updates))
        check_choice("mix", self.mix, ("blend", "switch"))
        if not callable(self.beta):
            object.__setattr__(self, "beta", check_share("beta", self.beta))

    def share(self, round_: int) -> float:
        """Return the expert's share in a round."""
        return check_share("beta", self.beta(round_) if callable(self.beta) else self.beta**round_)

    def rounds(self, episodes: int) -> list[int]:
        """The episodes between two updates; the last round ends with the budget."""
        return _between(self.updates, episodes)

    def behaviour(self, situation: Situation) -> Behaviour:
        """The mixture; round 0 is the expert's, for there is no student yet."""
        student, expert = situation.student, situation.expert
        if student is None:
            return _expert_acts(expert)
        share = self.share(situation.round)
        # Nobody has chosen what is best by the mean of two scores.
        mix = _blend if self.mix == "blend" and not situation.chooses else _switch

        def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
            own = student(observations)
            if share == 0:
                return Decision(own, None)
            answers = expert.ask(observations, "act")
            # Where the expert has no answer, the student acts alone.
            theirs = np.where(has_none(answers)[:, None], own, answers)
            return Decision(mix(theirs, own, share, noise), answers)

        return act

    def queries(self, episodes: int, horizon: int) -> dict[str, int]:
        """One row for each step, under "label" where the student acts alone."""
        found = {"act": 0, "label": 0}
        for round_, count in enumerate(self.rounds(episodes)):
            alone = round_ > 0 and self.share(round_) == 0
            found["label" if alone else "act"] += count * horizon
        return found


@dataclass(frozen=True)
class Dart:
    """The expert acts with Gaussian noise as large as the student's error (Laskey et al. 2017).

    Attributes:
        updates: Numbers of episodes after which student and noise are made anew.
        alpha: 0 takes the covariance of the student's error as it is (TaSIL's choice); a positive
            number scales it so that an episode's expected squared noise sums up to alpha (DART,
            equation 4: alpha / (T tr(covariance))).
        extra: Episodes of the expert that the student's error is estimated on, in each round but
            the first; they are not trained on.
    """

    updates: tuple[int, ...] = UPDATES
    alpha: float = 0.0
    extra: int = 5
    name: str = field(default="dart", init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "updates", _checked_updates(self.updates))
        object.__setattr__(self, "alpha", check_number("alpha", self.alpha))
        object.__setattr__(self, "extra", check_count("extra", self.extra))

    def rounds(self, episodes: int) -> list[int]:
        """The episodes between two updates; the last round ends with the budget."""
        return _between(self.updates, episodes)

    def behaviour(self, situation: Situation) -> Behaviour:
        """The noisy expert; its labels are without noise."""
        expert = situation.expert
        if situation.student is None:
            return _expert_acts(expert)
        spread = self._spread(situation, situation.student)

        def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
            answers = expert.ask(observations, "act")
            normal = np.stack([random.standard_normal(len(spread)) for random in noise])
            noisy = (answers + normal @ spread).astype(np.float32)
            return Decision(noisy, answers, silent_rows(answers))

        return act

    def queries(self, episodes: int, horizon: int) -> dict[str, int]:
        """One row for each step, those of the extra episodes too."""
        extra = self.extra * (len(self.rounds(episodes)) - 1)
        return {"act": (episodes + extra) * horizon, "label": 0}

    def _spread(self, situation: Situation, student: Policy) -> np.ndarray:
        """Return the (m, m) square root of the noise's covariance."""
        episodes = situation.record(_expert_acts(situation.expert), self.extra)
        answered = episodes.answered
        if not answered.any():
            warn(
                f"the expert has no answer in the {self.extra} extra episodes of round "
                f"{situation.round}, which measure the student's error: no noise is added there"
            )
            return np.zeros((len(situation.half_range),) * 2)
        states = episodes.observations[answered]
        errors = (student(states) - episodes.expert_actions[answered]).astype(np.float64)
        covariance = errors.T @ errors / len(errors)
        if self.alpha > 0 and np.trace(covariance) > 0:
            covariance *= self.alpha / (episodes.valid.shape[1] * np.trace(covariance))
        # By eigenvalues, since a student that equals its expert somewhere makes it singular.
        values, vectors = np.linalg.eigh(covariance)
        return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


@dataclass(frozen=True)
class NoisyExpert:
    """The expert acts, in half of the episodes with Gaussian noise (arXiv 2507.09061, section 4).

    Attributes:
        sigma: Standard deviation of the noise, as a share of half the range of each action; in its
            own unit where an action lacks a bound.
    """

    sigma: float = 0.1
    name: str = field(default="noise", init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", check_number("sigma", self.sigma, example=0.1))

    def rounds(self, episodes: int) -> list[int]:
        """One round of all episodes."""
        return [episodes]

    def behaviour(self, situation: Situation) -> Behaviour:
        """The expert, noisy in the first episode and every second one after it; labels are not."""
        expert, spread = situation.expert, self.sigma * situation.half_range
        numbers: dict[np.random.Generator, int] = {}  # of episodes, by their own generator
        places = situation.places

        def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
            answers = expert.ask(observations, "act")
            actions = answers.copy()
            for row, random in enumerate(noise):
                number = numbers.setdefault(random, len(numbers))
                if (number if places is None else places[number]) % 2 == 0:
                    actions[row] += spread * random.standard_normal(len(spread))
            return Decision(actions, answers, silent_rows(answers))

        return act

    def queries(self, episodes: int, horizon: int) -> dict[str, int]:
        """One row for each step."""
        return {"act": episodes * horizon, "label": 0}


def _expert_acts(expert: Expert) -> Behaviour:
    def act(observations: np.ndarray, noise: Sequence[np.random.Generator]) -> Decision:
        answers = expert.ask(observations, "act")
        return Decision(answers, answers, silent_rows(answers))

    return act


def _blend(
    expert: np.ndarray, student: np.ndarray, share: float, noise: Sequence[np.random.Generator]
) -> np.ndarray:
    return (share * expert + (1 - share) * student).astype(np.float32)


def _switch(
    expert: np.ndarray, student: np.ndarray, share: float, noise: Sequence[np.random.Generator]
) -> np.ndarray:
    heads = np.array([random.random() < share for random in noise])
    return np.where(heads[:, None], expert, student)


def _between(updates: Sequence[int], episodes: int) -> list[int]:
    ends = [update for update in updates if update < episodes] + [episodes]
    return [end - start for start, end in zip([0, *ends], ends, strict=False)]


def _checked_updates(updates: object) -> tuple[int, ...]:
    example = "write updates=(1, 5, 20, 30)"
    try:
        if isinstance(updates, str | bytes | Mapping):
            raise TypeError
        numbers = tuple(check_count("updates", update) for update in updates)  # pyright: ignore
    except TypeError:
        expected = "increasing numbers of episodes"
        raise SettingError(spelt("updates", updates), expected, example) from None
    if not all(a < b for a, b in pairwise([0, *numbers])):
        raise SettingError(f"updates={numbers}", "increasing numbers of episodes", example)
    return numbers


TRAINERS: dict[str, Callable[[], Trainer]] = {
    "bc": BehaviourCloning,
    "dagger": DAgger,
    "dart": Dart,
    "noise": NoisyExpert,
}


def check_choices(trainer: Trainer) -> None:
    """Refuse a trainer that adds noise to actions, where they are choices.

    Raises:
        SettingError: If it is one.
    """
    if isinstance(trainer, Dart | NoisyExpert):
        raise SettingError(
            f"trainer={trainer.name!r}, which adds noise to actions, where actions are choices",
            "a trainer without noise: there is nothing between two choices",
            'write trainer="dagger", or leave it out',
        )


def describe_trainer(trainer: Trainer, rounds: int) -> str:
    """Return a trainer's name, and its settings where they are not the usual ones.

    Args:
        trainer: The trainer.
        rounds: Of the run: a share that is a function is known by what it says of them.
    """
    settings = _settings(trainer)
    if isinstance(trainer, DAgger) and callable(trainer.beta):
        settings["beta"] = str([trainer.share(round_) for round_ in range(1, rounds)])
    usual = _settings(TRAINERS[trainer.name]()) if trainer.name in TRAINERS else {}
    odd = [f"{name}={told}" for name, told in settings.items() if usual.get(name) != told]
    return ",".join([trainer.name, *odd])


def _settings(trainer: Trainer) -> dict[str, str]:
    """Return a trainer's attributes as texts, without addresses in memory."""
    slots = [field.name for field in fields(trainer)] if is_dataclass(trainer) else []
    values = {name: getattr(trainer, name) for name in slots} | getattr(trainer, "__dict__", {})
    texts = {name: getattr(one, "__name__", None) or repr(one) for name, one in values.items()}
    texts.pop("name", None)
    # Whole: what a run is gone on with is compared by it.
    return {name: _ADDRESS.sub("", " ".join(text.split())) for name, text in texts.items()}


def rounds_of(trainer: Trainer, episodes: int) -> list[int]:
    """Return the number of episodes of each round of a trainer.

    Raises:
        SettingError: If they do not make up all episodes.
    """
    given: Any = trainer.rounds(episodes)
    try:
        rounds = [operator.index(count) for count in given]
    except TypeError:
        rounds = []
    if not rounds or min(rounds) < 1 or sum(rounds) != episodes:
        raise SettingError(
            f"rounds({episodes}) of the trainer {shown(trainer.name)} is {shown(given)}",
            f"the episodes of each round, 1 at least, {episodes} in all",
            f"return for example [1, {episodes - 1}]" if episodes > 1 else "return [1]",
        )
    return rounds


def trainer_of(trainer: Any) -> Trainer:
    """Return the trainer of that name, or the trainer itself; a class of one is called.

    Raises:
        SettingError: If there is none of that name, or it is no trainer.
    """
    if isinstance(trainer, str):
        return TRAINERS[check_choice("trainer", trainer, TRAINERS)]()
    made = trainer() if any(trainer is known for known in TRAINERS.values()) else trainer
    methods = all(callable(getattr(made, m, None)) for m in ("rounds", "behaviour", "queries"))
    if isinstance(made, type) or not methods or not isinstance(getattr(made, "name", None), str):
        raise SettingError(
            spelt("trainer", trainer),
            f"one of {', '.join(TRAINERS)}, or an object with name, rounds, behaviour and queries",
            'write for example trainer="dagger", or trainer=fdtasil.DAgger(beta=0.5)',
        )
    return made
