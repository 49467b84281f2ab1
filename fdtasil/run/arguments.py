"""From the arguments of `distill` to one configuration: looked at first, resolved when opened."""

from dataclasses import dataclass, replace

from fdtasil.checks import check_choice, check_count, spelt
from fdtasil.demonstrations.dataset import Dataset
from fdtasil.demonstrations.trainers import (
    BehaviourCloning,
    DAgger,
    Dart,
    Trainer,
    check_choices,
    trainer_of,
)
from fdtasil.errors import SettingError, warn
from fdtasil.experts.cost import CHEAP, multiply_adds
from fdtasil.experts.expert import Expert
from fdtasil.files.storage import sha256
from fdtasil.probes.directions import USUAL_COUNT
from fdtasil.probes.source import FRESH, Probes
from fdtasil.probes.spread import Spread, SpreadLike
from fdtasil.probes.stencils import FORWARD
from fdtasil.rollouts.environments import resolve_horizon
from fdtasil.rollouts.survivors import KEEPS
from fdtasil.rollouts.trials import fingerprint
from fdtasil.run.configuration import Configuration
from fdtasil.run.presets import Preset, preset_of
from fdtasil.run.subject import Subject
from fdtasil.seeding import episode_seeds
from fdtasil.student.architectures import Architecture, check_architecture, usual_architecture
from fdtasil.student.fit import Fit
from fdtasil.student.view import StudentObservation, describe_view

__all__ = ["Arguments", "read_arguments"]

_USUAL_EPISODES = 20


@dataclass(frozen=True)
class Arguments:
    """What a caller asks for, looked at before anything is opened.

    Attributes:
        given: The dataset, or None.
        preset: Where the defaults come from.
        probes: The derivative source, but for what a calibration finds; None for cloning.
        anew: The source that is taken instead where there is an expert to ask; None for none.
        anew_if_cheap: Whether it has to be cheap to ask: nobody says which source is meant.
        trainer: Who acts in which round; None where the dataset is given.
        episodes: Number of demonstrations.
        horizon: T, or None for the environment's own.
        seed: The one seed.
        student: The architecture of its network, or None for the usual one.
        student_obs: What it sees.
        keep: Which demonstrations are kept.
        spread: How far coordinates will go that hardly move in the demonstrations.
        fit: The optimisation.
        evaluation_episodes: Paired episodes, where there is something to compare.
        max_queries: The most that the expert may be asked, or None.
        device: Where the student is trained.
    """

    given: Dataset | None
    preset: Preset
    probes: Probes | None
    anew: Probes | None
    anew_if_cheap: bool
    trainer: Trainer | None
    episodes: int
    horizon: int | None
    seed: int
    student: Architecture | None
    student_obs: StudentObservation | None
    keep: str
    spread: SpreadLike | None
    fit: Fit
    evaluation_episodes: int
    max_queries: int | None
    device: str

    def configure(self, subject: Subject, anew: bool | None = None) -> Configuration:
        """Return the configuration of a run with an expert and an environment.

        Args:
            subject: The two.
            anew: Whether a run that goes on asks anew; None for one that begins.

        Raises:
            SettingError: If the environment allows no such horizon.
            EnvironmentFault: If it fails in its first steps.
        """
        if subject.spaces and subject.spaces.actions.choices and self.trainer is not None:
            check_choices(self.trainer)
        trainer = self.trainer
        if isinstance(trainer, DAgger | Dart) and len(trainer.rounds(self.episodes)) == 1:
            warn(
                f"{self.episodes} episode(s) leave trainer={trainer.name!r} one round, "
                "in which the expert acts as in cloning: raise episodes="
            )
        usual = self._usual(subject)
        if usual.probes is not None and not usual.probes_given and not usual.moved:
            return self._unprobed(usual.probes, subject)
        if self.anew is None or subject.expert is None:
            return usual
        student = self.student or usual_architecture(anew=True)
        fresh = replace(
            usual,
            probes=self.anew,
            # What a stored source left open was found when it was asked for the first time.
            calibrated=self.preset.calibrates(self.anew) and self.anew.is_open,
            probes_given=False,
            student=student,
        )
        if not self.anew_if_cheap:
            return fresh
        work = multiply_adds(subject.expert, usual.observation_size)
        if work is None:
            return replace(usual, reason="asked once: what a query costs is not known")
        if work > CHEAP:
            return replace(usual, reason=f"asked once: {work:,} multiply-adds a query")
        due = fresh.most_queries()
        allowed = self.max_queries is None or due <= self.max_queries
        if not (allowed if anew is None else anew):
            return replace(usual, reason=f"asked once: {due:,} queries are more than max_queries")
        return replace(fresh, reason=f"asked anew all the time: {work:,} multiply-adds a query")

    def _unprobed(self, source: Probes, subject: Subject) -> Configuration:
        """Return plain cloning, where nothing that the student sees can be moved a little.

        Raises:
            SettingError: If probes are asked for.
        """
        whole = "choices, flags or whole numbers, and nothing lies between two of them"
        if not self.anew_if_cheap:
            raise SettingError(
                f"probes={source.describe()!r}, and all that the student sees are {whole}",
                "a coordinate that can be moved a little",
                "leave probes= out, or pass probes=0: plain behaviour cloning",
            )
        warn(f"all that the student sees are {whole}: plain behaviour cloning (probes=0)")
        return replace(self, probes=None, anew=None)._usual(subject)

    def _usual(self, subject: Subject) -> Configuration:
        given, source, expert = self.given, self.probes, subject.expert
        stored = given is not None and given.answers is not None
        calibrates = source is not None and self.preset.calibrates(source)
        exact = source is not None and source.exact
        horizon = resolve_horizon(self.horizon, subject.pool) if subject.pool else 0
        (start,) = episode_seeds(self.seed, "evaluation", 0, 1)
        return Configuration(
            expert=(expert.origin.source or expert.name) if expert else None,
            expert_sha256=expert.origin.sha256 if expert else None,
            env=subject.environment,
            trainer=self.trainer,
            dataset=sha256(given.to_bytes()) if given else None,
            states=len(given.demonstrations) if given else None,
            probes=source,
            calibrated=calibrates and not stored and expert is not None,
            usual_radius=self.preset.radius,
            probes_given=stored,
            observation_size=subject.observation_size,
            past=subject.past,
            remembered=subject.remembered,
            own_derivatives=exact and _gives_derivatives(expert, self.fit.order),
            student_obs=describe_view(self.student_obs, subject.observation_size),
            student=self.student or usual_architecture(anew=bool(source and source.resample)),
            fit=self.fit,
            episodes=self.episodes,
            horizon=horizon,
            seed=self.seed,
            device=self.device,
            evaluation_episodes=self.evaluation_episodes if subject.comparable else 0,
            max_queries=self.max_queries,
            batch=expert.chunk if expert else 0,
            keep=self.keep,
            spread=self._spread(subject),
            fingerprint=fingerprint(subject.pool, start) if subject.pool else None,
            reason=None,
            spaces=subject.spaces,
            made=subject.pool.made if subject.pool else None,
            opened=expert.origin.options if expert else None,
        )

    def _spread(self, subject: Subject) -> Spread:
        if self.spread is None and self.given is not None:
            return self.given.spread
        boxes = subject.pool.boxes if subject.pool else None
        low, high = (boxes.observation_low, boxes.observation_high) if boxes else (None, None)
        layout = subject.spaces.observations if subject.spaces else None
        return Spread.of(self.spread, low, high, subject.observation_size, layout)


def read_arguments(
    given: Dataset | None,
    probes: int | str | Probes | None,
    *,
    can_ask: bool,
    trainer: str | Trainer,
    episodes: int | None,
    horizon: int | None,
    seed: int,
    student: Architecture | str | None,
    student_obs: StudentObservation | None,
    keep: str,
    spread: SpreadLike | None,
    fit: Fit | None,
    preset: str,
    evaluation_episodes: int,
    max_queries: int | None,
    device: str,
) -> Arguments:
    """Look at the arguments of `distill`, which say what each is; `can_ask`: it has an expert.

    Raises:
        SettingError: If one can't be used, or two don't go together.
    """
    defaults = preset_of(preset)
    fit, curved = defaults.fit if fit is None else _checked_fit(fit), callable(student_obs)
    if can_ask:
        given = _without_other_answers(given, probes, defaults, fit.order)
    elif probes is None and given is not None and given.answers is None:
        raise SettingError(
            "a dataset without answers to probes, and no expert",
            "an expert to ask, or probes=0 for plain behaviour cloning",
            "pass one of the two",
        )
    return Arguments(
        given=given,
        preset=defaults,
        probes=_source_of(probes, defaults, fit.order, given, curved=curved),
        anew=_source_anew(probes, defaults, fit.order, given, curved=curved),
        anew_if_cheap=probes is None,
        trainer=_trainer_of(trainer, given),
        episodes=_episodes_of(episodes, given),
        horizon=None if horizon is None else check_count("horizon", horizon),
        seed=check_count("seed", seed, 0, 2**32 - 1),
        student=None if student is None else check_architecture(student),
        student_obs=student_obs,
        keep=_checked_keep(keep, given),
        spread=spread,
        fit=fit,
        evaluation_episodes=check_count("evaluation_episodes", evaluation_episodes, least=0),
        max_queries=None if max_queries is None else check_count("max_queries", max_queries, 0),
        device=_checked_device(device),
    )


def _gives_derivatives(expert: Expert | None, order: int) -> bool:
    """Whether an expert without a module gives its derivatives.

    Raises:
        SettingError: If second ones are asked for, which it does not give.
    """
    if expert is None or expert.module is not None or expert.jacobian is None:
        return False
    if order > 1:
        raise SettingError(
            f"order={order} with the derivatives that {expert.name} gives itself",
            "a torch module, or probes that ask for differences",
            'write order=1, or probes="10,central"',
        )
    return True


def _checked_keep(keep: str, given: Dataset | None) -> str:
    check_choice("keep", keep, KEEPS)
    if keep != KEEPS[0] and given is not None:
        raise SettingError(
            f"keep={keep!r} with a given dataset", "nothing to record", "leave keep= out"
        )
    return keep


def _checked_device(device: object) -> str:
    if isinstance(device, str):
        return device
    raise SettingError(spelt("device", device), '"cpu", "cuda" or "cuda:N"', 'write device="cpu"')


def _checked_fit(fit: object) -> Fit:
    if isinstance(fit, Fit):
        return fit
    example = "write for example fit=fdtasil.Fit(steps=4000)"
    raise SettingError(spelt("fit", fit), "fdtasil.Fit(...)", example)


def _source_of(
    spec: int | str | Probes | None,
    preset: Preset,
    order: int,
    given: Dataset | None,
    *,
    curved: bool,
) -> Probes | None:
    """Return the derivative source of a run: what is asked for, or what is stored.

    Args:
        spec: The argument `probes`; None takes what is stored, else the usual number.
        preset: Fills in what it leaves open.
        order: Of the Taylor loss.
        given: A dataset; its stored answers are used as they are.
        curved: Whether the student may see a curved function of the observation, which allows
            the forward stencil only.

    Raises:
        SettingError: If order, source and stored answers do not go together.
    """
    stored = given.probes if given is not None and given.answers is not None else None
    if spec is None and stored is not None:
        return _from_store(stored, order, given)
    asked = preset.complete(Probes.parse(USUAL_COUNT if spec is None else spec))
    if asked is None:
        return None
    if stored is None:
        left_open = preset.calibrates(asked) and not curved
        return asked.with_order(order, None if left_open else FORWARD)
    asked = _filled_in(asked, stored, order)
    if asked != stored:
        raise SettingError(
            f"probes={asked.describe()!r} with stored answers to {stored.describe()!r}",
            "the source that is stored, probes=0, or an expert to ask",
            "leave probes= out, or pass the expert: then it is asked anew",
        )
    return _from_store(stored, order, given)


def _filled_in(asked: Probes, stored: Probes, order: int) -> Probes:
    """Return a source with what it leaves open: a calibration found it, and it is stored."""
    return replace(
        asked,
        radius=stored.radius if asked.radius in (None, "wide") else asked.radius,
        stencil=asked.stencil or stored.stencil,
        match=asked.match or stored.match,
    ).with_order(order)


def _without_other_answers(
    given: Dataset | None, spec: int | str | Probes | None, preset: Preset, order: int
) -> Dataset | None:
    """Return a dataset without its answers where another source is asked for; warn of it."""
    stored = given.probes if given is not None and given.answers is not None else None
    asked = None if spec is None else preset.complete(Probes.parse(spec))
    if given is None or stored is None or asked is None:
        return given
    if _filled_in(asked, stored, order) == stored:
        return given
    warn(
        f"the stored answers to {stored.describe()!r} are not used: the expert is asked anew, "
        f"{asked.describe()!r}"
    )
    # No raw probe goes as far as somebody said.
    spread = given.spread if asked.space != "raw" else Spread({})
    return replace(given, probes=None, answers=None, spread=spread)


def _source_anew(
    spec: int | str | Probes | None,
    preset: Preset,
    order: int,
    given: Dataset | None,
    *,
    curved: bool,
) -> Probes | None:
    """Return the source that is asked anew where there is somebody to ask.

    Stored answers that were asked once are what their owner wants to be used. Where nobody asks
    for a source and none is stored, "fresh" teaches best.
    """
    stored = given.probes if given is not None and given.answers is not None else None
    asked = Probes.parse(spec)
    if stored is not None:  # what is asked for is what is stored, or nothing
        wanted = stored.resample and (spec is None or asked is not None)
        return stored.with_order(order) if wanted else None
    if spec is not None:
        return None
    return _source_of(FRESH, preset, order, None, curved=curved) if preset.calibrated else None


def _from_store(stored: Probes, order: int, given: Dataset | None) -> Probes:
    """Return the source of stored answers: nobody is asked anew."""
    values = given.answers.values if given is not None and given.answers is not None else None
    if order == 2 and stored.exact and values is not None and values.shape[2] < 2:
        raise SettingError(
            "order=2 with stored derivatives of first order",
            "a dataset made with order=2",
            "record one with order=2, or pass fit=Fit(order=1)",
        )
    return replace(stored.with_order(order), resample=False)


def _trainer_of(trainer: str | Trainer, given: Dataset | None) -> Trainer | None:
    """Return who acts in which round; nobody does where the dataset is given."""
    chosen = trainer_of(trainer)
    if given is None:
        return chosen
    if not isinstance(chosen, BehaviourCloning):
        raise SettingError(
            f"trainer={chosen.name!r} with a given dataset",
            "nobody who acts: nothing is recorded",
            "leave trainer= out, or leave dataset= out",
        )
    return None


def _episodes_of(episodes: int | None, given: Dataset | None) -> int:
    """Return the number of demonstrations; a dataset says it itself."""
    if given is None:
        return check_count("episodes", _USUAL_EPISODES if episodes is None else episodes)
    found = given.demonstrations.episodes
    if episodes not in (None, found):
        raise SettingError(
            f"episodes={episodes!r} with a dataset of {found} episodes",
            "all that are given",
            "leave episodes= out",
        )
    return found
