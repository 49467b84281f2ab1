"""Parts of an observation, as arguments say them by their names."""

from fdtasil.errors import SettingError
from fdtasil.rollouts.spaces import Layout

__all__ = ["columns_named"]


def columns_named(name: str, layout: Layout | None, found: str, example: str) -> tuple[int, ...]:
    """Return the columns of a part.

    Args:
        name: Of the part.
        layout: Of the observation; None where its parts have no names.
        found: What the argument says, for the error.
        example: What to write where there are no names.

    Raises:
        SettingError: If there is no such part.
    """
    try:
        return layout.columns(name) if layout else {}[name]
    except KeyError:
        known = ", ".join(layout.names) if layout else ""
        raise SettingError(
            found,
            f"names of parts of the observation: {known or 'it has none'}",
            "write these names, or indices" if known else example,
        ) from None
