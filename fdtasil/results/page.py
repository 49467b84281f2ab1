"""A run on one page of HTML: no script, no network, pictures inside."""

import base64
import json
from collections.abc import Mapping
from html import escape
from typing import Any

from fdtasil.results.evaluation import Evaluation, evaluation_rows, missing_text, rows_html
from fdtasil.results.figures import FIGURES
from fdtasil.results.summary import call_of, run_rows

__all__ = ["page_of", "result_html"]

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff;
       max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; width: 100%; }
td { border-top: 1px solid #ddd; padding: .3rem .6rem .3rem 0; vertical-align: top;
     overflow-wrap: anywhere; }
td:first-child { color: #555; width: 13rem; }
img { max-width: 100%; height: auto; }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; }
.big { font-size: 2.2rem; font-weight: 600; }
.warning { border-left: 3px solid #c77700; padding-left: .8rem; margin: .5rem 0; }
"""


def page_of(result: Any) -> str:
    """Return everything that a run knows as one page of HTML.

    Args:
        result: A `Distilled`.
    """
    report, evaluation = result.report, result.evaluation
    warnings = "".join(f'<p class="warning">{escape(text)}</p>' for text in report["warnings"])
    parts = [
        f"<h1>{escape(report['env'])}</h1>",
        _headline(evaluation, result.settings),
        f"<h2>Warnings</h2>{warnings}" if warnings else "",
        ""
        if evaluation is None
        else f"<h2>Evaluation</h2>{rows_html(evaluation_rows(evaluation))}",
        f"<h2>How it came to be</h2>{rows_html(run_rows(report))}",
        *(f"<h2>{name.capitalize()}</h2>{picture}" for name, picture in _pictures(result)),
        f"<h2>Again</h2><pre>{escape(call_of(result.settings, result.steps_seen))}</pre>",
        f"<h2>Settings</h2><pre>{escape(json.dumps(result.settings, indent=1))}</pre>",
    ]
    title = escape(f"fdtasil: {report['env']}")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


def result_html(result: Any) -> str:
    """Return what a notebook shows of a result: two tables and the returns."""
    evaluation = result.evaluation
    judged = "" if evaluation is None else rows_html(evaluation_rows(evaluation))
    pictures = [picture for name, picture in _pictures(result) if name == "returns"]
    return "".join([judged, rows_html(run_rows(result.report)), *pictures])


def _headline(evaluation: Evaluation | None, settings: Mapping[str, Any]) -> str:
    if evaluation is None:
        return f"<p>{missing_text(settings).capitalize()}.</p>"
    if evaluation.normalized_return is None:
        return "<p>A share of its expert's return means nothing here.</p>"
    share = f"{evaluation.normalized_return:.0%}"
    return f'<p><span class="big">{share}</span> of the expert\'s return</p>'


def _pictures(result: Any) -> list[tuple[str, str]]:
    found: Mapping[str, bytes | None] = {name: draw(result) for name, draw in FIGURES.items()}
    return [
        (name, f'<img alt="{name}" src="data:image/png;base64,{base64.b64encode(png).decode()}">')
        for name, png in found.items()
        if png is not None
    ]
