"""What a run comes to, as rows of a table: the model card and the page are made of them."""

import ast
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import gymnasium

from fdtasil.demonstrations.trainers import TRAINERS
from fdtasil.errors import in_one_line, shown
from fdtasil.experts.expert import rows_text
from fdtasil.experts.http_expert import is_http_url
from fdtasil.experts.hub import is_hub_uri
from fdtasil.results.size import size_text
from fdtasil.student.fit import Fit

__all__ = ["call_of", "run_rows"]

_FIT = {field.name for field in fields(Fit)}
_SHARES = re.compile(r"beta=(\[[^]]*\])")

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
        ("training", f"{report['steps']:,} steps"),
        ("seconds", f"{report['train_seconds']:,.0f}, recording and queries included"),
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
    named, and left to the reader.

    Args:
        settings: Of the run's configuration.
        history: How many observations the student sees.
    """
    lost = _in_no_file(settings)
    expert, env, data = settings["expert"], _environment(settings), settings.get("dataset")
    place = _made_anew(settings) or repr(env)
    given = ["expert" if "expert" in lost else repr(expert), "env" if "env" in lost else place]
    probes = settings["probes"]
    given.append("0" if probes == "none" else repr(probes))
    recorded = () if data else ("trainer", "episodes")
    told = (*recorded, "horizon", "seed") if env else (*recorded, "seed")
    plain = {name: repr(settings[name]) for name in told if settings.get(name) is not None}
    if "trainer" in plain:
        plain["trainer"] = _trainer(settings["trainer"])
    if data:
        given.append("dataset=dataset")
    given += [f"{name}={value}" for name, value in plain.items()]
    seen = settings.get("student_obs")
    if seen is not None and history == 1:  # with a history, the expert's memory alone is unseen
        given.append(f"student_obs={'student_obs' if 'student_obs' in lost else repr(seen)}")
    if settings.get("keep") not in (None, "all"):
        given.append(f"keep={settings['keep']!r}")
    of_the_dataset = data and not env and "bounds" in (settings.get("spread") or {})
    if settings.get("spread") and not of_the_dataset:
        given.append(f"spread={_spread(settings['spread'])!r}")
    if history > 1 or data:  # left out, it is what the dataset shows
        given.append(f"history={history}")
    given.append(f"evaluation_episodes={settings['evaluation_episodes']}")
    if settings.get("force"):
        given.append("force=True")
    student = dict(settings["student"])
    if "architecture" not in student:
        hidden = tuple(student.get("hidden", ()))
        given.append(f"student=fdtasil.Mlp({hidden}, {student.get('activation')!r})")
    fit = settings["fit"]
    # A length that was left out grows with the states, which are there again.
    grown = {"steps"} if fit.get("steps_for") is not None else set()
    names = [name for name in fit if name in _FIT - grown and fit[name] is not None]
    told = ", ".join(f"{name}={fit[name]}" for name in names)
    given.append(f"fit=fdtasil.Fit({told})")
    inside = ",\n".join(f"    {one}" for one in given)
    made = [f"{name} = ...  # {in_one_line(said)}\n" for name, said in lost.items()]
    first = "".join([*made, "\n"]) if made else ""
    return f"import fdtasil\n\n{first}result = fdtasil.distill(\n{inside},\n)\n"


def _made_anew(settings: Mapping[str, Any]) -> str | None:
    """Return the code of an environment of a module, or with options.

    None of another, or whose words are none.
    """
    name = _environment(settings)
    if settings.get("made") is None or name is None:
        return None
    try:
        call = ast.parse(f"dict({settings['made']})", mode="eval").body
        words = call.keywords if isinstance(call, ast.Call) and not call.args else []
        told = {str(one.arg): ast.literal_eval(one.value) for one in words}
    except (SyntaxError, ValueError):
        return None
    if not told or not told.keys() <= {"module", "kwargs", "reset_options"}:
        return None
    if module := told.pop("module", None):
        name = f"{module}:{name}"
    if not told:
        return repr(name)
    options = ", ".join(f"{name}={value!r}" for name, value in told.items())
    return f"fdtasil.Environment({name!r}, {options})"


def _trainer(described: str) -> str:
    """Return the code of a trainer; its name, where it has the usual settings."""
    name, odd, settings = described.partition(",")
    if not odd or name not in TRAINERS:
        return repr(described)
    made_by = getattr(TRAINERS[name], "__name__", name)
    shares = r"beta=lambda round_: \1[round_ - 1]"  # of a function, what it said of each round
    return f"fdtasil.{made_by}({_SHARES.sub(shares, settings)})"


def _spread(written: Mapping[str, Any]) -> dict[int, float] | str:
    """Return the argument `spread` as it was given, of what JSON made of it."""
    if "bounds" in written:
        return "bounds"
    return {int(column): deviation for column, deviation in written.items()}


def _environment(settings: Mapping[str, Any]) -> str | None:
    return settings["env"] if settings.get("horizon") else None


def _in_no_file(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the arguments that a reader has to make again, by name, with what they were."""
    env, data = _environment(settings), settings.get("dataset")
    seen = settings.get("student_obs")
    found = {
        "expert": _expert_in_words(settings),
        "env": None if _made_anew(settings) else _environment_in_words(env, settings.get("made")),
        "dataset": data and f"sha256 {data}",
        "student_obs": seen if isinstance(seen, str) else None,  # a function
    }
    return {name: said for name, said in found.items() if said is not None}


def _expert_in_words(settings: Mapping[str, Any]) -> str | None:
    """Return what an expert is; None where its file or address alone tells."""
    name = settings["expert"]
    if settings.get("opened"):
        return f"{name}, opened with {settings['opened']}"
    known = settings.get("expert_sha256") or is_http_url(name) or is_hub_uri(name)
    return None if known else settings["expert"]


def _environment_in_words(name: str | None, made: str | None) -> str | None:
    """Return what an environment is; None where gymnasium makes it of its name alone."""
    if made is not None:
        return f"{name}, {made}"
    return None if _is_id(name) else name


def _is_id(name: str | None) -> bool:
    # "module:Id" is registered once the module is imported.
    return name is not None and (":" in name or name in gymnasium.registry)
