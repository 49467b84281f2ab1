"""A run's model card: what it is, how good, of whom, and what it is not for."""

from typing import Any

from fdtasil.results.evaluation import evaluation_rows, missing_text
from fdtasil.results.summary import call_of, run_rows

__all__ = ["card_of"]

_HEAD = """---
library_name: fdtasil
tags:
- imitation-learning
- policy-distillation
- reinforcement-learning
---
"""


def card_of(result: Any) -> str:
    """Return a model card in Markdown, in the form of the Hugging Face hub.

    Args:
        result: A `Distilled`.
    """
    report, evaluation = result.report, result.evaluation
    if evaluation is None:
        judged = f"{missing_text(result.settings).capitalize()}."
    else:
        judged = _table(evaluation_rows(evaluation))
    warnings = [f"- {_cell(text)}" for text in report["warnings"]] or ["- no warnings"]
    return "\n".join(
        [
            _HEAD,
            f"# A student for {_cell(report['env'])}\n",
            "A small policy that fdtasil distilled from an expert: it matches the expert's "
            f"actions at the states of demonstrations{_around(report['probes'])}.\n",
            "## How good\n",
            f"{judged}\n",
            "## How it came to be\n",
            _table(run_rows(report)) + "\n",
            "## Limits\n",
            "Nobody has judged it."
            if evaluation is None
            else "It was judged in this environment, from its own starts. Elsewhere nobody has "
            "looked.",
            "\n".join(warnings) + "\n",
            "## Files\n",
            f"- `student.onnx`: {_takes(result)} Normaliser and bounds are inside.\n"
            "- `student.safetensors`, `report.json`, `figures/`\n"
            "- of a whole run also `demonstrations.npz`, `config.json` and `progress.csv`\n",
            "## Again\n",
            f"```python\n{call_of(result.settings, result.steps_seen)}```\n",
        ]
    )


def _around(probes: str) -> str:
    if probes == "none":
        return ", which is plain behaviour cloning"
    return ", and its reactions around them ([TaSIL](https://arxiv.org/abs/2205.14812))"


def _takes(result: Any) -> str:
    """Return what goes in and out of the student's ONNX file."""
    student, order = result.student, result.observation_order
    chooses = student.spaces is not None and student.spaces.actions.choices
    scores = "`scores`, and the best of them as `actions`" if chooses else "`actions`"
    what = f" ({_cell(order)})" if order else ""
    return (
        f"`obs`, (rows, {student.observation_size}) float32{what}, to {scores}, "
        f"(rows, {student.action_size})."
    )


def _table(rows: list[tuple[str, str]]) -> str:
    lines = [f"| {_cell(name)} | {_cell(text)} |" for name, text in rows]
    return "\n".join(["| | |", "|---|---|", *lines])


def _cell(text: str) -> str:
    """Return a text that can't leave its cell, or be a link."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain.replace("|", "\\|").replace("[", "\\[").replace("<", "&lt;")
