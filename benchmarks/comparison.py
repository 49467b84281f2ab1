"""Methods side by side: a picture of their scores, and both files of a benchmark."""

from collections.abc import Callable, Sequence

from benchmarks.grid import label
from benchmarks.panels import SHARE, draw_panels
from benchmarks.scores import TRAJECTORIES, Scores, scores_text

__all__ = ["draw_methods", "draw_scores"]

# Of the distance between two columns, what their methods stand in: joined by lines, or not.
_JOINED, _APART = 0.3, 0.8


def draw_methods(
    name: str,
    scores: Scores,
    methods: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    pictured: Sequence[str] | None = None,
) -> dict[str, bytes]:
    """Return picture and tables of methods that are called by their names; none without scores.

    Args:
        name: Of the files.
        scores: What is shown.
        methods: In which order.
        pairs: Whose differences are told.
        pictured: Methods that the picture has; None for all.
    """
    if not scores:
        return {}
    there = {method for group in scores.values() for method in group}
    methods = [method for method in methods if method in there]
    pairs = [pair for pair in pairs if {*pair} <= there]
    pictured = [method for method in pictured or methods if method in there]
    picture = draw_scores(scores, pictured, label)
    return {
        f"{name}.png": picture,
        f"{name}.md": scores_text(scores, methods, pairs).encode(),
    }


def draw_scores(
    scores: Scores,
    methods: Sequence[str],
    label: Callable[[str], str],
    across: str = TRAJECTORIES,
    score: str = SHARE,
) -> bytes:
    """Draw one panel an expert: score against column, a mark and an interval for each method.

    Args:
        scores: What is drawn.
        methods: In which order.
        label: A method -> what the legend calls it.
        across: What the columns are; empty where their names say it.
        score: What is drawn upwards.

    Returns:
        A PNG, readable in black and white.
    """
    # Numbers by size, names as they come.
    columns = dict.fromkeys(column for _, column in scores)
    columns = sorted(columns, key=lambda column: column if isinstance(column, int) else 0)

    def values(expert: str, number: int) -> dict[float, list[float]]:
        # Beside each other, so that equal methods can still be told apart.
        slot = (_JOINED if across else _APART) / len(methods)
        shift = (number - (len(methods) - 1) / 2) * slot
        return {
            place + shift: list(scores[expert, column][methods[number]].values())
            for place, column in enumerate(columns)
            if methods[number] in scores.get((expert, column), {})
        }

    curves = {
        expert: {label(method): values(expert, k) for k, method in enumerate(methods)}
        for expert in sorted({expert for expert, _ in scores})
    }
    return draw_panels(curves, across, score, [str(column) for column in columns])
