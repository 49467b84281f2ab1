"""What trust is: the word "pickle", and nothing else that may pass for it."""

from typing import Literal

from fdtasil.errors import SettingError

Trust = Literal["pickle", "c"] | None


def check_trust(trust: Trust) -> None:
    """Refuse anything but the word itself, so that no truthy value is taken for trust.

    Raises:
        SettingError: If it is something else.
    """
    if trust not in (None, "pickle"):
        raise SettingError(f"trust={trust!r}", '"pickle" or None', 'write trust="pickle"')


TRUST = (
    'if you trust its source, write load_expert(path, trust="pickle") (--trust pickle in a '
    "shell): that runs the code in the zip"
)
ITSELF = "load it with its own library, and pass the agent itself: distill(agent, env)"
