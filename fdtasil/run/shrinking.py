"""The smallest student that keeps the expert's level, from the answers that are there."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from fdtasil.checks import check_count, check_flag, check_path, check_share, spelt
from fdtasil.errors import SettingError, warn
from fdtasil.experts.load import ExpertLike
from fdtasil.files.lock import locked
from fdtasil.files.storage import write_bytes
from fdtasil.progress import Progress
from fdtasil.results.distilled import Distilled
from fdtasil.results.shrunk import Candidate, Shrunk
from fdtasil.rollouts.environments import EnvironmentLike, EnvironmentPool
from fdtasil.rollouts.wanted import Environment, import_module_of
from fdtasil.run.elsewhere import side_by_side
from fdtasil.run.evaluating import evaluate
from fdtasil.run.folder import KEPT, RunFolder
from fdtasil.run.judging import warn_of_another_environment
from fdtasil.run.pipeline import distill
from fdtasil.student.architectures import Mlp
from fdtasil.student.fit import Fit

__all__ = ["LADDER", "OTHER_STARTS", "fit_of", "shrink"]

LADDER: tuple[tuple[int, ...], ...] = (
    (8, 8),
    (16, 16),
    (32, 32),
    (64, 64),
    (128, 128),
    (256, 256),
)
"""Hidden layers of the students that are tried, the smallest first."""
OTHER_STARTS = 1_000
"""Added to the seed, for the starts by which the chosen student is judged once more."""


def shrink(
    run: Distilled | str | Path,
    expert: ExpertLike,
    env: EnvironmentLike,
    *,
    keep: float = 0.95,
    sizes: Sequence[tuple[int, ...]] = LADDER,
    activations: Sequence[str] = ("relu",),
    cloned: bool = True,
    evaluation_episodes: int = 20,
    horizon: int | None = None,
    seed: int | None = None,
    fit: Fit | None = None,
    force: bool = False,
    out: str | Path | None = None,
    workers: int = 1,
    progress: bool = True,
) -> Shrunk:
    """Find the smallest student that keeps a share of the expert's return.

    Nothing is recorded again: each student learns from the demonstrations of a run, and from the
    answers that are stored with them; where the run asked a cheap expert anew, so do these. A run
    without probes has no answers: the expert is asked for each student, as `distill` does. The
    smallest is judged once more, from starts that it was not chosen by. Those that are cloned
    take as many steps as those with probes.

    Args:
        run: A result, or the folder of one.
        expert: The expert of that run, as in `distill`.
        env: Its environment.
        keep: Share of the expert's paired return; the lower end of the interval must reach it.
        sizes: Hidden layers of the students that are tried.
        activations: Of each size. "relu" is what boards and verifiers have.
        cloned: Also train each without probes, to show what these are worth.
        evaluation_episodes: Paired episodes; the more, the narrower the interval.
        horizon: As in `distill`; left out, the run's.
        seed: Left out, the run's.
        fit: As in `distill`; left out, the run's.
        force: Go on with a warning where the expert fails the gate but answers.
        out: Folder of the runs, one for each student. What is done in it is taken up, so that it
            may be killed and begun again.
        workers: Students that are trained side by side, in processes; the expert must be a path
            or an address then, and the environment an id.
        progress: Show a progress bar, in a terminal or a notebook.

    Raises:
        SettingError: If an argument can't be used, or `out` holds students of another call.

    Example::

        found = fdtasil.shrink("runs/cheetah", "HalfCheetah-v5.onnx", "HalfCheetah-v5")
        print(found)
        found.result.export("student.c")
    """
    if expert is None or env is None:
        raise SettingError(
            f"no {'expert' if expert is None else 'environment'} to judge students with",
            "the expert of the run, and its environment",
            "write for example shrink(run, expert, env)",
        )
    share, workers = check_share("keep", keep), check_count("workers", workers)
    result = run if isinstance(run, Distilled) else Distilled.load(check_path("run", run))
    jobs = _jobs(sizes, activations)
    cloned = check_flag("cloned", cloned)
    if workers > 1 and not (isinstance(expert, str | Path) and _id_of(env)):
        raise SettingError(
            f"workers={workers} with an expert or an environment of this process",
            "a path or an address, and an id",
            "leave workers= out",
        )
    folder = None if out is None else check_path("out", out).absolute()
    with EnvironmentPool(env) as pool:
        warn_of_another_environment(result, pool)
    if horizon is None and not result.settings["horizon"]:
        raise SettingError(
            "a run without an environment, and so without a horizon",
            "the steps after which an episode of the comparison is cut",
            "write for example horizon=300",
        )
    settings: dict[str, Any] = {
        "dataset": result.dataset,
        "student_obs": _seen(result),
        "evaluation_episodes": check_count("evaluation_episodes", evaluation_episodes, 2),
        "horizon": result.settings["horizon"] if horizon is None else horizon,
        "seed": result.settings["seed"] if seed is None else seed,
        "fit": fit_of(result) if fit is None else fit,
        "force": check_flag("force", force),
        "progress": False,
    }
    found = dict[_Job, Distilled]()
    count, bars = len(jobs) * (1 + cloned), Progress(check_flag("progress", progress))
    with (
        _going_on(folder, found),
        _place_of(folder, workers) as place,
        bars.bar("students", "student", count) as bar,
    ):
        train = partial(_trained, expert, env, settings, place)

        def train_all(jobs: Sequence[_Job]) -> None:
            for job, student in _all(train, jobs, place, _id_of(env), workers):
                found[job] = student
                bar.move(1)

        train_all(jobs)
        if cloned:  # as long as its counterpart, which may have asked anew and trained for longer
            train_all([replace(job, cloned=found[job].report["steps"]) for job in jobs])
    settings["progress"] = progress
    shrunk = _confirmed(_judged(found, share), expert, env, settings)
    if folder is not None:
        _write(shrunk, folder)
    if shrunk.judged and shrunk.result is None:
        warn(f"no student of {len(jobs)} keeps {share:.0%} of the expert's return")
    return shrunk


def fit_of(result: Distilled) -> Fit:
    """Return how the student of a run was trained."""
    anew = "resample" in result.settings["probes"]
    return Fit.from_json(result.settings["fit"], anew=anew)


def _seen(result: Distilled) -> tuple[int, ...] | None:
    """Return what the students of a run see.

    Raises:
        SettingError: If it is a function, which no file says.
    """
    through = result.settings["student_obs"]
    if isinstance(through, str):
        raise SettingError(
            f"a run with a student that sees through {through}",
            "one whose student sees the observation, or some of its coordinates",
            "distil each size anew: distill(..., student=fdtasil.Mlp((64, 64)))",
        )
    return result.view.columns if result.dataset.history == 1 else None


def _id_of(env: EnvironmentLike) -> str | None:
    """Return the id that other processes can make the environment by, if there is one."""
    found = env.environment if isinstance(env, Environment) else env
    return found if isinstance(found, str) else None


@dataclass(frozen=True)
class _Job:
    """A student to train.

    Attributes:
        hidden: Widths of its hidden layers.
        activation: Between them.
        cloned: For how many steps it is cloned plainly; None with probes.
    """

    hidden: tuple[int, ...]
    activation: str
    cloned: int | None = None

    @property
    def folder(self) -> str:
        """Where it is kept."""
        widths = "x".join(map(str, self.hidden)) or "linear"
        return f"{widths}-{self.activation}{'' if self.cloned is None else '-cloned'}"


def _jobs(sizes: Sequence[tuple[int, ...]], activations: Sequence[str]) -> list[_Job]:
    """Return the students with probes; what can't be built is refused before anything is."""
    wrong = SettingError(
        spelt("sizes", sizes),
        "the hidden layers of each student, each once; (64, 64) are two layers of 64 units",
        "write for example sizes=[(32,), (64, 64)]",
    )
    try:
        listed = list(sizes)
    except TypeError:
        raise wrong from None
    jobs = []
    for hidden in listed:
        for activation in activations:
            widths = Mlp(hidden, activation).hidden
            assert isinstance(widths, tuple)
            jobs.append(_Job(widths, activation))
    if not jobs:
        raise SettingError("no sizes", "one student at least", "leave sizes= out")
    if len(set(jobs)) < len(jobs):  # (64, 64) in the place of [(64, 64)]
        raise wrong
    return jobs


@contextmanager
def _going_on(folder: Path | None, found: Mapping[_Job, Distilled]) -> Iterator[None]:
    """Say how to go on after an interruption: what a student's own run advises is of it alone."""
    try:
        yield
    except BaseException as error:
        said = getattr(error, "__notes__", [])
        notes = [one for one in said if not one.startswith(KEPT)]
        if folder is not None and (found or len(notes) < len(said)):
            notes.append(f"{KEPT} in {folder}: the same call again goes on with it")
        error.__notes__ = notes
        raise


@contextmanager
def _place_of(folder: Path | None, workers: int) -> Iterator[Path | None]:
    """Yield where the runs are kept: other processes have no other way to hand them over."""
    if folder is not None or workers == 1:
        yield folder
        return
    with TemporaryDirectory() as place:
        yield Path(place)


def _all(
    train: Callable[[_Job], Distilled],
    jobs: Sequence[_Job],
    place: Path | None,
    env: str | None,
    workers: int,
) -> Iterator[tuple[_Job, Distilled]]:
    if workers == 1 or place is None:
        yield from ((job, train(job)) for job in jobs)
        return
    alone = partial(_trained_alone, train, env)
    for job, _ in side_by_side(lambda job: f"the student {job.folder}", alone, jobs, workers):
        yield job, Distilled.load(place / job.folder)


def _trained_alone(train: Callable[[_Job], Distilled], env: str | None, job: _Job) -> None:
    """Train a student in a process of its own, which hands it over as its folder."""
    torch.set_num_threads(1)
    import_module_of(env)
    train(job)


def _trained(
    expert: ExpertLike,
    env: EnvironmentLike,
    settings: dict[str, Any],
    folder: Path | None,
    job: _Job,
) -> Distilled:
    given, probes = dict(settings), None
    if job.cloned is not None:
        given["dataset"] = replace(settings["dataset"], probes=None, answers=None)
        given["fit"] = replace(settings["fit"], steps=job.cloned, epochs=None)
        probes = 0
    train = partial(distill, expert, env, probes, student=Mlp(job.hidden, job.activation), **given)
    if folder is None:
        return train()
    place = folder / job.folder
    kept = RunFolder(place, {})
    if not kept.begun and not kept.finished:
        return train(out=place)
    try:
        return train(resume=place)
    except SettingError as error:
        if not error.found.startswith(str(place)):
            raise
        # The arguments, or the run itself, which may have been made anew since.
        step = f"remove {folder}, or write another out= (--out)"
        raise SettingError(error.found, "students of this call and this run", step) from error


def _judged(found: dict[_Job, Distilled], keep: float) -> Shrunk:
    judged = [(_candidate(job, result), result) for job, result in found.items()]
    judged.sort(key=lambda pair: (pair[0].bytes, pair[0].activation, pair[0].cloned))
    kept = (result for one, result in judged if not one.cloned and one.keeps(keep))
    return Shrunk(keep, tuple(one for one, _ in judged), next(kept, None))


def _confirmed(
    shrunk: Shrunk, expert: ExpertLike, env: EnvironmentLike, settings: dict[str, Any]
) -> Shrunk:
    """Judge the student that was chosen from starts that it was not chosen by."""
    if shrunk.result is None:
        return shrunk
    confirmed = evaluate(
        shrunk.result,
        expert,
        env,
        episodes=settings["evaluation_episodes"],
        horizon=settings["horizon"],
        seed=(settings["seed"] + OTHER_STARTS) % 2**32,
        force=settings["force"],
        progress=settings["progress"],
    )
    return replace(shrunk, confirmed=confirmed)


def _candidate(job: _Job, result: Distilled) -> Candidate:
    size, evaluation = result.report["size"]["student"], result.evaluation
    assert evaluation is not None, "there is an expert and an environment"
    return Candidate(
        job.hidden,
        job.activation,
        job.cloned is not None,
        size["bytes"],
        size["multiply_adds"],
        size["microseconds"],
        evaluation.normalized_return,
        evaluation.ci95,
        evaluation.survival,
    )


def _write(shrunk: Shrunk, folder: Path) -> None:
    """Write table and picture beside the runs."""
    rows = [vars(one) | {"name": one.name} for one in shrunk.candidates]
    found = shrunk.confirmed
    confirmed = found and {"normalized_return": found.normalized_return, "ci95": found.ci95}
    table = {"keep": shrunk.keep, "candidates": rows, "confirmed": confirmed}
    with locked(folder):
        write_bytes(folder / "sizes.json", (json.dumps(table, indent=1) + "\n").encode())
        write_bytes(folder / "sizes.png", shrunk.draw())
