"""Functions that bend once and flatten, their inverses, and integrals of such.

The hyperbolic tangent, the logistic sigmoid made of it, and the integral of that; erf, arcsin,
arsinh, `y / |(1, y)|`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import AbstractActivation, AtUnit
from reachjax.loops.units.powers import Exp, Reciprocal, Sqrt, Square
from reachjax.loops.units.smooth import POLE, SLACK, SmoothUnit, farthest, nearest
from reachjax.numerics.rounding import TINY, larger, namespace, smaller


@dataclasses.dataclass(frozen=True)
class Tanh(SmoothUnit):
    """`tanh y`, whose derivative is `w = 1 - tanh^2 y`.

    Example:
        >>> import numpy as np
        >>> below, above = Tanh().lines(np.array([-1.0]), np.array([1.0]))
        >>> [part.round(3).tolist() for part in (above.slope, below.offset, above.offset)]
        [[0.762], [-0.082], [0.082]]
    """

    image = (-1.0, 1.0)
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `tanh y`."""
        return namespace(y).tanh(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`w = 4 e / (1 + e)^2` with `e = exp(-2 |y|)`, which loses no digits far out."""
        e = namespace(y).exp(-2 * abs(y))
        return 4 * e / ((1 + e) * (1 + e))

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 - z^2`."""
        return tape.affine(lambda square: 1.0 - square, tape.unit(Square(), z))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`w = s` where `sinh^2 y = (1 - s) / s`."""
        xp, slope = namespace(slope, lower), smaller(larger(slope, TINY), 1.0)
        point = xp.arcsinh(xp.sqrt((1 - slope) / slope))
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 2 w (2 - 3 w)`, extreme at the ends and at `w = 1/3`, where it is 2/3."""
        far, near = (self.derivative(reach(lower, upper)) for reach in (farthest, nearest))
        ends = larger(*(2 * w * abs(2 - 3 * w) + SLACK * 10 * w for w in (far, near)))
        top = namespace(lower, upper).where((far <= 1 / 3) & (near >= 1 / 3), 2 / 3, 0.0)
        return larger(ends, top) * (1 + SLACK) + TINY


@dataclasses.dataclass(frozen=True)
class Sigmoid(AbstractActivation):
    """The logistic sigmoid `1 / (1 + exp(-y))`, by one hyperbolic tangent.

    Example:
        >>> import numpy as np
        >>> Sigmoid()(np.array([-2.0, 0.0, 2.0])).round(3).tolist()
        [0.119, 0.5, 0.881]
    """

    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """`1/2 + tanh(y/2)/2`, with `unit` at the hyperbolic tangent."""
        return 0.5 + 0.5 * unit(Tanh(), 0.5 * y)


@dataclasses.dataclass(frozen=True)
class Softplus(SmoothUnit):
    """`log(1 + exp y)`, whose derivative is the logistic sigmoid `p`.

    Example:
        >>> import numpy as np
        >>> lower, upper = np.array([-1.0]), np.array([2.0])
        >>> [end.round(3).tolist() for end in Softplus().interval(lower, upper)]
        [[0.313], [2.127]]
    """

    image = (0.0, math.inf)
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`max(y, 0) + log(1 + exp(-|y|))`."""
        xp = namespace(y)
        return larger(y, 0.0) + xp.log1p(xp.exp(-abs(y)))

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`p = 1 / (1 + exp(-y))`, without overflow."""
        xp = namespace(y)
        e = xp.exp(-abs(y))
        return xp.where(y < 0, e, 1.0) / (1 + e)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The logistic function, as a hyperbolic tangent."""
        half = tape.unit(Tanh(), tape.affine(lambda number: 0.5 * number, y))
        return tape.affine(lambda number: 0.5 * number + 0.5, half)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`p = s` at `log(s / (1 - s))`."""
        xp, slope = namespace(slope, lower), smaller(larger(slope, TINY), 1.0)
        return (xp.log(slope) - xp.log1p(-slope),)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = p (1 - p) (1 - 2 p)`, extreme where `p (1 - p) = 1/6`, where it is `sqrt(3)/18`.

        Its size is the same at `-y`, so it is asked for at `|y|`.
        """
        xp, found = namespace(lower, upper), []
        near, far = nearest(lower, upper), farthest(lower, upper)
        for size in (near, far):
            e = xp.exp(-size)
            found.append(e * (1 - e + 4 * SLACK) / ((1 + e) * (1 + e) * (1 + e)))
        top, at = math.sqrt(3) / 18, math.log(2 + math.sqrt(3))
        inner = (near <= at * (1 + SLACK)) & (far >= at * (1 - SLACK))
        ends = larger(larger(*found), xp.where(inner, top, 0.0))
        return ends * (1 + SLACK) * (1 + 1e-12) + TINY


SLOPE = 2 / math.sqrt(math.pi)
"""The derivative of the error function at zero."""

SLOPE_REST = 1.5335459613165881e-17
"""What it is larger than this float."""

LARGE = 1e150
"""Squares of larger numbers overflow; the functions here are flat by then, or logarithms."""


def _largest(low: Array, high: Array, size, tops: tuple[tuple[float, float], ...]) -> Array:
    """The largest `size(y)` of the sizes `y` in `[low, high]`, whose inner maxima are known.

    Args:
        low: the least size.
        high: the largest size.
        size: a function of sizes.
        tops: where it has maxima inside, and what it is there.
    """
    found = larger(size(low), size(high))
    for at, top in tops:
        within = (low <= at * (1 + SLACK)) & (high >= at * (1 - SLACK))
        found = larger(found, namespace(low, high).where(within, top, 0.0))
    return found * (1 + SLACK) + TINY


@dataclasses.dataclass(frozen=True)
class Erf(SmoothUnit):
    """The error function `erf y`, of which the exact GELU is made.

    Example:
        >>> [end.round(3).tolist() for end in Erf().interval(np.array([-1.0]), np.array([2.0]))]
        [[-0.843], [0.995]]
    """

    nonexpansive = False
    image = (-1.0, 1.0)
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `erf y`."""
        if namespace(y) is np:
            from scipy.special import erf
        else:
            from jax.scipy.special import erf
        return erf(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`2 / sqrt(pi) exp(-y^2)`."""
        return SLOPE * namespace(y).exp(-y * y)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `2 / sqrt(pi) exp(-y^2)`, whose factor is not exact."""
        less = tape.affine(lambda square: -1.0 * square, tape.unit(Square(), y))
        return tape.affine(lambda bell: 2 / math.sqrt(math.pi) * bell, tape.unit(Exp(), less))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`2 / sqrt(pi) exp(-y^2) = s` where `y^2 = log(2 / (sqrt(pi) s))`."""
        xp, slope = namespace(slope, lower), smaller(larger(slope, TINY), SLOPE)
        under = larger((slope - SLOPE - SLOPE_REST) / SLOPE, -0.5)  # no digits cancel near zero
        square = xp.where(under > -0.5, -xp.log1p(under), xp.log(SLOPE / slope))
        point = xp.sqrt(larger(square, 0.0))
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 2 / sqrt(pi) (4 y^2 - 2) exp(-y^2)`, extreme at 0 and at `y^2 = 3/2`."""
        xp, ends = namespace(lower, upper), (nearest(lower, upper), farthest(lower, upper))
        low, high = (smaller(end, 100.0) for end in ends)

        def size(y: Array) -> Array:
            square = y * y
            # an exponential is off by what its argument is: by 1e-13 until it is zero
            return SLOPE * (abs(4 * square - 2) + 8 * SLACK) * xp.exp(-square) * (1 + 1e-12)

        return _largest(low, high, size, ((math.sqrt(1.5), SLOPE * 4 * math.exp(-1.5)),))


@dataclasses.dataclass(frozen=True)
class Asin(SmoothUnit):
    """`arcsin y` where `-1 <= y <= 1`.

    Example:
        >>> [end.round(3).tolist() for end in Asin().interval(np.array([-1.0]), np.array([0.5]))]
        [[-1.571], [0.524]]
    """

    nonexpansive = False
    image = (-1.5707963267948968, 1.5707963267948968)  # next to pi/2, outwards
    rises = True
    advice = (
        "keep them in [-1, 1], or clip them, jnp.clip(y, -1.0, 1.0), which is defined everywhere"
    )

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`arcsin y`, with derivative 0 at the ends, where it has none."""
        xp, edge = namespace(y), abs(y) == 1
        inner = xp.arcsin(xp.where(edge, 0.0, y))
        return xp.where(edge, xp.where(y > 0, math.pi / 2, -math.pi / 2), inner)

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where no input is larger than 1 in size."""
        return farthest(lower, upper) <= 1

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / sqrt(1 - y^2)`."""
        xp, rest = namespace(y), (1 - y) * (1 + y)
        return xp.where(rest <= 0, math.inf, 1 / xp.sqrt(xp.where(rest <= 0, 1.0, rest)))

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / sqrt(1 - y^2)`."""
        less = tape.affine(lambda square: 1.0 - square, tape.unit(Square(), y))
        return tape.unit(Reciprocal(), tape.unit(Sqrt(), less))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 / sqrt(1 - y^2) = s` where `y^2 = 1 - 1/s^2`."""
        slope = larger(slope, 1.0)
        point = namespace(slope, lower).sqrt((slope - 1) * (slope + 1)) / slope
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = (1 + 2 y^2) / (1 - y^2)^(5/2)`, which grows with the size of `y`."""
        xp, far = namespace(lower, upper), farthest(lower, upper)
        rest = (1 - far) * (1 + far)
        known = rest > POLE
        rest = xp.where(known, rest, 1.0)
        bound = (1 + 2 * far * far) / (rest * rest * xp.sqrt(rest))
        return xp.where(known, bound * (1 + SLACK) + TINY, math.inf)


@dataclasses.dataclass(frozen=True)
class Asinh(SmoothUnit):
    """The inverse hyperbolic sine, `log(y + sqrt(1 + y^2))`.

    Example:
        >>> [end.round(3).tolist() for end in Asinh().interval(np.array([-1.0]), np.array([2.0]))]
        [[-0.881], [1.444]]
    """

    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `arsinh y`."""
        return namespace(y).arcsinh(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / sqrt(1 + y^2)`; beyond 1e150, where squares overflow, as there."""
        size = smaller(abs(y), LARGE)
        return 1 / namespace(y).sqrt(1 + size * size)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / sqrt(1 + y^2)`."""
        return _inverse_length(tape, y)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 / sqrt(1 + y^2) = s` where `y^2 = 1/s^2 - 1`."""
        slope = smaller(larger(slope, TINY), 1.0)
        point = namespace(slope, lower).sqrt((1 - slope) * (1 + slope)) / slope
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = (2 y^2 - 1) / (1 + y^2)^(5/2)`, extreme at 0 and at `y^2 = 3/2`."""
        xp, ends = namespace(lower, upper), (nearest(lower, upper), farthest(lower, upper))
        low, high = (smaller(end, 1e60) for end in ends)

        def size(y: Array) -> Array:
            square = y * y
            more = 1 + square
            return (abs(2 * square - 1) + 4 * SLACK) / (more * more * xp.sqrt(more))

        return _largest(low, high, size, ((math.sqrt(1.5), 2 / 2.5**2.5),))


@dataclasses.dataclass(frozen=True)
class ISRU(SmoothUnit):
    """`y / sqrt(1 + y^2)`, the inverse square root unit: a number over its norm with another one.

    Source: Carlile, Delamarter, Kinney, Marti, Whitney, Improving deep learning by inverse square
    root linear units (2017).

    Example:
        >>> [end.round(3).tolist() for end in ISRU().interval(np.array([-1.0]), np.array([9.0]))]
        [[-0.707], [0.994]]
    """

    image = (-1.0, 1.0)
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`y / sqrt(1 + y^2)`."""
        y = smaller(larger(y, -LARGE), LARGE)
        return y / namespace(y).sqrt(1 + y * y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`(1 + y^2)^(-3/2)`."""
        size = smaller(abs(y), 1e100)
        more = 1 + size * size
        return 1 / (more * namespace(y).sqrt(more))

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / sqrt(1 + y^2)^3`."""
        inverse = _inverse_length(tape, y)
        return tape.product(tape.unit(Square(), inverse), inverse)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`(1 + y^2)^(-3/2) = s` where `y^2 = s^(-2/3) - 1`."""
        xp, slope = namespace(slope, lower), smaller(larger(slope, TINY), 1.0)
        point = xp.sqrt(xp.expm1(-2 / 3 * xp.log(slope)))  # no digits cancel near zero
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = (12 y^2 - 3) / (1 + y^2)^(7/2)`, extreme at 0 and at `y^2 = 3/4`."""
        xp, ends = namespace(lower, upper), (nearest(lower, upper), farthest(lower, upper))
        low, high = (smaller(end, 1e40) for end in ends)

        def size(y: Array) -> Array:
            square = y * y
            more = 1 + square
            return (abs(12 * square - 3) + 24 * SLACK) / (more * more * more * xp.sqrt(more))

        return _largest(low, high, size, ((math.sqrt(0.75), 6 / 1.75**3.5),))


def _inverse_length(tape: Any, y: int) -> int:
    """The number `1 / sqrt(1 + y^2)` on a tape."""
    more = tape.affine(lambda square: square + 1.0, tape.unit(Square(), y))
    return tape.unit(Reciprocal(), tape.unit(Sqrt(), more))
