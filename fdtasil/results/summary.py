"""What a run comes to, as rows of a table: the model card and the page are made of them."""

from collections.abc import Mapping
from typing import Any

from fdtasil.errors import shown
from fdtasil.experts.expert import rows_text
from fdtasil.results.size import size_text

__all__ = ["call_of", "run_rows"]

Rows = list[tuple[str, str]]


def run_rows(report: Mapping[str, Any]) -> Rows:
    """Return what a report says of how a student came to be."""
    expert, sizes = report["expert"], report.get("size", {})
    rows = [
        ("expert", shown(expert["path"] or "none")),
        ("expert, sha256", expert["sha256"] or "no file"),
        ("environment", shown(report["env"])),
        ("demonstrations", f"{report['states']:,} states, {report['trainer']}"),
        ("probes", report["probes"]),
    ]
    if report.get("probes_chosen"):
        rows.append(("why", report["probes_chosen"]))
    rows += [
        ("queries", rows_text(report["queries"]) or "none"),
        ("training", f"{report['steps']:,} steps, {report['train_seconds']:,.0f} s"),
        *((f"size of the {name}", size_text(size)) for name, size in sizes.items()),
        ("seed", str(report["seed"])),
        ("versions", ", ".join(f"{name} {text}" for name, text in report["versions"].items())),
    ]
    if report.get("held"):
        rows.append(("never probed", ", ".join(map(shown, report["held"]))))
    return rows


def call_of(settings: Mapping[str, Any]) -> str:
    """Return the call that repeats a run, where expert and environment are files and ids."""
    given = [repr(settings["expert"]), repr(settings["env"])]
    probes = settings["probes"]
    given.append("0" if probes == "none" else repr(probes))
    plain = {name: settings.get(name) for name in ("trainer", "episodes", "horizon", "seed")}
    given += [f"{name}={value!r}" for name, value in plain.items() if value is not None]
    student = dict(settings["student"])
    if "architecture" not in student:
        hidden = tuple(student.get("hidden", ()))
        given.append(f"student=fdtasil.Mlp({hidden}, {student.get('activation')!r})")
    fit = settings["fit"]
    steps = {name: fit.get(name) for name in ("steps", "epochs", "learning_rate")}
    told = ", ".join(f"{name}={value}" for name, value in steps.items() if value is not None)
    given.append(f"fit=fdtasil.Fit({told})")
    inside = ",\n".join(f"    {one}" for one in given)
    return f"import fdtasil\n\nresult = fdtasil.distill(\n{inside},\n)\n"
