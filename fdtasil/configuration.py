"""A run's resolved configuration: every choice made, in one frozen place."""

from dataclasses import asdict, dataclass
from typing import Any

from fdtasil.errors import SettingError
from fdtasil.fit import Fit
from fdtasil.probes import Probes
from fdtasil.student import StudentShape
from fdtasil.trainers import Trainer, describe_trainer

__all__ = ["GATE_STATES", "Configuration", "check_count"]

GATE_STATES = 16  # states that the gate asks about, before and after the expert's first rollouts
_ROWS_A_STATE = 3  # asked, asked again, asked alone


@dataclass(frozen=True)
class Configuration:
    """What a run does, with nothing left open.

    Attributes:
        expert: What the expert is called.
        expert_sha256: Of its file, or None.
        env: What the environment is called.
        trainer: Who acts in which round.
        probes: The derivative source, or None for plain behaviour cloning.
        student: The network.
        fit: The optimisation.
        episodes: Number of demonstrations.
        horizon: T, steps after which an episode is cut.
        seed: The one seed.
        device: Where the student is trained.
        evaluation_episodes: Paired episodes of the evaluation.
        max_queries: The most that the expert may be asked, or None.
    """

    expert: str
    expert_sha256: str | None
    env: str
    trainer: Trainer
    probes: Probes | None
    student: StudentShape
    fit: Fit
    episodes: int
    horizon: int
    seed: int
    device: str
    evaluation_episodes: int
    max_queries: int | None

    def __post_init__(self) -> None:
        check_count("episodes", self.episodes)
        check_count("evaluation_episodes", self.evaluation_episodes)

    def predicted_queries(self) -> dict[str, int]:
        """Return the rows that the run will ask the expert for, by purpose.

        Exact where no episode ends early and every coordinate moves; an upper bound elsewhere.
        """
        states = self.episodes * self.horizon
        probe = 0
        if self.probes is not None:
            visits = self.fit.visits(states)
            probe = self.probes.queries(states, self.student.observation_size, visits)
        return {
            "check": 2 * GATE_STATES * _ROWS_A_STATE,
            **self.trainer.queries(self.episodes, self.horizon),
            "probe": probe,
            "evaluate": 2 * self.evaluation_episodes * self.horizon,
        }

    def check_budget(self) -> None:
        """Refuse a run that may ask more than it is allowed to.

        Raises:
            SettingError: Before anything is asked, with the parts of the prediction.
        """
        predicted = self.predicted_queries()
        total = sum(predicted.values())
        if self.max_queries is None or total <= self.max_queries:
            return
        parts = ", ".join(f"{name} {rows:,}" for name, rows in predicted.items() if rows)
        raise SettingError(
            f"this run may ask the expert {total:,} times ({parts})",
            f"at most max_queries={self.max_queries:,}",
            "lower probes, episodes, horizon or evaluation_episodes, or raise max_queries",
        )

    def to_json(self) -> dict[str, Any]:
        """Return the configuration as plain JSON values."""
        plain = {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, (str, int, float, type(None)))
        }
        return plain | {
            "trainer": describe_trainer(self.trainer),
            "probes": self.probes.describe() if self.probes else "none",
            "student": {**asdict(self.student), "hidden": list(self.student.hidden)},
            "fit": asdict(self.fit),
        }


def check_count(name: str, value: int) -> int:
    """Return `value`.

    Raises:
        SettingError: If it is not a positive integer.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise SettingError(f"{name}={value!r}", "a positive integer", f"write {name}=5")
    return value
