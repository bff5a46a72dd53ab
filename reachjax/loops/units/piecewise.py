"""Units that are linear in pieces: rectified, leaky, clipped, and the hard hyperbolic tangent.

**Rectified**, `z = max(y, 0)`. It satisfies the paper's (relu::sector): `z >= 0`, `z - y >= 0` and
`z (z - y) = 0`. When bounds `l <= y <= u` are known, `z <= max(u, 0)` and `z - y <= max(-l, 0)` as
well. The product of the two differences is the triangle relaxation; `z_i (z_j - y_j) + z_j (z_i -
y_i)` is lemma 1's restriction of slopes between two of them.

**Leaky**, `z = max(y, a y)` with `0 <= a < 1`. `z = a y + (1 - a) max(y, 0)`, so what holds of
`max(y, 0)` holds of `z - a y` up to the factor `1 - a`: `z - a y >= 0`, `z - y >= 0`, their product
is zero, and bounds of `y` cap both.

**Clipped** to an interval: two layers of rectified units (the paper's (proj_NN)),
`v = max(y - lower, 0) + lower`, then `z = upper - max(upper - v, 0)`.
"""

from __future__ import annotations

import dataclasses
from functools import reduce
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units.base import (
    AbstractActivation,
    AbstractUnit,
    AtUnit,
    Block,
    Facts,
    Line,
    Lines,
    Mark,
    Product,
)
from reachjax.numerics.checks import real_number
from reachjax.numerics.rounding import TINY, gamma, larger, namespace, smaller

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
        half = 0.5 * upper  # the width itself may overflow
        width = xp.where(switching, half - 0.5 * lower, 1.0)
        # both rounded up: the chord stays above at its two ends
        slope = xp.where(switching, half / width, 1.0 * active) * (1 + gamma(4) * switching)
        lost = switching & ~(slope >= TINY)  # in floats: 0 and a constant are above as well
        offset = xp.where(switching, -slope * lower * (1 + gamma(4)), 0.0)
        slope, offset = xp.where(lost, 0.0, slope), xp.where(lost, upper + 2 * TINY, offset)
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


def clipped(y: Any, lower: Array | float, upper: Array | float, unit: AtUnit) -> Any:
    """`y` brought into `[lower, upper]`, for any kind of number.

    Args:
        y: `(k,)`.
        lower: `(k,)`, or one for all.
        upper: `(k,)`, or one for all.
        unit: what is done at a unit.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> clipped(jnp.array([-3.0, 0.5, 2.0]), -1.0, 1.0, evaluate).tolist()
        [-1.0, 0.5, 1.0]
    """
    v = unit(ReLU(), y - lower) + lower
    return upper - unit(ReLU(), upper - v)


@dataclasses.dataclass(frozen=True)
class HardTanh(AbstractActivation):
    """`y` clipped to `[-1, 1]`.

    Example:
        >>> import jax.numpy as jnp
        >>> HardTanh()(jnp.array([-3.0, 0.5, 2.0])).tolist()
        [-1.0, 0.5, 1.0]
    """

    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """The clipping, at whose units `unit` is done."""
        return clipped(y, -1.0, 1.0, unit)
