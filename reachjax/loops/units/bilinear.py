"""Products of two numbers, and sums of such products: units of two inputs.

On a box, with middles `c` and half widths `r` of both factors,

    a b  =  c_b a + c_a b - c_a c_b  +  (a - c_a) (b - c_b),    |(a - c_a) (b - c_b)| <= r_a r_b,

and the four products of distances from ends are the facts of McCormick (Computability of global
solutions to factorable nonconvex programs, Mathematical Programming 1976), such as

    (a - l_a) (b - l_b) = a b - l_b a - l_a b + l_a l_b >= 0.

Nothing here changes if one factor is scaled up by what the other one is scaled down.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from typing import Any

import numpy as np
from jaxtyping import Array

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark, Product
from reachjax.numerics.numbers import summed
from reachjax.numerics.rounding import TINY, constant, gamma, larger, namespace, smaller

CORNERS = ("least, least", "most, most"), ("least, most", "most, least")
"""Names of facts: those that bound products from below, and from above."""


@dataclasses.dataclass(frozen=True)
class Bilinear(AbstractUnit):
    """`z_i = sum_j a_ij b_ij`, of two vectors of factors.

    Args:
        terms: how many products each value is a sum of. Of `k` values the factors of their first
            products come first, `k` of them, then those of their second products, and so on.

    Example:
        >>> import numpy as np
        >>> Bilinear(2)(np.array([1.0, 2.0]), np.array([3.0, 5.0])).tolist()
        [13.0]
        >>> lower, upper = np.array([-1.0, 2.0]), np.array([1.0, 3.0])
        >>> [end.round(3).tolist() for end in Bilinear().interval(lower, upper)]
        [[-3.0], [3.0]]
    """

    terms: int = 1

    separable = False
    curved = True
    nonexpansive = False
    advice = "keep its factors bounded"

    def __call__(self, *y: Any) -> Any:
        """The value, for any kind of number that multiplies two of its own."""
        one, other = y
        return summed(one * other, self.terms)

    @property
    def inputs(self) -> int:  # type: ignore[override]
        """How many factors each value is made of."""
        return 2 * self.terms

    def halves(self, y: Any) -> tuple[Any, Any]:
        """The two vectors of factors, of one vector of both."""
        half = y.shape[-1] // 2
        return y[..., :half], y[..., half:]

    def derivative(self, y: Any) -> Any:
        """The derivative by each factor, which is the other one."""
        one, other = self.halves(y)
        return namespace(y).concatenate([other, one], axis=-1)

    @np.errstate(all="ignore")
    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The least and the largest product of ends."""
        xp = namespace(lower, upper)
        (low, least), (high, most) = self.halves(lower), self.halves(upper)
        corners = xp.stack([low * least, low * most, high * least, high * most])
        ends = functools.reduce(smaller, corners), functools.reduce(larger, corners)
        unknown = functools.reduce(operator.or_, xp.isnan(corners))
        size = functools.reduce(larger, abs(corners))
        error = gamma(self.terms) * size + self._flushed(lower, upper)
        error = constant(xp.where(unknown, math.inf, error))
        below, above = (summed(xp.where(unknown, 0.0, end), self.terms) for end in ends)
        error = summed(error, self.terms) * (1 + gamma(self.terms))
        return below - error, above + error

    @np.errstate(all="ignore")
    def lines(self, lower: Array, upper: Array) -> Lines:
        """Two planes of the slopes in the middle: never the same.

        Where bounds of a factor are not finite, they are infinitely far from each other.
        """
        slope, offset, gap = self.planes(lower, upper)
        xp, count = namespace(slope, gap), self.terms
        flushed = self._flushed(lower, upper)
        offset, size, gap, flushed = (
            summed(each, count) for each in (offset, abs(offset), gap, flushed)
        )
        known = gap < math.inf
        gap = gap + gamma(count + 4) * constant(size + gap) + flushed + TINY
        gap = gap * (1 + gamma(4))
        slope = xp.where(xp.concatenate([known] * self.inputs), slope, 0.0)
        offset, gap = xp.where(known, offset, 0.0), xp.where(known, gap, math.inf)
        return Lines(Line(slope, offset - gap), Line(slope, offset + gap))

    @np.errstate(all="ignore")
    def planes(self, lower: Array, upper: Array) -> tuple[Array, Array, Array]:
        """Slopes of all factors, and offsets and gaps of each product.

        A product is as far from its plane as the gap says, at most, if the offset is not rounded,
        which is a product of floats, and nothing is lost that is too small for these. Where bounds
        are not finite, gaps are infinite.
        """
        xp = namespace(lower, upper)
        known = (abs(lower) < math.inf) & (abs(upper) < math.inf)
        lower, upper = (xp.where(known, end, 0.0) for end in (lower, upper))
        middle = lower / 2 + upper / 2
        radius = larger(upper - middle, middle - lower) * (1 + gamma(2))
        (one, other), (near, far) = self.halves(middle), self.halves(radius)
        fixed, (known, also) = (near == 0) | (far == 0), self.halves(known)
        gap = xp.where(fixed, 0.0, near * far * (1 + gamma(2)) + TINY)
        offset = -(one * other)
        known = known & also & (gap < math.inf) & (abs(offset) < math.inf)
        slope = xp.where(xp.concatenate([known, known]), xp.concatenate([other, one]), 0.0)
        return slope, xp.where(known, offset, 0.0), xp.where(known, gap, math.inf)

    @np.errstate(all="ignore")
    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """Products of distances of the factors from their ends are not negative."""
        xp, half = namespace(lower, upper), lower.shape[-1] // 2
        one, other = y[:half], y[half:]
        known = (abs(lower) < math.inf) & (abs(upper) < math.inf)
        known = summed(xp.where(known, 0.0, 1.0), 2 * self.terms) == 0
        whole = xp.concatenate([known] * self.terms)
        (low, least), (high, most) = self.halves(lower), self.halves(upper)
        blocks = []
        pairs = ((low, least), (high, most)), ((low, most), (high, least))
        for names, corners, sign in zip(CORNERS, pairs, (1.0, -1.0), strict=True):
            for name, (a, b) in zip(names, corners, strict=True):
                a, b = (xp.where(whole, end, 0.0) for end in (a, b))
                plane = summed(b * one + a * other, self.terms)
                spare = gamma(self.terms + 4) * abs(a * b) + self._flushed(lower, upper)
                spare = xp.where(known, summed(spare, self.terms) + TINY, math.inf)
                row = sign * (z - plane) + (sign * summed(a * b, self.terms) + spare)
                blocks.append(Block(row, name, Mark.BOUND))
        below, above = CORNERS
        products = (Product(left, right, Mark.BOUND) for left in below for right in above)
        return Facts(tuple(blocks), (), tuple(products))

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """Its value on a tape of Taylor series: a product."""
        return tape.product(*y, terms=self.terms)

    def _flushed(self, lower: Array, upper: Array) -> Any:
        """What is lost of each product where it, or a factor, is too small for compiled code.

        On the host that keeps such factors nothing is, where one is known.
        """
        (one, other), xp = self.halves(larger(abs(lower), abs(upper))), namespace(lower, upper)
        lost = TINY * (1 + constant(one + other))
        return lost if xp is not np else np.where((one == 0) | (other == 0), 0.0, lost)
