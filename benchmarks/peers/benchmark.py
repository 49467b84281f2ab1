"""The peers as one benchmark: what runs, and what is drawn."""

import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.peers import cloning, control, step
from benchmarks.peers.environment import PeerMissing, check_peer
from benchmarks.runner import Cell, Row

__all__ = ["cells", "draw", "run"]

KINDS = {"step": step, "control": control, "cloning": cloning}


def cells(quick: bool) -> list[Cell]:
    """The cells of the peers that are here, seed by seed; the others are left out aloud."""
    found = [cell for kind in KINDS.values() if _is_here(kind.PEER) for cell in kind.cells(quick)]
    return sorted(found, key=lambda cell: cell["seed"])


def _is_here(peer: str) -> bool:
    try:
        check_peer(peer)
    except PeerMissing as error:
        print(f"left out: {error}", file=sys.stderr)
        return False
    return True


def run(cell: Cell, device: str) -> dict[str, Any]:
    """Run a cell, on one thread of the processor whatever the device."""
    return KINDS[cell["what"]].run(cell)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """One table a kind, of those that have rows."""
    parts = []
    for what, kind in KINDS.items():
        mine = [row for row in rows if row["cell"]["what"] == what]
        if mine:
            parts.append(f"{(kind.__doc__ or '').strip()}\n\n{kind.text(mine)}")
    return {"peers.md": "\n".join(parts).encode()}
