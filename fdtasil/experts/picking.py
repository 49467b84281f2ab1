"""One of several things that a function or a module returns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

__all__ = ["Picks", "PicksOutput", "pick"]


def pick(found: Any, output: str) -> Any:
    """Return a part of an answer: by its key, or by its number in a tuple.

    Raises:
        TypeError: If there is no such part.
    """
    if isinstance(found, Mapping):
        parts: dict[str, Any] = {str(key): value for key, value in found.items()}
    elif isinstance(found, tuple | list):
        parts = {str(number): value for number, value in enumerate(found)}
    else:
        raise TypeError(f"it returned a {type(found).__name__}, which has no part {output!r}")
    if output not in parts:
        raise TypeError(f"it returned {', '.join(parts)}, of which none is {output!r}")
    return parts[output]


@dataclass(frozen=True)
class Picks:
    """A function, of whose answer one part is taken.

    Attributes:
        answer: The function.
        output: Key or number of the part.
    """

    answer: Callable[[Any], Any]
    output: str

    def __call__(self, observations: Any) -> Any:
        """Answer with that part."""
        return pick(self.answer(observations), self.output)


class PicksOutput(nn.Module):
    """A module, of whose answer one part is taken.

    Args:
        module: The module.
        output: Key or number of the part.
    """

    def __init__(self, module: nn.Module, output: str) -> None:
        super().__init__()
        self.module, self.output = module, output

    def forward(self, observations: Any) -> Tensor:
        """(B, n) -> (B, m)."""
        return pick(self.module(observations), self.output)
