"""distill(): the whole story, from an expert and an environment to a student."""

import time
from pathlib import Path

import numpy as np

from fdtasil.compute import pick_device, torch_settings
from fdtasil.configuration import GATE_STATES, Configuration, check_count
from fdtasil.distilled import Distilled
from fdtasil.environments import EnvironmentLike, EnvironmentPool, resolve_horizon
from fdtasil.evaluation import Evaluation, compare
from fdtasil.experts import Expert, ExpertLike, check_expert, load_expert
from fdtasil.presets import preset_of
from fdtasil.probes import Probes
from fdtasil.progress import Stages
from fdtasil.report import noted_warnings, report_of
from fdtasil.rollouts import Episodes, Policy, first_observations, follow, rollout
from fdtasil.rounds import Rounds
from fdtasil.sb3 import Trust
from fdtasil.seeding import check_seed, episode_seeds
from fdtasil.student import StudentShape
from fdtasil.trainers import Trainer, trainer_of

__all__ = ["distill", "evaluate"]


def distill(
    expert: ExpertLike,
    env: EnvironmentLike,
    probes: int | str | Probes = 10,
    *,
    trainer: str | Trainer = "bc",
    episodes: int = 20,
    horizon: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    preset: str = "standard",
    output: str | None = None,
    trust: Trust = None,
    hidden: tuple[int, ...] | None = None,
    activation: str | None = None,
    steps: int | None = None,
    epochs: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    weight_decay: float | None = None,
    weight: float | None = None,
    evaluation_episodes: int = 20,
    max_queries: int | None = None,
    force: bool = False,
    progress: bool = True,
) -> Distilled:
    """Distil an expert that can only be asked into a small torch policy that reacts as it does.

    The student matches the expert's actions at the states of the demonstrations, and the
    expert's differences along probes around them (TaSIL, arXiv 2205.14812, appendix on finite
    differences). The expert is never differentiated, unless `probes="jacobian"`.

    Args:
        expert: An ONNX path, the path of a stable-baselines3 zip, a torch module, an object with
            stable-baselines3's `predict`, or a function on batches (B, n) -> (B, m) in
            environment units.
        env: A gymnasium id (`module:Id` too), a gymnasium environment, or a function making one.
        probes: The derivative source: 0 (plain behaviour cloning), N or "sphere:N" (N random
            directions for each state, asked once), "sphere:N,resample" (asked anew while
            training), "orthogonal:N", "basis", "jacobian" (the analytic reference). Options
            after commas: forward, central, radius=R, raw, whitened, per_step=K.
        trainer: Who acts in which round: "bc" (the expert), "dagger" (a mixture of expert and
            student), "dart" (the expert with noise), or a trainer with settings of its own.
        episodes: Number of demonstrations.
        horizon: Steps after which an episode is cut; default: the environment's time limit.
        seed: Equal seeds give equal bytes, on one machine with the same versions.
        device: Where the student is trained: "cpu", "cuda".
        preset: Where the defaults below come from: "standard", or "paper" (TaSIL's settings: raw
            probes of radius 0.01, weight 0.01, 4,500 epochs).
        output: Name of the ONNX output with the actions, where several could be it.
        trust: "pickle" lets stable-baselines3 load what can't be read from a zip without running
            code that is in it.
        hidden: Widths of the student's hidden layers.
        activation: One of elu, gelu, relu, silu, tanh.
        steps: Gradient steps; leave out where `epochs` is given.
        epochs: Visits of each state; leave out where `steps` is given.
        batch_size: States in a minibatch.
        learning_rate: Peak learning rate of AdamW, with cosine decay to zero.
        weight_decay: Decoupled weight decay.
        weight: Weight of the derivative error. 0.5 holds the student to the expert's reaction to
            deviations of about half a standard deviation.
        evaluation_episodes: Episodes of the paired evaluation.
        max_queries: Refuse to start a run that may ask the expert more often.
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, where there is a terminal.

    Returns:
        The student with its evaluation, history, queries and settings.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If the expert can't be opened or fails the gate, before anything is trained.
        EnvironmentFault: If the environment can't be used, or misbehaves.
        FitError: If training diverges.

    Example:
        >>> result = distill(
        ...     lambda observations: 1.5 * np.tanh(-observations[:, 2:3]), "Pendulum-v1", probes=4,
        ...     episodes=2, horizon=50, steps=50, hidden=(16,), evaluation_episodes=2,
        ... )
        >>> result.student.predict(result.demonstrations.observations[0])[0].shape
        (1,)
    """
    defaults, source = preset_of(preset), Probes.parse(probes)
    place, stages = pick_device(device), Stages(progress)
    optimisation = defaults.fit_with(
        steps=steps,
        epochs=epochs,
        batch_size=batch_size,
        learning_rate=learning_rate,
        weight_decay=weight_decay,
        weight=weight,
    )
    with EnvironmentPool(env) as pool, torch_settings() as precision, noted_warnings() as notes:
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        black_box = load_expert(expert, n, m, output=output, trust=trust)
        run = Configuration(
            expert=str(expert) if isinstance(expert, (str, Path)) else black_box.name,
            expert_sha256=black_box.sha256,
            env=pool.name,
            trainer=trainer_of(trainer),
            probes=defaults.complete(source),
            student=StudentShape(
                n,
                m,
                defaults.hidden if hidden is None else tuple(hidden),
                defaults.activation if activation is None else activation,
            ),
            fit=optimisation,
            episodes=episodes,
            horizon=resolve_horizon(horizon, pool),
            seed=check_seed(seed),
            device=device,
            evaluation_episodes=evaluation_episodes,
            max_queries=max_queries,
        )
        run.check_budget()
        starts = episode_seeds(seed, "evaluation", 0, evaluation_episodes)
        theirs = _gate(black_box, pool, starts, run.horizon, stages, force=force)
        rounds, student, history = Rounds(black_box, pool, run.probes, seed, stages), None, []
        started = time.perf_counter()
        for round_, count in enumerate(run.trainer.rounds(episodes)):
            rounds.collect(round_, count, run.trainer, student, run.horizon)
            student, entries = rounds.train(round_, run.student, run.fit, place)
            history += entries
        train_seconds = time.perf_counter() - started
        assert student is not None, "every trainer has a round"
        evaluation = _compare(student.act, black_box, theirs, pool, run.horizon, seed, stages)
        report = report_of(
            run,
            evaluation,
            rounds,
            steps=rounds.steps,
            train_seconds=train_seconds,
            matmul_precision=precision,
            notes=notes,
        )
    settings = {**run.to_json(), "preset": preset, "force": force, "versions": report["versions"]}
    return Distilled(
        student,
        evaluation,
        history,
        report["queries"],
        settings,
        report,
        rounds.labelled,
        rounds.answers,
    )


def evaluate(
    policy: ExpertLike,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    episodes: int = 20,
    horizon: int | None = None,
    seed: int = 0,
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
        force: Go on with a warning where the expert fails the gate but answers.
        progress: Show progress bars, where there is a terminal.

    Raises:
        SettingError: If an argument can't be used.
        ExpertError: If one of the two can't be opened, or the expert fails the gate.
        EnvironmentFault: If the environment can't be used, or misbehaves.

    Example:
        >>> def swing(observations):
        ...     return 1.5 * np.tanh(-observations[:, 2:3])
        >>> evaluate(swing, swing, "Pendulum-v1", episodes=2, horizon=50).normalized_return
        1.0
    """
    check_seed(seed)
    stages = Stages(progress)
    with EnvironmentPool(env) as pool:
        n, m = pool.boxes.observation_size, pool.boxes.action_size
        black_box = load_expert(expert, n, m)
        student = load_expert(policy, n, m)
        length = resolve_horizon(horizon, pool)
        starts = episode_seeds(seed, "evaluation", 0, check_count("episodes", episodes))
        theirs = _gate(black_box, pool, starts, length, stages, force=force)
        answer = student.policy("evaluate")
        return _compare(answer, black_box, theirs, pool, length, seed, stages)


def _gate(
    expert: Expert,
    pool: EnvironmentPool,
    starts: list[int],
    horizon: int,
    stages: Stages,
    *,
    force: bool,
) -> Episodes:
    """Check the expert on first states, let it act, check it on the states it visited.

    Returns:
        Its episodes from the evaluation's starts, which the student is compared with later.
    """
    first = first_observations(pool, [starts[e % len(starts)] for e in range(GATE_STATES)])
    check_expert(expert, first, pool.boxes, force=force)
    with stages.stage("expert", len(starts) * horizon, "step") as move:
        behaviour = follow(expert.policy("evaluate"))
        episodes = rollout(behaviour, pool, starts, horizon, on_step=move)
    visited = episodes.observations[episodes.valid]
    spread = np.linspace(0, len(visited) - 1, GATE_STATES).astype(int)
    check_expert(expert, visited[spread], pool.boxes, force=force)
    return episodes


def _compare(
    student: Policy,
    expert: Expert,
    expert_episodes: Episodes,
    pool: EnvironmentPool,
    horizon: int,
    seed: int,
    stages: Stages,
) -> Evaluation:
    total = len(expert_episodes.seeds) * horizon
    with stages.stage("evaluation", total, "step") as move:
        return compare(student, expert, expert_episodes, pool, horizon, seed, move)
