"""distill(): the whole story, from an expert and an environment to a student."""

import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from fdtasil.checks import check_count
from fdtasil.compute import pick_device, torch_settings
from fdtasil.demonstrations.dataset import DatasetLike, load_dataset
from fdtasil.demonstrations.trainers import Trainer
from fdtasil.errors import SettingError
from fdtasil.experts.examination import check_first, examine
from fdtasil.experts.gate import GATE_STATES
from fdtasil.experts.load import ExpertLike, load_expert
from fdtasil.experts.sb3.trust import Trust
from fdtasil.files.storage import sha256
from fdtasil.probes.source import USUAL_COUNT, Probes
from fdtasil.progress import Stages
from fdtasil.results.distilled import Distilled
from fdtasil.results.evaluation import Evaluation, compare
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool, resolve_horizon
from fdtasil.run.account import Account
from fdtasil.run.arguments import source_of, trainer_for
from fdtasil.run.configuration import Configuration
from fdtasil.run.events import Callback, Event, tell_all
from fdtasil.run.folder import open_run_folder
from fdtasil.run.interrupts import heard_interrupts
from fdtasil.run.presets import preset_of
from fdtasil.run.report import noted_warnings, report_of, versions
from fdtasil.run.rounds import Rounds
from fdtasil.run.state import RunState
from fdtasil.run.subject import Subject, open_subject
from fdtasil.run.training import Training
from fdtasil.seeding import check_seed, episode_seeds
from fdtasil.student.network import check_shape
from fdtasil.student.view import StudentObservation, View, columns_of, describe_view

__all__ = ["distill", "evaluate"]


def distill(
    expert: ExpertLike | None = None,
    env: EnvironmentLike | None = None,
    probes: int | str | Probes = USUAL_COUNT,
    *,
    trainer: str | Trainer = "bc",
    episodes: int = 20,
    horizon: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    demonstrations: DatasetLike | None = None,
    order: int = 1,
    preset: str = "standard",
    output: str | None = None,
    trust: Trust = None,
    student_obs: StudentObservation | None = None,
    hidden: tuple[int, ...] | int | None = None,
    activation: str | None = None,
    steps: int | None = None,
    epochs: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    weight_decay: float | None = None,
    weight: float | None = None,
    curvature_weight: float | None = None,
    max_gradient_norm: float | None = None,
    validation: float | None = None,
    patience: int | None = None,
    evaluation_episodes: int = 20,
    max_queries: int | None = None,
    force: bool = False,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    log_formats: tuple[str, ...] = (),
    callback: Callback | None = None,
    progress: bool = True,
) -> Distilled:
    """Distil an expert that can only be asked into a small torch policy that reacts as it does.

    The student matches the expert's actions at the states of the demonstrations, and the
    expert's differences along probes around them (TaSIL, arXiv 2205.14812, appendix on finite
    differences). The expert is never differentiated, unless `probes="jacobian"`.

    Args:
        expert: An ONNX path, the path of a stable-baselines3 zip, either of them on the Hugging
            Face hub (`hf://org/repo/file[@revision]`), a torch module, an object with
            stable-baselines3's `predict`, or a function on batches (B, n) -> (B, m) in
            environment units. None with `demonstrations`: then nobody is asked.
        env: A gymnasium id (`module:Id` too), a gymnasium environment, or a function making one.
            None with `demonstrations`: then nothing is recorded or evaluated.
        probes: The derivative source: 0 (plain behaviour cloning), N (N random directions at
            each state; half of them lead towards other visited states where few of all
            observations can occur), "sphere:N" (N isotropic directions at each state, asked
            once), "sphere:N,resample" (asked anew while training), "orthogonal:N", "basis",
            "jacobian" (the analytic reference). Options after commas: forward, central, labels
            (the answers are labels of the moved states, and nothing is differenced), radius=R,
            raw, whitened, per_step=K. Radius and stencil that are left open are found by
            asking at a ladder of radii first.
        trainer: Who acts in which round: "bc" (the expert), "dagger" (a mixture of expert and
            student), "dart" (the expert with noise), or a trainer with settings of its own.
        episodes: Number of demonstrations; those given say it themselves.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Equal seeds give equal bytes, on one machine with the same versions.
        device: Where the student is trained: "cpu", "cuda", "cuda:N".
        demonstrations: Train from these instead of recording: a run folder, its
            demonstrations.npz, or a `Dataset`. Stored answers to probes are used as they are.
        order: 1, or 2 to match second differences too (central stencil, or "jacobian").
        preset: Where the defaults below come from: "standard", or "paper" (TaSIL's settings: raw
            probes of radius 0.01, weight 0.01, 4,500 epochs).
        output: Name of the ONNX output with the actions, where several could be it.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.
        student_obs: Indices of the coordinates that the student sees, or a function
            (B, n) -> (B, k); the expert sees all. Probes move only what the student sees.
        hidden: Widths of the student's hidden layers, or that of the only one.
        activation: One of elu, gelu, relu, silu, tanh.
        steps: Gradient steps of a round; leave out where `epochs` is given. Usually 4,000, and
            beyond 1,500 states more, by the square root of their number.
        epochs: Visits of each state in a round; leave out where `steps` is given.
        batch_size: States in a minibatch.
        learning_rate: Peak learning rate of AdamW, with cosine decay to zero.
        weight_decay: Decoupled weight decay.
        weight: Weight of the derivative error. 0.5 holds the student to the expert's reaction to
            deviations of about half a standard deviation.
        curvature_weight: Weight of the error of the second differences, with `order=2`.
        max_gradient_norm: Scale longer gradients to this norm.
        validation: Share of the episodes held out, by which the best weights are chosen.
        patience: Validations (one each 100 steps) without a better one after which to stop.
        evaluation_episodes: Episodes of the paired evaluation; 0 leaves it out.
        max_queries: Refuse to start a run that may ask the expert more often.
        force: Go on with a warning where the expert fails the gate but answers.
        out: Folder of the run: checkpoints while it goes on, then all its files.
        resume: Folder of a run that was interrupted; it goes on from its last checkpoint and ends
            with the bytes of a run that never was. `max_queries` may be another; so may versions
            and `device`, with a warning that bytes may differ.
        log_formats: Some of stdout, log, csv, json, tensorboard: stable-baselines3's logger, into
            the folder `log` of the run.
        callback: Told of each 100 training steps, each round and the evaluation; see `Event`.
        progress: Show progress bars, where there is a terminal.

    Returns:
        The student with its evaluation, history, queries and settings.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If the expert can't be opened or fails the gate, before anything is trained.
        EnvironmentFault: If the environment can't be used, or misbehaves.
        FitError: If training diverges, or the GPU has no memory left.
        StorageError: If the run's folder can't be written.

    Example:
        >>> import numpy as np
        >>> result = distill(
        ...     lambda x: np.clip(-8 * np.arctan2(x[:, 1:2], x[:, :1]) - 2 * x[:, 2:], -2, 2),
        ...     "Pendulum-v1", probes=4, episodes=2, horizon=50, steps=50, hidden=16,
        ...     evaluation_episodes=2,
        ... )
        >>> result.student.predict(result.demonstrations.observations[0])[0].shape
        (1,)
    """
    given = None if demonstrations is None else load_dataset(demonstrations)
    defaults = preset_of(preset)
    settings = defaults.fit_with(
        steps=steps,
        epochs=epochs,
        batch_size=batch_size,
        learning_rate=learning_rate,
        weight_decay=weight_decay,
        weight=weight,
        curvature_weight=curvature_weight,
        max_gradient_norm=max_gradient_norm,
        validation=validation,
        patience=patience,
    )
    stored = given is not None and given.answers is not None
    source = source_of(probes, defaults, order, given, usual=USUAL_COUNT)
    if source is not None and callable(student_obs):
        source = source.with_order(order)  # a curved view allows the forward stencil only
    place = pick_device(device)
    widths = (hidden,) if isinstance(hidden, (int, np.integer)) else hidden
    check_seed(seed)
    evaluated = check_count("evaluation_episodes", evaluation_episodes, least=0)
    check_shape(widths or (), activation or defaults.activation)
    if out is not None and resume is not None:
        found = f"out={str(out)!r} beside resume={str(resume)!r}"
        raise SettingError(found, "one folder", "leave out= out: a resumed run stays in its own")
    with (
        noted_warnings() as notes,
        open_subject(expert, env, given, output=output, trust=trust) as subject,
    ):
        run = Configuration(
            expert=subject.expert_name,
            expert_sha256=subject.expert.sha256 if subject.expert else None,
            env=subject.environment,
            trainer=trainer_for(trainer, given),
            demonstrations=sha256(given.to_bytes()) if given else None,
            states=len(given.demonstrations) if given else None,
            probes=source,
            calibrated=source is not None
            and defaults.calibrates(source)
            and not stored
            and subject.expert is not None,
            usual_radius=defaults.radius,
            probes_given=stored,
            order=order if source else 0,
            observation_size=subject.observation_size,
            student_obs=describe_view(student_obs),
            hidden=defaults.hidden if widths is None else tuple(map(int, widths)),
            activation=defaults.activation if activation is None else activation,
            fit=settings,
            episodes=given.demonstrations.episodes if given else check_count("episodes", episodes),
            horizon=resolve_horizon(horizon, subject.pool) if subject.pool else 0,
            seed=int(seed),
            device=device,
            evaluation_episodes=evaluated if subject.comparable else 0,
            max_queries=max_queries,
        )
        run.check_budget()
        place_of_run = out if resume is None else resume
        folder = None if place_of_run is None else Path(place_of_run)
        config = {**run.to_json(), "versions": versions()}
        with (
            open_run_folder(folder, config, resume=resume is not None) as kept,
            heard_interrupts() as interrupts,
        ):
            if folder and kept.finished and resume is not None:
                return Distilled.load(folder, student_obs)
            asked = subject.expert.queries if subject.expert else Counter[str]()
            account = Account(asked, notes)
            state = RunState(run, subject.expert, student_obs, kept, account, dataset=given)
            callbacks = tell_all(callback, log_formats, folder)
            training = Training(state, place, Stages(progress), interrupts, callbacks)
            result = _go(training, subject, force=force)
            if folder:
                result.save(folder)
                kept.close()
    return result


def evaluate(
    policy: ExpertLike,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 20,
    horizon: int | None = None,
    seed: int = 0,
    output: str | None = None,
    trust: Trust = None,
    student_obs: StudentObservation | None = None,
    force: bool = False,
    progress: bool = True,
) -> Evaluation:
    """Compare a policy with an expert from the same starts.

    Args:
        policy: The policy to judge: a `Student`, an exported ONNX file, or anything else that an
            expert may be.
        expert: The policy to judge it by; an ONNX path, a torch module, an object with `predict`,
            or a function on batches.
        env: A gymnasium id (`module:Id` too), a gymnasium environment, or a function making one.
        episodes: Number of paired episodes.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Of the starts; those of `distill` with the same seed.
        output: Name of the expert's ONNX output with the actions, where several could be it.
        trust: As `load_expert`, for the expert.
        student_obs: What the policy sees, as in `distill`; an ONNX file that fdtasil exported
            says its indices itself.
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, where there is a terminal.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If one of the two can't be opened, or the expert fails the gate.
        EnvironmentFault: If the environment can't be used, or misbehaves.

    Example:
        >>> import numpy as np
        >>> def swing(observations):
        ...     cosine, sine, speed = observations.T
        ...     return np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]
        >>> evaluate(swing, swing, "Pendulum-v1", episodes=2, horizon=50).normalized_return
        1.0
    """
    check_seed(seed)
    stages = Stages(progress)
    with EnvironmentPool(env) as pool, torch_settings(torch.device("cpu")):
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        black_box = load_expert(expert, n, m, output=output, trust=trust)
        length = resolve_horizon(horizon, pool)
        starts = episode_seeds(seed, "evaluation", 0, check_count("episodes", episodes))
        theirs = examine(black_box, pool, starts, length, stages, force=force)
        seen = columns_of(policy) if student_obs is None else student_obs
        view = View.of(seen, theirs.observations[theirs.valid][:256])
        student = load_expert(policy, view.size, m)
        answer = view.policy(student.policy("evaluate"))
        return compare(answer, black_box, theirs, pool, length, seed, stages)


def _go(training: Training, subject: Subject, *, force: bool) -> Distilled:
    """Gate, rounds, comparison, report."""
    state, run = training.state, training.state.run
    stages, expert, pool = training.stages, subject.expert, subject.pool
    with torch_settings(training.device) as precision:
        theirs = None
        if expert is not None and pool is not None:
            starts = episode_seeds(
                run.seed, "evaluation", 0, run.evaluation_episodes or GATE_STATES
            )
            rows = sum(run.predicted_queries().values())
            if run.evaluation_episodes:
                theirs = examine(expert, pool, starts, run.horizon, stages, force=force, rows=rows)
            else:
                check_first(expert, pool, starts, force=force, rows=rows)
        state.account.started = time.perf_counter()
        Rounds(pool, training).all()
        seconds, student, evaluation = state.account.seconds, state.trained, None
        if expert is not None and pool is not None and theirs is not None:
            policy = state.view.policy(student.act)
            evaluation = compare(policy, expert, theirs, pool, run.horizon, run.seed, stages)
            last = state.history[-1]
            about = int(last["round"]), state.steps, last
            training.callback(Event("evaluation", *about, student, evaluation))
    report = report_of(
        run,
        evaluation,
        state,
        train_seconds=seconds,
        matmul_precision=precision,
    )
    settings = {**run.to_json(), "versions": report["versions"]}
    history, queries = state.history, report["queries"]
    return Distilled(
        student, evaluation, history, queries, settings, report, state.data, state.view
    )
