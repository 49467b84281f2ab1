"""What a run says of itself: `config.json`, `report.json`, and the warnings on the way."""

import platform
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

from fdtasil.results.evaluation import Evaluation
from fdtasil.results.size import Size
from fdtasil.run.account import Account
from fdtasil.run.checkpoints import Checkpoints
from fdtasil.run.configuration import Configuration
from fdtasil.run.lesson import Lesson
from fdtasil.version import __version__

__all__ = ["config_of", "report_of", "versions"]

_VERSIONED = ("torch", "numpy", "gymnasium", "mujoco", "onnx", "onnxruntime")


def versions() -> dict[str, str]:
    """Return the versions that a run's bytes depend on."""
    ours = {"python": platform.python_version(), "fdtasil": __version__}
    return ours | {name: version(name) for name in _VERSIONED}


def config_of(run: Configuration) -> dict[str, Any]:
    """Return what `config.json` holds, as plain JSON values."""
    return {**run.to_json(), "versions": versions()}


def no_answer(account: Account) -> dict[str, float]:
    """Return the share of the rows asked that had no answer, by purpose, where some had none."""
    asked = account.queries
    silent = account.silent.items()
    return {name: rows / asked[name] for name, rows in silent if rows > 0 and asked[name] > 0}


def _held(run: Configuration) -> list[str]:
    """Return the parts of the observation that no probe moves, by name."""
    parts = run.spaces.observations.parts if run.spaces else ()
    return [part.name or "observation" for part in parts if part.kind != "number"]


def report_of(
    run: Configuration,
    evaluation: Evaluation | None,
    sizes: Mapping[str, Size],
    lesson: Lesson,
    steps: int,
    checkpoints: Checkpoints,
    *,
    train_seconds: float,
    matmul_precision: str,
) -> dict[str, Any]:
    """Return what `report.json` holds, as plain JSON values.

    Args:
        run: The configuration.
        evaluation: Student against expert, or None where they could not be compared.
        sizes: Of student and expert, by these names.
        lesson: What the last round learnt from.
        steps: Gradient steps of all rounds.
        checkpoints: Know the account and the calibration.
        train_seconds: Wall-clock seconds of collecting, probing and training, those of the
            interrupted run for what was taken up included.
        matmul_precision: torch's float32 matrix-product precision in force.
    """
    plain, account = run.to_json(), checkpoints.account
    source, calibration = checkpoints.asking.source, checkpoints.asking.calibration
    radius = source.radius if source else None
    # The ladder, and the gate's batch, were chosen before it was known what the ladder finds.
    before = run.predicted_queries()
    chosen = {purpose: before[purpose] for purpose in ("calibrate", "check")}
    predicted = replace(run, probes=source).predicted_queries() | chosen
    counts = (
        "clipped_actions",
        "physics_resets",
        "terminated_episodes",
        "replaced_episodes",
        "given_up_episodes",
    )
    return {
        "expert": {
            "path": run.expert,
            "sha256": run.expert_sha256,
            "return_mean": evaluation.expert_return if evaluation else None,
        },
        **{name: plain[name] for name in ("env", "trainer", "seed")},
        "probes": source.describe() if source else "none",
        "probes_chosen": run.reason,
        "radius": list(radius) if isinstance(radius, tuple) else radius,
        "calibration": calibration.to_json() if calibration else None,
        "versions": versions(),
        "evaluation": evaluation.to_json() if evaluation else None,
        "queries": {name: account.queries[name] for name in predicted},
        "predicted_queries": predicted,
        "no_answer": no_answer(account),
        "rows_asked_again_after_resuming": account.again,
        "states": len(lesson.dataset.demonstrations),
        "frozen_coordinates": int((~lesson.scales.live).sum()),
        "following_coordinates": len(lesson.scales.followers),
        "held": _held(run),
        **{name: lesson.collected.counts.get(name, 0) for name in counts},
        "size": {name: size.to_json() for name, size in sizes.items()},
        "steps": steps,
        "train_seconds": round(train_seconds, 2),
        "matmul_precision": matmul_precision,
        "warnings": account.notes,
    }
