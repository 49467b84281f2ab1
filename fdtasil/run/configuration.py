"""A run's resolved configuration: every choice made, in one frozen place."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from fdtasil.demonstrations.trainers import Trainer, describe_trainer, rounds_of
from fdtasil.errors import SettingError
from fdtasil.experts.expert import rows_text
from fdtasil.experts.gate import GATE_QUERIES, GATE_STATES, large_batch
from fdtasil.probes.calibration import Ladder, ladder_for
from fdtasil.probes.derivatives import comparison_rows
from fdtasil.probes.source import Probes
from fdtasil.probes.spread import Spread
from fdtasil.rollouts.spaces import Spaces
from fdtasil.rollouts.survivors import ATTEMPTS, SURVIVORS
from fdtasil.student.architectures import Architecture, describe
from fdtasil.student.fit import Fit

__all__ = ["Configuration"]


_TRIED = 200  # steps in which environments are tried before anything is recorded


@dataclass(frozen=True)
class Configuration:
    """What a run does, with nothing left open.

    Attributes:
        expert: What the expert is called, or None where there is none.
        expert_sha256: Of its file, or None.
        env: What the environment is called.
        trainer: Who acts in which round; None where the dataset is given.
        dataset: sha256 of a given dataset, or None.
        states: Number of given states, or None.
        probes: The derivative source, or None for plain behaviour cloning.
        calibrated: Whether the expert is asked at many radii, for what the source leaves open.
        usual_radius: Where such a calibration begins.
        probes_given: Whether the answers to the probes are given with the dataset.
        observation_size: n, of the expert.
        student_obs: The student's coordinates, or what its function is called, or None for all.
        student: The architecture of its network.
        fit: The optimisation.
        episodes: Number of demonstrations, recorded or given.
        horizon: T, steps after which an episode is cut; 0 without an environment.
        seed: The one seed.
        device: Where the student is trained.
        evaluation_episodes: Paired episodes of the evaluation; 0 where nothing is compared.
        max_queries: The most that the expert may be asked, or None.
        batch: Rows that the expert is asked at once, at most.
        keep: Which demonstrations are kept, "all" or "survivors".
        spread: How far coordinates will go that hardly move in the demonstrations.
        fingerprint: Of the environment; see `rollouts/trials.py`. None where there is none, or it
            does not repeat itself.
        reason: How often probes are asked and why, where no caller says which they are.
        past: Length of the past that the student sees.
        remembered: Length of the expert's memory; 0 where it has none.
        own_derivatives: Whether the expert gives the derivatives that are matched.
        spaces: Of the environment, where they are no plain boxes.
        made: How the environment is made and reset, in words, where its id does not say it.
        opened: With which options the expert was opened, in words; None for none.
        force: Whether it goes on where the expert fails the gate but answers.
    """

    expert: str | None
    expert_sha256: str | None
    env: str
    trainer: Trainer | None
    dataset: str | None
    states: int | None
    probes: Probes | None
    calibrated: bool
    usual_radius: float
    probes_given: bool
    observation_size: int
    student_obs: tuple[int, ...] | str | None
    student: Architecture
    fit: Fit
    episodes: int
    horizon: int
    seed: int
    device: str
    evaluation_episodes: int
    max_queries: int | None
    batch: int
    keep: str
    spread: Spread
    fingerprint: dict[str, Any] | None
    reason: str | None
    past: int = 0
    remembered: int = 0
    own_derivatives: bool = False
    spaces: Spaces | None = None
    made: str | None = None
    opened: str | None = None
    force: bool = False

    @property
    def held(self) -> tuple[int, ...]:
        """The coordinates that the student sees and probes do not move: choices, the past."""
        stop = self.observation_size - self.remembered
        still = self.spaces.observations.held if self.spaces else ()
        return (*still, *range(stop - self.past, stop))

    def predicted_queries(self) -> dict[str, int]:
        """Return the rows that the run will ask the expert for, by purpose.

        Exact where no episode ends early and every coordinate moves; an upper bound elsewhere,
        but for a source that resamples: fewer states are visited more often, each time with new
        queries, which only `max_queries` bounds.
        """
        purposes = ("check", "act", "label", "calibrate", "probe", "evaluate")
        found: dict[str, int] = dict.fromkeys(purposes, 0)
        if self.trainer is not None:
            found |= self.trainer.queries(self.episodes, self.horizon)
            if self.keep == SURVIVORS:
                found["act"] += ATTEMPTS * self.rounds[0] * self.horizon
        if self.probes is not None and not self.probes_given:
            found["probe"] = self._predicted_probes(self.probes)
            if self.own_derivatives:  # a row for each state, and what they are compared with
                states = self.states or self.episodes * self.horizon
                found["probe"] = states + comparison_rows(self.observation_size)
            found["calibrate"] = self.ladder.queries if self.calibrated else 0
        if self.expert is not None and self.horizon:
            gates = 2 if self.evaluation_episodes else 1
            found["check"] = gates * GATE_QUERIES + self._largest_batch(found)
            found["check"] += self._asked_again
            found["check"] += self._compared
            found["evaluate"] = 2 * self.evaluation_episodes * self.horizon
        elif self.expert is not None:  # on the states of a dataset
            found["check"] = GATE_QUERIES + self._compared
        if self.remembered:
            found["check"] += 2 * GATE_STATES  # where episodes begin, with a memory and without
            # Each step of the environment.
            found["remember"] = found["act"] + found["label"] + found["evaluate"] + _TRIED
        return found

    def most_queries(self) -> int:
        """Return the rows that are asked for at most, however short episodes are.

        Of fewer states a source that resamples asks more samples, each of them smaller; the last
        is used in part.
        """
        predicted = self.predicted_queries()
        if self.probes is None or not self.probes.resample:
            return sum(predicted.values())
        schedule, total, episodes = self.fit.schedule(anew=True), 0, 0
        once = self.probes.queries(1, self.observation_size, visits=1)
        count = self.probes.directions.count(self.observation_size)
        for new in self.rounds:
            episodes += new
            states = round(episodes * self._length)
            visited = schedule.total_steps(states) * schedule.batch_size + states
            used = visited * self.probes.used_per_visit(count) // count
            total += once * (used + 2 * states)
        return sum(predicted.values()) - predicted["probe"] + max(total, predicted["probe"])

    @property
    def _length(self) -> float:
        """Steps of an episode: the horizon, or the mean of those given."""
        return self.horizon if self.states is None else self.states / self.episodes

    @property
    def largest_batch(self) -> int:
        """Rows of the large batch that the gate asks, 0 for none."""
        return self._largest_batch(self.predicted_queries())

    def _largest_batch(self, queries: Mapping[str, int]) -> int:
        # Episodes are asked side by side, one row each; the rest all at once.
        together = [queries[purpose] for purpose in ("label", "calibrate", "probe")]
        rows = max(*together, self.episodes, self.evaluation_episodes)
        return large_batch(rows, self.batch)

    @property
    def asked_at_the_end(self) -> int:
        """Rows that the evaluation asks at most, and the look that follows it."""
        if self.expert is None or not self.horizon:
            return 0
        steps = self.evaluation_episodes * self.horizon
        return steps * (1 + (self.remembered > 0)) + self._asked_again

    @property
    def _compared(self) -> int:
        """Rows that an expert is compared with a dataset at: its states, and moved by a probe."""
        if self.dataset is None:
            return 0
        moved = self.probes_given and self.probes is not None and not self.probes.exact
        return GATE_STATES * (2 if moved else 1)

    @property
    def _asked_again(self) -> int:
        return GATE_STATES if self.evaluation_episodes or self.trainer is not None else 0

    @property
    def order(self) -> int:
        """0, 1 or 2, the order of the Taylor loss."""
        return self.fit.order if self.probes else 0

    @property
    def rounds(self) -> list[int]:
        """Number of episodes of each round; one round of all where they are given."""
        return rounds_of(self.trainer, self.episodes) if self.trainer else [self.episodes]

    @property
    def ladder(self) -> Ladder:
        """The radii that a calibration asks at."""
        return ladder_for(self._predicted_probes(self.probes) if self.probes else 0)

    @property
    def can_spread(self) -> bool:
        """Whether probes are asked in units of deviations, which may be said to be others."""
        probes = self.probes
        return probes is not None and not self.probes_given and probes.space == "whitened"

    @property
    def moved(self) -> set[int]:
        """The coordinates that probes may move; of a function of the observation, any."""
        columns = self.student_obs
        seen = columns if isinstance(columns, tuple) else range(self.observation_size)
        return set(seen) - set(self.held)

    def check_spread(self, stored: Spread | None) -> None:
        """Refuse deviations that no probe is moved by; plain cloning normalises by them.

        Args:
            stored: Those that stored answers were asked with.

        Raises:
            SettingError: If there are some.
        """
        if self.spread == stored:
            return
        lost = sorted({*self.spread.deviations} - self.moved)
        if lost and not self.spread.where_still:
            raise SettingError(
                f"spread= of coordinate {lost[0]}, which no probe moves",
                "coordinates that the student sees, no choices and nothing of the past",
                "leave it out of spread=, or let student_obs= show it",
            )
        if self.spread.deviations and self.probes is not None and not self.can_spread:
            how = "answers that are stored" if self.probes_given else "raw probes"
            raise SettingError(
                f"spread= with {how}",
                "probes in units of deviations, which are asked in this run",
                "leave spread= out, or the dataset's answers (probes=0), or raw",
            )

    def check_budget(self) -> None:
        """Refuse a run that may ask more than it is allowed to.

        Raises:
            SettingError: Before anything is asked, with the parts of the prediction.
        """
        predicted = self.predicted_queries()
        total = sum(predicted.values())
        if self.max_queries is None or total <= self.max_queries:
            return
        lower = "lower episodes, horizon or evaluation_episodes" if self.horizon else "probes=0"
        if self._largest_batch(predicted):
            lower = f"{lower}, write load_expert(..., batch=16), whose gate asks fewer rows"
        raise SettingError(
            f"this run may ask the expert {total:,} times ({rows_text(predicted)})",
            f"at most max_queries={self.max_queries:,}",
            f"{self._fewer()}{lower}, or raise max_queries",
        )

    def _fewer(self) -> str:
        """Return the largest number of probes that the budget allows, as advice."""
        source = self.probes
        if source is None or not (asked := getattr(source.directions, "probes", None)):
            return ""
        for count in range(asked - 1, 0, -1):
            directions: Any = replace(source.directions, probes=count)  # pyright: ignore
            fewer = replace(self, probes=replace(source, directions=directions))
            if sum(fewer.predicted_queries().values()) <= (self.max_queries or 0):
                return f"{count} probes fit; or "
        return ""

    def to_json(self) -> dict[str, Any]:
        """Return the configuration as plain JSON values, every field of it."""
        trainer = self.trainer
        described = describe_trainer(trainer, len(self.rounds)) if trainer else "none"
        written = {
            "trainer": described,
            "probes": self.probes.describe() if self.probes else "none",
            "student": describe(self.student),
            "spread": self.spread.to_json(),
            "spaces": self.spaces.to_json() if self.spaces else None,
            "fit": self.fit.to_json(anew=self.probes is not None and self.probes.resample),
        }
        whole = {name: written.get(name, value) for name, value in vars(self).items()}
        return json.loads(
            json.dumps(whole, allow_nan=False)
        )  # raises where JSON has no such value

    def _predicted_probes(self, probes: Probes) -> int:
        """Return the probe rows of all rounds.

        New states are asked about once; a source that resamples asks about all states that it
        trains on again, for every sample but the first of every round.
        """
        length = self._length
        collected, episodes, total = 0, 0, 0
        for count in self.rounds:
            new = round(count * length)
            collected, episodes = collected + new, episodes + count
            held = round(self.fit.held_out(episodes) * length)
            once = probes.queries(1, self.observation_size, visits=1)
            visits = self.fit.schedule(anew=probes.resample).visits(collected - held)
            samples = probes.samples(self.observation_size, visits)
            total += once * new + once * (collected - held) * (samples - 1)
        return total
