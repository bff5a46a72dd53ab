"""The leaky rectified linear unit, `z = max(y, a y)` with `0 <= a < 1`.

`z = a y + (1 - a) max(y, 0)`, so what holds of `max(y, 0)` holds of `z - a y` up to the factor
`1 - a`: `z - a y >= 0`, `z - y >= 0`, their product is zero, and bounds of `y` cap both.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark
from reachjax.loops.units.relu import PRODUCTS, ZERO, ReLU, bent
from reachjax.numerics.checks import real_number
from reachjax.numerics.rounding import gamma, larger, namespace


@dataclasses.dataclass(frozen=True)
class LeakyReLU(AbstractUnit):
    """`max(y, slope y)`.

    Args:
        slope: where `y` is negative, at least 0 and below 1.

    Raises:
        TypeError: the slope is no number.
        ValueError: it is negative, or not below 1.

    Example:
        >>> import jax.numpy as jnp
        >>> LeakyReLU(0.1)(jnp.array([-1.0, 2.0])).tolist()
        [-0.1, 2.0]
    """

    slope: float = 0.01

    def __post_init__(self):
        slope = real_number("LeakyReLU.slope", self.slope, 0.0)
        if slope >= 1:
            raise ValueError(f"LeakyReLU.slope must be below 1, but {slope} arrived")
        object.__setattr__(self, "slope", slope)

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`max(y, slope y)`, with derivative 1 at 0."""
        return namespace(y).where(y >= 0, y, self.slope * y)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """A monotone function maps bounds to bounds; products are rounded outwards."""
        low, high = self(lower), self(upper)
        return low - gamma(1) * abs(low) * (lower < 0), high + gamma(1) * abs(high) * (upper < 0)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """`y` where `l >= 0`, else `a y` where `u <= 0`, else the chord above one of the two."""
        xp = namespace(lower, upper)
        below, above = ReLU().lines(lower, upper)
        switching = ~Lines(below, above).affine
        under = xp.where(below.slope == 1, 1.0, self.slope)
        slope = xp.where(switching, self.slope + (1 - self.slope) * above.slope, under)
        # what rounding of the slope may take away is given back by the offset: |y| <= u - l
        offset = (1 - self.slope) * above.offset + gamma(16) * (upper - lower)
        return Lines(
            below=Line(under, xp.zeros_like(under)),
            above=Line(slope, xp.where(switching, offset, 0.0)),
        )

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`(1 - slope) y` where `y >= 0` and `(a - slope) y` elsewhere: bent at 0."""
        return bent(self.slope, slope, lower, upper)

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """The two sides of the maximum and, from the bounds, how far `z` is above each."""
        output, slack = z - self.slope * y, z - y
        rise = (1 - self.slope) * (1 + gamma(4))
        blocks = (
            Block(output, "output", Mark.SECTOR),
            Block(slack, "slack", Mark.SECTOR),
            Block(rise * larger(upper, 0.0) - output, "output cap", Mark.BOUND),
            Block(rise * larger(-lower, 0.0) - slack, "slack cap", Mark.BOUND),
        )
        return Facts(blocks, ZERO, PRODUCTS)
