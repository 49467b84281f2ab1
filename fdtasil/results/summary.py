"""What a run comes to, as rows of a table: the model card and the page are made of them."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import gymnasium

from fdtasil.errors import in_one_line, shown
from fdtasil.experts.expert import rows_text
from fdtasil.results.size import size_text
from fdtasil.student.fit import Fit

__all__ = ["call_of", "run_rows"]

_FIT = {field.name for field in fields(Fit)}

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


def call_of(settings: Mapping[str, Any], history: int) -> str:
    """Return the call of a run, as far as its settings say it.

    Functions, datasets, and environments that gymnasium does not know stand in no file: they are
    named, and left to the reader; so is what an environment is made with.

    Args:
        settings: Of the run's configuration.
        history: How many observations the student sees.
    """
    of_data, lost = settings.get("dataset"), []
    is_file = settings.get("expert_sha256") or _is_address(settings["expert"])
    given = [_named("expert", settings["expert"], is_file, lost)]
    env = settings["env"] if settings.get("horizon") else None
    given.append(_named("env", env, _is_registered(env), lost))
    probes = settings["probes"]
    given.append("0" if probes == "none" else repr(probes))
    recorded = () if of_data else ("trainer", "episodes")
    told = (*recorded, "horizon", "seed") if env else (*recorded, "seed")
    plain = {name: settings.get(name) for name in told}
    if of_data:
        given.append(f"dataset={_named('dataset', f'sha256 {of_data}', False, lost)}")
    given += [f"{name}={value!r}" for name, value in plain.items() if value is not None]
    seen = settings.get("student_obs")
    if seen is not None:
        given.append(f"student_obs={seen!r}" if not isinstance(seen, str) else f"...  # {seen}")
    if settings.get("keep") not in (None, "all"):
        given.append(f"keep={settings['keep']!r}")
    if settings.get("spread"):
        given.append(f"spread={settings['spread']!r}")
    if history > 1:
        given.append(f"history={history}")
    given.append(f"evaluation_episodes={settings['evaluation_episodes']}")
    student = dict(settings["student"])
    if "architecture" not in student:
        hidden = tuple(student.get("hidden", ()))
        given.append(f"student=fdtasil.Mlp({hidden}, {student.get('activation')!r})")
    fit = settings["fit"]
    names = [name for name in fit if name in _FIT and fit[name] is not None]
    told = ", ".join(f"{name}={fit[name]}" for name in names)
    given.append(f"fit=fdtasil.Fit({told})")
    inside = ",\n".join(f"    {one}" for one in given)
    made = "".join([*lost, "\n"]) if lost else ""
    return f"import fdtasil\n\n{made}result = fdtasil.distill(\n{inside},\n)\n"


def _named(name: str, said: object, is_known: object, lost: list[str]) -> str:
    """Return an argument as it is written; of what no file holds, its name, which is then lost."""
    if said is None or is_known:
        return repr(said)
    lost.append(f"{name} = ...  # {in_one_line(str(said))}\n")
    return name


def _is_address(name: object) -> bool:
    return isinstance(name, str) and name.startswith(("http://", "https://", "hf://"))


def _is_registered(name: object) -> bool:
    """Whether gymnasium makes an environment of that name, once its module is imported."""
    return isinstance(name, str) and (":" in name or name in gymnasium.registry)
