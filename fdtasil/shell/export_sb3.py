"""`fdtasil export-sb3`: an agent of stable-baselines3 as one ONNX file."""

from pathlib import Path
from typing import Any

from fdtasil.experts.sb3.export import export_sb3
from fdtasil.shell.command import AgentPath, Flags, as_command

__all__ = ["command"]


def _export_sb3(**arguments: Any) -> None:
    print(f"written: {export_sb3(**arguments)}")


command = as_command(
    _export_sb3,
    [
        Flags(
            export_sb3,
            types={
                "agent_zip": AgentPath,
                "out": Path,
                "env": str | None,
                "vecnormalize": str | None,
                "action_low": float | None,
                "action_high": float | None,
            },
        )
    ],
    {},
)
