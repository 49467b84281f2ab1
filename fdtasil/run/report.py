"""What a run says of itself: `report.json`, and the warnings on the way."""

import platform
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from typing import Any

from fdtasil.errors import FdtasilWarning
from fdtasil.results.evaluation import Evaluation
from fdtasil.run.configuration import Configuration
from fdtasil.run.state import RunState

__all__ = ["noted_warnings", "report_of", "versions"]

_VERSIONED = ("fdtasil", "torch", "numpy", "gymnasium", "mujoco", "onnx", "onnxruntime")


def versions() -> dict[str, str]:
    """Return the versions that a run's bytes depend on."""
    return {"python": platform.python_version()} | {name: version(name) for name in _VERSIONED}


def report_of(
    configuration: Configuration,
    evaluation: Evaluation | None,
    state: RunState,
    *,
    train_seconds: float,
    matmul_precision: str,
) -> dict[str, Any]:
    """Return what `report.json` holds, as plain JSON values.

    Args:
        configuration: The run's.
        evaluation: Student against expert, or None where they could not be compared.
        state: After the last round.
        train_seconds: Wall-clock seconds of collecting, probing and training, those of the
            interrupted run for what was taken up included.
        matmul_precision: torch's float32 matrix-product precision in force.
    """
    plain = configuration.to_json()
    source, calibration = state.source, state.calibration
    # The ladder was chosen before it was known what it finds.
    predicted = replace(configuration, probes=source).predicted_queries() | {
        "calibrate": configuration.predicted_queries()["calibrate"]
    }
    asked = state.account.queries
    return {
        "expert": {
            "path": configuration.expert,
            "sha256": configuration.expert_sha256,
            "return_mean": evaluation.expert_return if evaluation else None,
        },
        **{name: plain[name] for name in ("env", "trainer", "seed")},
        "probes": source.describe() if source else "none",
        "radius": source.radius if source else None,
        "calibration": calibration.to_json() if calibration else None,
        "versions": versions(),
        "evaluation": evaluation.to_json() if evaluation else None,
        "queries": {name: asked[name] for name in predicted},
        "predicted_queries": predicted,
        "rows_asked_again_after_resuming": asked["again"],
        "states": len(state.data.demonstrations),
        "frozen_coordinates": int((~state.scales.live).sum()),
        "clipped_actions": state.counts["clipped_actions"],
        "physics_resets": state.counts["physics_resets"],
        "terminated_episodes": state.counts["terminated_episodes"],
        "steps": state.steps,
        "train_seconds": round(train_seconds, 2),
        "matmul_precision": matmul_precision,
        "warnings": state.account.notes,
    }


@contextmanager
def noted_warnings() -> Iterator[list[str]]:
    """Keep the library's warnings in a list as well as showing them, each time they occur."""
    notes: list[str] = []
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=FdtasilWarning, append=True)
        shown = warnings.showwarning

        def note(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if issubclass(category, FdtasilWarning):
                notes.append(str(message))
            shown(message, category, *where)

        warnings.showwarning = note  # catch_warnings puts the old one back
        yield notes
