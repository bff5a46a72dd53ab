"""The hyperbolic tangent, the logistic sigmoid made of it, and the integral of that."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from jaxtyping import Array, Float

from reachjax.loops.units.base import AbstractActivation, AtUnit
from reachjax.loops.units.smooth import SLACK, SmoothUnit, farthest, nearest
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
