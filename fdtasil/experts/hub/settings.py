"""What the hub's own variables say: where it is, and how long it may take."""

import os

__all__ = ["endpoint", "patience"]

_PATIENCE = 6.0  # seconds without a sign of life after which the hub counts as out of reach


def patience() -> float:
    """Return the seconds to wait; huggingface_hub's variable for slow mirrors counts here too."""
    return max(0.0, float(os.environ.get("HF_HUB_DOWNLOAD_TIMEOUT") or _PATIENCE))


def endpoint() -> str:
    """Return the address of the hub, or of the mirror that the user has set."""
    from huggingface_hub import constants

    # The variable is read at the import of huggingface_hub as well, which may be long ago.
    return (os.environ.get("HF_ENDPOINT") or constants.ENDPOINT).rstrip("/")
