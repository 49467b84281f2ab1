"""distill(): the whole story, from an expert and an environment to a student."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from fdtasil.checks import check_flag, check_path
from fdtasil.compute import pick_device, torch_settings
from fdtasil.demonstrations.dataset import (
    Dataset,
    DatasetLike,
    load_dataset,
    warn_of_cut_actions,
)
from fdtasil.demonstrations.past import showing
from fdtasil.demonstrations.trainers import Trainer
from fdtasil.errors import SettingError, heard_warnings
from fdtasil.experts.examination import check_first, examine
from fdtasil.experts.expert import Expert
from fdtasil.experts.gate import GATE_STATES, compare_again
from fdtasil.experts.load import ExpertLike
from fdtasil.experts.silence import Silence
from fdtasil.probes.source import Probes
from fdtasil.probes.spread import SpreadLike
from fdtasil.progress import Progress
from fdtasil.results.constraints import Constraints, check_constraints
from fdtasil.results.distilled import Distilled, write_run
from fdtasil.results.evaluation import Evaluation
from fdtasil.results.pair import evaluate_pair
from fdtasil.results.size import size_of_expert, size_of_student
from fdtasil.rollouts.behaviours import follow
from fdtasil.rollouts.environments import EnvironmentLike
from fdtasil.rollouts.episodes import Episodes
from fdtasil.run.account import Account
from fdtasil.run.arguments import read_arguments
from fdtasil.run.asking import Asking
from fdtasil.run.checkpoints import Checkpoints, Trained
from fdtasil.run.collecting import Collecting
from fdtasil.run.configuration import Configuration
from fdtasil.run.dataset_gate import examine_given
from fdtasil.run.doubts import warn_of_idle_weights, warn_of_misfit, warn_of_silence
from fdtasil.run.events import Callback, Event, tell_all
from fdtasil.run.folder import asked_anew, open_run_folder
from fdtasil.run.interrupts import heard_interrupts
from fdtasil.run.judging import check_history
from fdtasil.run.lesson import Lesson
from fdtasil.run.report import config_of, no_answer, report_of
from fdtasil.run.rounds import Rounds
from fdtasil.run.subject import Subject, bounded, named, open_subject
from fdtasil.run.training import Training
from fdtasil.run.trying import try_functions
from fdtasil.seeding import episode_seeds
from fdtasil.student.architectures import Architecture
from fdtasil.student.fit import Fit
from fdtasil.student.view import StudentObservation, visible

__all__ = ["distill"]


def distill(
    expert: ExpertLike | None = None,
    env: EnvironmentLike | None = None,
    probes: int | str | Probes | None = None,
    *,
    trainer: str | Trainer = "bc",
    episodes: int | None = None,
    horizon: int | None = None,
    seed: int = 0,
    student: Architecture | str | None = None,
    student_obs: StudentObservation | None = None,
    history: int | None = None,
    keep: str = "all",
    spread: SpreadLike | None = None,
    fit: Fit | None = None,
    preset: str = "standard",
    dataset: DatasetLike | None = None,
    evaluation_episodes: int = 20,
    constraints: Constraints | None = None,
    max_queries: int | None = None,
    device: str = "cpu",
    force: bool = False,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    callback: Callback | Sequence[Callback] | None = None,
    progress: bool = True,
) -> Distilled:
    """Distil an expert that can only be asked into a small torch policy that reacts as it does.

    The student matches the expert's actions at the states of the demonstrations, and its
    differences along probes around them (TaSIL, arXiv 2205.14812, appendix on finite differences);
    with "fresh", the default of cheap experts, its actions at the moved states. The expert is
    never differentiated, unless `probes="jacobian"`.

    Args:
        expert: An ONNX path, the path of a stable-baselines3 zip, either of them on the Hugging
            Face hub (`hf://org/repo/file[@revision]`), a torch module, an object with
            stable-baselines3's `predict`, a function on batches (B, n) -> (B, m) in environment
            units, an address, or what `load_expert` made of one of them with options of its own.
            None with `dataset`: then nobody is asked, and `probes` are those that it holds; of one
            without answers, write 0.
        env: A gymnasium id (`module:Id` too), a gymnasium environment, a vector environment
            (gymnasium's or stable-baselines3's), a function making one, or a
            `fdtasil.Environment`, which says what it is made and reset with. None with `dataset`:
            then nothing is recorded or evaluated.
        probes: The derivative source. Left out, what `dataset` holds, or "fresh" for files,
            torch modules and agents' zips of few multiply-adds, 10 for others, and 0 where nothing
            that the student sees can be moved a little. 0 (plain behaviour
            cloning), "fresh" (asked anew at every visit, near and far; the answers are labels),
            N (N random directions at each state; half of them lead towards other visited states
            where few of all observations can occur), "sphere:N" (N isotropic directions at each
            state, asked once), "sphere:N,resample" (new ones when each was used), "orthogonal:N",
            "basis", "jacobian" (the analytic reference). Options after commas: forward, central,
            differences, labels (of the moved states), both, radius=R, radius=LOW..HIGH (one for
            each direction), raw, whitened, per_step=K. What is left open of radius and stencil is
            found by asking at a ladder of radii first.
        trainer: Who acts in which round: "bc" (the expert), "dagger" (a mixture of expert and
            student), "dart" (the expert with noise as large as the student's errors), "noise" (the
            expert with noise in the first episode and every second one after it), or a trainer
            with settings of its own.
        episodes: Number of demonstrations. Left out, 20, or those of `dataset`.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Equal seeds give equal bytes, on one machine with the same versions.
        student: The architecture of its network, `fdtasil.Mlp(hidden, activation)`, or "micro",
            64 x 64 with ReLU, for boards. Left out, two hidden layers of 512, or of 256 where the
            expert is asked anew.
        student_obs: Indices of the coordinates that the student sees, names of parts of a
            dictionary, or a function (B, n) -> (B, k); the expert sees all. Probes move only what
            the student sees.
        history: How many observations the student sees, with the actions between them; more than
            one for an expert with a memory, or an environment that hides speeds. Of a dataset,
            those before stand in the rows before. Probes move the present one. `fdtasil.History`
            keeps them where the student runs. Left out, 1, or as many as `dataset` shows.
        keep: Which of the expert's own episodes are learnt from: "all", or "survivors", which
            records others (three at most) in the place of each that the environment ended.
        spread: How far coordinates will go on the machine that stand still in the demonstrations,
            such as a command, a goal or a mass: {coordinate: deviation}, as a text "3:0.5,7:0.1"
            too, or "bounds" for those that have finite ones. They are probed that far, alone and
            together with the others.
        fit: Length, optimiser, order and weights of the loss, validation: `fdtasil.Fit(...)`.
            Left out, the preset's.
        preset: Where defaults of probes and fit come from: "standard", or "paper" (TaSIL's
            settings: raw probes of radius 0.01, weight 0.01, 4,500 epochs).
        dataset: Train from this instead of recording: a run folder, its demonstrations.npz, or a
            `Dataset`. Stored answers to probes are used as they are. Those of "fresh" and of
            others that resample are asked anew where there is an expert that is cheap, or
            where `probes` names them. Where `probes` names others, an expert is asked those.
        evaluation_episodes: Episodes of the paired evaluation; 0 leaves it out.
        constraints: Name -> function of (N, n) flat observations and the (N, m) actions taken,
            positive where the constraint is violated; the evaluation counts these steps.
        max_queries: Refuse to start a run that may ask the expert more often; where `probes` are
            left out, "fresh" is taken only if it allows that.
        device: Where the student is trained: "cpu", "cuda", "cuda:N".
        force: Go on with a warning where the expert fails the gate but answers.
        out: Folder of the run: checkpoints while it goes on, then all its files. It is missing,
            empty, or a run's; a finished run in it is replaced.
        resume: Folder of a run that was interrupted; it goes on from its last checkpoint and ends
            with the bytes of a run that never was. `max_queries` may be another, and the expert's
            file may lie elsewhere; so may versions and `device`, with a warning that bytes may
            differ.
        callback: Told of each 100 training steps, each round and the evaluation; see `Event`. One
            or several, such as `fdtasil.Log("runs/walker/log", "csv")`.
        progress: Show progress bars, in a terminal or a notebook.

    Returns:
        The student with its evaluation, history, queries and settings.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If the expert can't be opened or fails the gate, before anything is trained.
        EnvironmentFault: If the environment can't be used, or misbehaves.
        FitError: If training diverges, or the GPU has no memory left.
        StorageError: If the run's folder can't be written, or holds something else.

    Example:
        >>> import fdtasil
        >>> import numpy as np
        >>> result = distill(
        ...     lambda x: np.clip(-8 * np.arctan2(x[:, 1:2], x[:, :1]) - 2 * x[:, 2:], -2, 2),
        ...     "Pendulum-v1", probes=4, episodes=2, horizon=50, evaluation_episodes=2,
        ...     student=fdtasil.Mlp(16), fit=Fit(steps=50),
        ... )
        >>> result.student.predict(result.demonstrations.observations[0])[0].shape
        (1,)
    """
    folder, force = _folder_of(out, resume), check_flag("force", force)
    limits = None if constraints is None else check_constraints(constraints)
    progress = check_flag("progress", progress)
    given = None if dataset is None else load_dataset(dataset)
    shown = 1 if given is None else given.history
    history = check_history(shown if history is None else history, student_obs)
    if env is None:
        _check_nothing_to_step(horizon=horizon, constraints=constraints)
    if limits:
        _check_evaluated(expert, evaluation_episodes)
    with heard_warnings() as early:
        arguments = read_arguments(
            given,
            probes,
            can_ask=expert is not None,
            trainer=trainer,
            episodes=episodes,
            horizon=horizon,
            seed=seed,
            student=student,
            student_obs=student_obs,
            keep=keep,
            spread=spread,
            fit=fit,
            preset=preset,
            evaluation_episodes=evaluation_episodes,
            max_queries=max_queries,
            device=device,
        )
    given, told = arguments.given, tell_all(callback)
    chosen = pick_device(arguments.device)
    with heard_warnings() as notes, open_subject(expert, env, given, history) as subject:
        notes += early
        going_on = asked_anew(folder) if folder is not None and resume is not None else None
        layout = subject.spaces.observations if subject.spaces else None
        student_obs = named(student_obs, layout)
        student_obs = visible(student_obs, subject.observation_size, subject.remembered)
        if given is not None:
            if subject.pool is None:
                warn_of_cut_actions(given)
            else:
                given = bounded(given, subject.pool)
            given = showing(given, history, subject.actions)
        arguments = replace(arguments, given=given, student_obs=student_obs)
        run = replace(arguments.configure(subject, going_on), force=force)
        bars = Progress(progress)
        run.check_spread(given.spread if given is not None and run.probes_given else None)
        run.check_budget()
        usual = arguments.preset.fit
        warn_of_idle_weights(run.fit, usual, run.probes, calibrated=run.calibrated)
        with (
            open_run_folder(folder, config_of(run), resume=resume is not None) as kept,
            heard_interrupts() as interrupts,
        ):
            if folder and kept.finished and resume is not None:
                return Distilled.load(folder, student_obs)
            expert = subject.expert
            asked, silence = (expert.queries, expert.silence) if expert else ({}, Silence())
            account = Account(asked, silence, notes)
            checkpoints = Checkpoints(kept, account, Asking(run, subject.expert, account))
            training = Training(run, chosen, checkpoints, bars, interrupts, told)
            rounds = Rounds(run, student_obs, _collecting(run, subject, bars), training)
            result = _complete(rounds, subject, given, chosen, limits, force=force)
            if folder:
                write_run(result, folder)
                kept.close()
    return result


def _check_nothing_to_step(**asked: object) -> None:
    """Refuse what only an environment has a use for.

    Raises:
        SettingError: If something is asked for.
    """
    for name, value in asked.items():
        if value is not None:
            raise SettingError(
                f"{name}= without an environment",
                "nothing that is recorded or evaluated",
                f"pass env=, or leave {name}= out",
            )


def _check_evaluated(expert: ExpertLike | None, episodes: int) -> None:
    """Refuse constraints where nothing is evaluated.

    Raises:
        SettingError: If it is not.
    """
    if expert is None or episodes == 0:
        raise SettingError(
            f"constraints= {'without an expert' if expert is None else 'and no evaluation'}",
            "an evaluation, which counts where they are violated",
            f"{'pass expert=' if expert is None else 'raise evaluation_episodes='}, or leave "
            "constraints= out",
        )


def _folder_of(out: str | Path | None, resume: str | Path | None) -> Path | None:
    """Return the folder of a run, or None where it has none."""
    if out is not None and resume is not None:
        found = f"out={str(out)!r} beside resume={str(resume)!r}"
        raise SettingError(found, "one folder", "leave out= out: a resumed run stays in its own")
    name, path = ("out", out) if resume is None else ("resume", resume)
    # Absolute from the beginning: an environment may change the working folder.
    return None if path is None else check_path(name, path).absolute()


def _collecting(run: Configuration, subject: Subject, bars: Progress) -> Collecting | None:
    """Return what records the demonstrations; None where they are given."""
    expert, pool = subject.expert, subject.pool
    if run.trainer is None or expert is None or pool is None:
        return None
    return Collecting(
        run.trainer,
        expert,
        pool,
        run.horizon,
        run.seed,
        bars,
        run.keep,
        subject.history,
        subject.remembered,
    )


def _complete(
    rounds: Rounds,
    subject: Subject,
    given: Dataset | None,
    device: torch.device,
    constraints: Constraints | None,
    *,
    force: bool,
) -> Distilled:
    """Gate, rounds, evaluation, report."""
    run, checkpoints = rounds.run, rounds.training.checkpoints
    with torch_settings(device) as precision:
        if subject.pool is not None:
            try_functions(subject.pool, rounds.student_obs, constraints, run.seed)
        theirs = _examined(rounds, subject, given, force=force)
        checkpoints.account.start_clock()
        lesson, trained = rounds.complete(given, theirs)
        seconds, student = checkpoints.account.seconds, trained.student
        evaluation = _evaluated(rounds, subject, theirs, lesson, trained, constraints)
        if run.fit.steps is None and run.fit.epochs is None:  # else the caller chose the length
            # The last round's: the length that a caller says is that of one round.
            act, steps = lesson.view.policy(student.act), int(trained.history[-1]["step"])
            warn_of_misfit(lesson, act, steps, remembers=subject.remembered > 0)
        _ask_again(run, subject.expert, theirs, lesson)
        if subject.expert is not None:
            shares, ended = no_answer(checkpoints.account), lesson.collected.counts
            warn_of_silence(shares, subject.expert.silence.reason, ended["given_up_episodes"])
    sizes = {"student": size_of_student(student)}
    if subject.expert is not None:
        sizes["expert"] = size_of_expert(subject.expert, run.observation_size)
    report = report_of(
        run,
        evaluation,
        sizes,
        lesson,
        trained.steps,
        checkpoints,
        train_seconds=seconds,
        matmul_precision=precision,
    )
    return Distilled(
        student=student,
        evaluation=evaluation,
        history=trained.history,
        queries=report["queries"],
        settings=config_of(run),
        report=report,
        dataset=replace(lesson.dataset, spread=run.spread),
        view=lesson.view,
    )


def _evaluated(
    rounds: Rounds,
    subject: Subject,
    theirs: Episodes | None,
    lesson: Lesson,
    trained: Trained,
    constraints: Constraints | None,
) -> Evaluation | None:
    """Compare the student with the expert's episodes, where there are any, and tell of it."""
    if subject.expert is None or subject.pool is None or theirs is None:
        return None
    run, last = rounds.run, trained.history[-1]
    evaluation = evaluate_pair(
        follow(lesson.view.policy(trained.student.act)),
        subject.expert,
        theirs,
        subject.pool,
        run.horizon,
        run.seed,
        rounds.training.progress,
        constraints,
        run.observation_size - run.past - run.remembered,
    )
    about = int(last["round"]), trained.steps, last
    rounds.training.callback(Event("evaluation", *about, trained.student, evaluation))
    return evaluation


def _examined(
    rounds: Rounds, subject: Subject, given: Dataset | None, *, force: bool
) -> Episodes | None:
    """Lead the expert through the gate; return its episodes where they are compared with."""
    run, expert, pool = rounds.run, subject.expert, subject.pool
    if expert is not None and given is not None:
        around = run.probes_given  # else there will be answers of this expert alone
        examine_given(expert, given, admit=pool is None, around=around, force=force)
    if expert is None or pool is None:
        return None
    starts = episode_seeds(run.seed, "evaluation", 0, run.evaluation_episodes or GATE_STATES)
    rows = sum(run.predicted_queries().values())
    if not run.evaluation_episodes:
        check_first(expert, pool, starts, force=force, rows=rows, largest=run.largest_batch)
        return None
    bars, most = rounds.training.progress, run.largest_batch
    return examine(expert, pool, starts, run.horizon, bars, force=force, rows=rows, largest=most)


def _ask_again(
    run: Configuration, expert: Expert | None, theirs: Episodes | None, lesson: Lesson
) -> None:
    """Warn of an expert that answers otherwise than at the beginning."""
    if expert is None or not run.horizon:
        return
    recorded = lesson.collected.dataset
    if theirs is not None:
        observations, actions = theirs.observations[theirs.valid], theirs.actions[theirs.valid]
    elif run.trainer is not None:
        states = recorded.demonstrations
        observations, actions = states.observations, states.actions
    else:
        return
    width = recorded.high.astype(np.float64) - recorded.low
    compare_again(expert, observations, actions, width)
