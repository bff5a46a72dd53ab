"""Square, square root, reciprocal, exponential, natural logarithm, and `y log y`.

And numbers that are known to be small, whatever bounds say of how they came about.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import Line, Lines
from reachjax.loops.units.smooth import POLE, SLACK, Quadratic, SmoothUnit, farthest, nearest
from reachjax.numerics.rounding import TINY, constant, gamma, larger, namespace, settled, smaller


@dataclasses.dataclass(frozen=True)
class Within(SmoothUnit):
    """`y` itself, which is known to be in `[least, most]`.

    A quotient of a number and its norm is, though a product of their bounds may be anything. Where
    bounds of `y` are wider than what is known, nothing else is kept of it.

    Example:
        >>> unit = Within(least=-1.0, most=1.0)
        >>> [end.round(3).tolist() for end in unit.interval(np.array([-9.0]), np.array([0.5]))]
        [[-1.0], [0.5]]
    """

    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The input `y` itself."""
        return y

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative one."""
        return namespace(y).ones_like(y)

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """The input on a tape."""
        return tape.same(self, *y, apply)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`f' = 1` everywhere: `f(y) - s y` is extreme at an end."""
        return ()

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 0`."""
        return namespace(lower, upper).zeros_like(lower)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """Two lines of slope 1, or two constants where these are nearer to each other."""
        kept = self._is_kept(lower, upper)
        slope = namespace(lower, upper).where(kept, 1.0, 0.0)
        low, high = self.remainder(slope, lower, upper)
        return Lines(below=Line(slope, low), above=Line(slope, high))

    @np.errstate(all="ignore")
    def quadratic(self, lower: Array, upper: Array, linear: Quadratic | None = None) -> Quadratic:
        """The lines, which bend nowhere."""
        return self.linear(lower, upper) if linear is None else linear

    def _is_kept(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where bounds of inputs say more than what is known of them."""
        return larger(upper, -lower) <= max(self.most, -self.least)


@dataclasses.dataclass(frozen=True)
class Square(SmoothUnit):
    """The square `y^2`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Square().interval(np.array([-1.0]), np.array([2.0]))]
        [[0.0], [4.0]]
    """

    nonexpansive = False
    image = (0.0, math.inf)

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `y^2`."""
        return y * y

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative `2 y`."""
        return 2 * y

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """A product with itself on a tape."""
        return tape.squared(self, *y, apply)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`2 y = s` at `s / 2`."""
        return (slope / 2,)

    def limits(self, least: Any, most: Any) -> tuple[Any, Any]:
        """Squares of the nearest and of the farthest number."""
        near, far = nearest(least, most), farthest(least, most)
        return near * near * (1 - gamma(1)), far * far * (1 + gamma(1)) + TINY

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 0`."""
        return namespace(lower, upper).zeros_like(lower)

    @np.errstate(all="ignore")
    def quadratic(self, lower: Array, upper: Array, linear: Quadratic | None = None) -> Quadratic:
        """`c^2 + 2 c (y - c) + (y - c)^2`, of which only `c^2` is rounded."""
        lower, upper = self.met(lower, upper)
        xp, center = namespace(lower, upper), settled(lower / 2 + upper / 2)
        offset = settled(center * center)
        gap = gamma(1) * constant(offset) + TINY
        known = self.defined(lower, upper) & (gap < math.inf)
        middle, offset, one = (xp.where(known, each, 0.0) for each in (center, offset, 1.0))
        return Quadratic(middle, offset, 2 * middle, one, xp.where(known, gap, math.inf))


@dataclasses.dataclass(frozen=True)
class Sqrt(SmoothUnit):
    """`sqrt y` where `y >= 0`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Sqrt().interval(np.array([0.0]), np.array([4.0]))]
        [[0.0], [2.0]]
    """

    nonexpansive = False
    image = (0.0, math.inf)
    rises = True
    advice = (
        "keep them away from negative numbers, or write jnp.sqrt(jnp.maximum(y, 0.0)), which "
        "is defined everywhere"
    )
    flushed = 2.0**-510  # roots of what compiled code takes for 0

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`sqrt y`, with derivative 0 at 0, where it has none."""
        xp = namespace(y)
        y = larger(y, 0.0) if self.least >= 0 else y  # rounding alone takes it below
        return xp.where(y == 0, 0.0, xp.sqrt(xp.where(y == 0, 1.0, y)))

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where no input is negative."""
        return (lower >= 0) & (upper < math.inf)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / (2 sqrt y)`."""
        xp = namespace(y)
        return xp.where(y == 0, math.inf, 0.5 / xp.sqrt(xp.where(y == 0, 1.0, y)))

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / (2 z)`."""
        return tape.affine(lambda number: 0.5 * number, tape.unit(Reciprocal(), z))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 / (2 sqrt y) = s` at `1 / (2 s)^2`."""
        root = 0.5 / slope
        return (root * root,)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 3/8 y^(-5/2)`, which decreases."""
        xp, known = namespace(lower, upper), lower > POLE
        y = xp.where(known, smaller(lower, 1 / POLE), 1.0)
        return xp.where(known, 0.375 / (y * y * xp.sqrt(y)) * (1 + SLACK) + TINY, math.inf)


@dataclasses.dataclass(frozen=True)
class Reciprocal(SmoothUnit):
    """`1 / y`, on intervals on either side of 0.

    Example:
        >>> import numpy as np
        >>> lower, upper = np.array([-2.0, -1.0]), np.array([-1.0, 1.0])
        >>> [end.round(3).tolist() for end in Reciprocal().interval(lower, upper)]
        [[-1.0, -inf], [-0.5, inf]]
    """

    nonexpansive = False
    advice = (
        "keep them away from zero (an angle of y / x is jnp.arctan2(y, x), which crosses x = 0)"
    )

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / y`."""
        return 1 / y

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where all inputs are positive, or all are negative."""
        return (nearest(lower, upper) >= TINY) & super().defined(lower, upper)

    def limits(self, least: Any, most: Any) -> tuple[Any, Any]:
        """Inverses of the ends, where all inputs are positive, or all are negative."""
        right, left = (least >= 0) & (most > 0), (most <= 0) & (least < 0)
        low = np.where(right | (left & (most < 0)), 1 / most, -math.inf)
        high = np.where(left | (right & (least > 0)), 1 / least, math.inf)
        return low - gamma(1) * abs(low), high + gamma(1) * abs(high)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`-1 / y^2`."""
        return -1 / (y * y)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `-z^2`."""
        return tape.affine(lambda number: -1.0 * number, tape.unit(Square(), z))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`-1 / y^2 = s` at `1 / sqrt(-s)` and its negative."""
        point = 1 / namespace(slope, lower).sqrt(larger(-slope, TINY))
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`|f'''| = 6 / y^4`, largest where `|y|` is smallest."""
        xp, size = namespace(lower, upper), nearest(lower, upper)
        known = size > POLE
        y = xp.where(known, smaller(size, 1 / POLE), 1.0)
        return xp.where(known, 6 / (y * y * y * y) * (1 + SLACK) + TINY, math.inf)


@dataclasses.dataclass(frozen=True)
class Exp(SmoothUnit):
    """The exponential `exp y`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Exp().interval(np.array([0.0]), np.array([1.0]))]
        [[1.0], [2.718]]
    """

    nonexpansive = False
    image = (0.0, math.inf)
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `exp y`."""
        return namespace(y).exp(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative `exp y`."""
        return self(y)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `z`."""
        return z

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`exp y = s` at `log s`."""
        return (namespace(slope, lower).log(larger(slope, TINY)),)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = exp y`, which increases."""
        return self(upper) * (1 + SLACK) + TINY


@dataclasses.dataclass(frozen=True)
class Log(SmoothUnit):
    """`log y` where `y > 0`.

    Example:
        >>> import numpy as np
        >>> lower, upper = np.array([2.0, -1.0]), np.array([4.0, 4.0])
        >>> [end.round(3).tolist() for end in Log().interval(lower, upper)]
        [[0.693, -inf], [1.386, inf]]
    """

    nonexpansive = False
    rises = True
    advice = "keep them above zero, where a logarithm is minus infinity"

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `log y`."""
        return namespace(y).log(y)

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where inputs are positive, and compiled code tells them from 0."""
        return (lower >= TINY) & (upper < math.inf)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / y`."""
        return 1 / y

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / y`."""
        return tape.unit(Reciprocal(), y)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 / y = s` at `1 / s`."""
        return (1 / slope,)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = 2 / y^3`, which decreases."""
        xp, known = namespace(lower, upper), lower > POLE
        y = xp.where(known, smaller(lower, 1 / POLE), 1.0)
        return xp.where(known, 2 / (y * y * y) * (1 + SLACK) + TINY, math.inf)


@dataclasses.dataclass(frozen=True)
class XLogX(SmoothUnit):
    """`y log y` where `y >= 0`, with 0 at 0: an entropy, but for its sign.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in XLogX().interval(np.array([0.0]), np.array([1.0]))]
        [[-0.368], [0.0]]
    """

    nonexpansive = False
    image = (-0.36787944117144245, math.inf)  # next to -1/e, outwards
    advice = "keep them away from negative numbers"

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`y log y`, with derivative 0 at 0, where it has none."""
        xp = namespace(y)
        y = larger(y, 0.0) if self.least >= 0 else y  # rounding alone takes it below
        return xp.where(y == 0, 0.0, y * xp.log(xp.where(y == 0, 1.0, y)))

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where no input is negative."""
        return (lower >= 0) & (upper < math.inf)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 + log y`."""
        return 1 + namespace(y).log(y)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 + log y`."""
        return tape.affine(lambda number: number + 1.0, tape.unit(Log(), y))

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 + log y = s` at `exp(s - 1)`."""
        return (namespace(slope, lower).exp(smaller(slope - 1, 700.0)),)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = -1 / y^2`, largest where `y` is smallest."""
        xp, known = namespace(lower, upper), lower > POLE
        y = xp.where(known, smaller(lower, 1 / POLE), 1.0)
        return xp.where(known, 1 / (y * y) * (1 + SLACK) + TINY, math.inf)
