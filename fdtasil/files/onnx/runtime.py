"""onnxruntime, which is imported here only after its telemetry is off."""

import os
from types import ModuleType

__all__ = ["runtime"]

_OFF = "ORT_DISABLE_TELEMETRY"


def runtime() -> ModuleType:
    """Return onnxruntime, without its telemetry unless the user's own setting asks for it.

    It would write into the home folder, and look up a host of its maker. The variable is read
    when the library is loaded; child processes inherit it. onnxruntime's own
    `disable_telemetry_events` comes too late.
    """
    os.environ.setdefault(_OFF, "1")
    import onnxruntime

    return onnxruntime
