"""Exponential, natural logarithm, and `y log y`."""

from __future__ import annotations

import dataclasses
import math

from jaxtyping import Array, Bool, Float

from reachjax.loops.units.smooth import POLE, SLACK, SmoothUnit
from reachjax.numerics.rounding import TINY, larger, namespace, smaller


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

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`1 + log y = s` at `exp(s - 1)`."""
        return (namespace(slope, lower).exp(smaller(slope - 1, 700.0)),)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = -1 / y^2`, largest where `y` is smallest."""
        xp, known = namespace(lower, upper), lower > POLE
        y = xp.where(known, smaller(lower, 1 / POLE), 1.0)
        return xp.where(known, 1 / (y * y) * (1 + SLACK) + TINY, math.inf)
