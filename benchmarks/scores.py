"""Scores of methods by expert and column, and the tables that several benchmarks share."""

from collections.abc import Mapping, Sequence

from benchmarks.runner import Row
from benchmarks.statistics import (
    DIFFERENCES_NOTE,
    SCORES_NOTE,
    difference_column,
    interval_text,
    paired_difference,
)
from benchmarks.tables import table

__all__ = [
    "TRAJECTORIES",
    "Column",
    "Scores",
    "by_demonstrations",
    "differences_table",
    "scores_of",
    "scores_table",
    "scores_text",
]

Column = int | str
"""Where a score stands across a figure: a number of trajectories, or the name of a condition."""
Scores = Mapping[tuple[str, Column], Mapping[str, Mapping[int, float]]]
"""(expert, column) -> method -> seed -> score; of complete groups only."""
TRAJECTORIES = "trajectories"


def scores_of(rows: Sequence[Row], methods: Sequence[str], seeds: int) -> Scores:
    """Sort the rows' scores into groups, and leave out those with a method or seed missing.

    Args:
        rows: With `expert`, `method`, `seed` and `episodes` in their cells, `normalized_return`
            in their results.
        methods: Which a group must have; others that are complete stay in it.
        seeds: How many of each.
    """
    found: dict[tuple[str, Column], dict[str, dict[int, float]]] = {}
    for row in rows:
        cell = row["cell"]
        group = found.setdefault((cell["expert"], cell["episodes"]), {})
        of_method = group.setdefault(cell["method"], {})
        of_method[cell["seed"]] = row["result"]["normalized_return"]
    complete = {
        key: {method: of for method, of in group.items() if len(of) >= seeds}
        for key, group in sorted(found.items(), key=lambda item: item[0])
    }
    return {key: group for key, group in complete.items() if {*methods} <= group.keys()}


def scores_table(scores: Scores, methods: Sequence[str], across: str = TRAJECTORIES) -> str:
    """Return a table of interquartile means with their 95 % intervals, one line a group."""
    rows = (
        [
            expert,
            str(column),
            *(interval_text(list(group[m].values())) if m in group else "-" for m in methods),
        ]
        for (expert, column), group in scores.items()
    )
    return table(["expert", across, *methods], rows)


def differences_table(
    scores: Scores, pairs: Sequence[tuple[str, str]], across: str = TRAJECTORIES
) -> str:
    """Return a table of mean differences on equal seeds, ours - theirs, with 95 % intervals."""
    columns = [
        difference_column(
            [
                paired_difference(group[ours], group[theirs])
                if {ours, theirs} <= group.keys()
                else None
                for group in scores.values()
            ]
        )
        for ours, theirs in pairs
    ]
    rows = [
        [expert, str(column), *(cells[line] for cells, _ in columns)]
        for line, (expert, column) in enumerate(scores)
    ]
    rows.append(["intervals", "", *(counted for _, counted in columns)])
    return table(["expert", across, *(f"{ours} - {theirs}" for ours, theirs in pairs)], rows)


def scores_text(
    scores: Scores,
    methods: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    across: str = TRAJECTORIES,
) -> str:
    """Return the table of the methods, and that of the pairs' differences."""
    differences = differences_table(scores, pairs, across)
    table_of_scores = scores_table(scores, methods, across)
    return f"{SCORES_NOTE}\n{table_of_scores}\n{DIFFERENCES_NOTE}\n{differences}"


def by_demonstrations(rows: Sequence[Row], budgets: Sequence[int], methods: Sequence[str]) -> str:
    """Return a table of one expert: demonstrations down, methods across; of complete lines."""
    lines = []
    for budget in budgets:
        found = [
            [
                row["result"]["normalized_return"]
                for row in rows
                if (row["cell"]["episodes"], row["cell"]["method"]) == (budget, method)
            ]
            for method in methods
        ]
        if all(len(scores) > 1 for scores in found):
            lines.append([str(budget), *map(interval_text, found)])
    return f"{SCORES_NOTE}\n{table(['demonstrations', *methods], lines)}"
