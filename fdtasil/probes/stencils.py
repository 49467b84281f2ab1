"""How to difference along one direction."""

from dataclasses import dataclass

__all__ = ["CENTRAL", "EXACT", "FORWARD", "Stencil"]


@dataclass(frozen=True)
class Stencil:
    """How to difference along one direction: values at offsets, and their weights.

    Attributes:
        name: What to call it.
        offsets: Multiples of the step at which the function is asked, the centre apart.
        weights: Weight of the value at each offset in the first difference.
        centre: Weight of the value at the centre, which is known already.
        second: Weights of the values, and last that of the centre, in the second difference;
            None where the stencil has none.
        exact: Whether the derivative is analytic, and no value is asked at all.
    """

    name: str
    offsets: tuple[float, ...]
    weights: tuple[float, ...]
    centre: float
    second: tuple[float, ...] | None = None
    exact: bool = False


FORWARD = Stencil("forward", (1.0,), (1.0,), -1.0)
CENTRAL = Stencil("central", (1.0, -1.0), (0.5, -0.5), 0.0, (1.0, 1.0, -2.0))
EXACT = Stencil("exact", (), (), 0.0, exact=True)
