"""The rectified linear unit, `z = max(y, 0)`.

It satisfies the paper's (relu::sector): `z >= 0`, `z - y >= 0` and `z (z - y) = 0`. When bounds
`l <= y <= u` are known, `z <= max(u, 0)` and `z - y <= max(-l, 0)` as well. The product of the two
differences is the triangle relaxation; `z_i (z_j - y_j) + z_j (z_i - y_i)` is lemma 1's restriction
of slopes between two of them.
"""

from __future__ import annotations

import dataclasses
from functools import reduce
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark, Product
from reachjax.numerics.rounding import gamma, larger, namespace, smaller

ZERO = (("output", "slack"),)
PRODUCTS = (
    Product("output", "slack", Mark.SLOPE),
    Product("output", "output cap", Mark.BOUND),
    Product("slack", "slack cap", Mark.BOUND),
    Product("output cap", "slack cap", Mark.BOUND),
)


def bent(
    leak: float, slope: Array, lower: Array, upper: Array
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Bounds of `max(y, leak y) - slope y` for inputs in `[lower, upper]`, rounded outwards.

    The function is bent at 0 alone, where it is 0, and zero all along where `slope` is its own.
    """
    right, left = 1.0 - slope, leak - slope
    ends = [right * larger(end, 0.0) + left * smaller(end, 0.0) for end in (lower, upper)]
    ends.append(namespace(lower).where((lower < 0) & (upper > 0), 0.0, ends[0]))
    low, high = reduce(smaller, ends), reduce(larger, ends)
    return low - gamma(4) * abs(low), high + gamma(4) * abs(high)


@dataclasses.dataclass(frozen=True)
class ReLU(AbstractUnit):
    """`max(y, 0)`.

    Example:
        >>> ReLU()(jax.numpy.array([-1.0, 2.0])).tolist()
        [0.0, 2.0]
    """

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`max(y, 0)`, with derivative 0 at 0."""
        on_host: Any = np.maximum  # of numpy, where nothing is compiled
        return on_host(y, 0.0) if namespace(y) is np else jax.nn.relu(y)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """A monotone function maps bounds to bounds."""
        xp = namespace(lower, upper)
        return xp.where(lower <= 0, 0.0, lower), xp.where(upper <= 0, 0.0, upper)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """`y` where `l >= 0`, else 0 where `u <= 0`, else the chord above `y` or above 0.

        Below, it is the one that leaves less out; any slope between 0 and 1 is sound there.
        """
        xp = namespace(lower, upper)
        active, inactive = lower >= 0, (upper <= 0) & (lower < 0)
        switching = ~(active | inactive)
        width = xp.where(switching, upper - lower, 1.0)
        # both rounded up: the chord stays above at its two ends
        slope = xp.where(switching, upper / width, 1.0 * active) * (1 + gamma(4) * switching)
        offset = xp.where(switching, -slope * lower * (1 + gamma(4)), 0.0)
        under = 1.0 * (active | (switching & (upper > -lower)))
        return Lines(below=Line(under, xp.zeros_like(under)), above=Line(slope, offset))

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`(1 - slope) y` where `y >= 0` and `-slope y` elsewhere: attained at ends and at 0."""
        return bent(0.0, slope, lower, upper)

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """Equation (relu::sector) and, from the bounds, the caps of `z` and of `z - y`."""
        slack = z - y
        blocks = (
            Block(z, "output", Mark.SECTOR),
            Block(slack, "slack", Mark.SECTOR),
            Block(larger(upper, 0.0) - z, "output cap", Mark.BOUND),
            Block(larger(-lower, 0.0) - slack, "slack cap", Mark.BOUND),
        )
        return Facts(blocks, ZERO, PRODUCTS)
