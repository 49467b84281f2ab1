"""`fdtasil push`: a run on the Hugging Face hub."""

from typing import Annotated

import tyro

from fdtasil.results.push import left_over, look_up, open_hub, parcel_of, send
from fdtasil.shell.command import RunFolder

__all__ = ["command"]

Repository = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ORG/NAME")]


def command(
    run: RunFolder,
    repository: Repository,
    /,
    *,
    public: bool = False,
    demonstrations: bool = False,
) -> None:
    """Send a run's card, student, report and figures to the Hugging Face hub.

    What is sent is printed first. You must be logged in: `hf auth login`, or HF_TOKEN.

    Args:
        run: Folder of a finished run.
        repository: Of the hub; made if it is not there.
        public: Let everybody read it. Left out, the repository is private.
        demonstrations: Send the whole run: also its states, the expert's answers and its settings.
    """
    files = parcel_of(run, demonstrations=demonstrations)
    hub = open_hub(repository)
    there = look_up(hub, repository, public=public)
    print(f"to {repository}, {'which everybody may read' if public else 'private'}:")
    for name, data in sorted(files.items()):
        print(f"  {len(data):12,} bytes  {name}")
    for name in left_over(there, files):
        print(f"  {'removed':>18}  {name}, of an earlier push; the history keeps it")
    print(
        "The card and the report name your expert as you did, with its path; the card also what "
        "the environment was made with.",
        flush=True,
    )
    print(f"sent: {send(hub, repository, files, there, public=public)}")
