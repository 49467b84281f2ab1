"""Arguments that are looked at in one way everywhere."""

from numbers import Integral

from fdtasil.errors import SettingError


def check_count(name: str, value: int, least: int = 1) -> int:
    """Return `value`.

    Raises:
        SettingError: If it is not an integer of at least `least`.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        expected = "a positive integer" if least else "an integer of at least 0"
        raise SettingError(f"{name}={value!r}", expected, f"write {name}=5")
    return int(value)
