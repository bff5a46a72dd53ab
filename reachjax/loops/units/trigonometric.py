"""Sine, cosine and arctangent."""

from __future__ import annotations

import dataclasses
import math

from jaxtyping import Array, Bool, Float

from reachjax.loops.units.smooth import SLACK, SmoothUnit, farthest, nearest
from reachjax.numerics.rounding import TINY, gamma, larger, namespace, smaller

FAR = 1e5
"""Up to this size of arguments sines and cosines of numpy and of XLA were compared with exact ones,
near their zeros too. Beyond, they are numbers in `[-1, 1]`."""


class PeriodicUnit(SmoothUnit):
    """A unit of period `2 pi` with values in `[-1, 1]`."""

    image = (-1.0, 1.0)

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where arguments are not too large to be brought into one period."""
        return farthest(lower, upper) <= FAR

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """As of any smooth unit; of large arguments, those of numbers in `[-1, 1]`."""
        xp = namespace(slope, lower, upper)
        low, high = super().remainder(slope, lower, upper)
        far = ~self.defined(lower, upper) & super().defined(lower, upper)
        far = far & (abs(slope) < math.inf)
        slope, lower, upper = (xp.where(far, each, 0.0) for each in (slope, lower, upper))
        ends = slope * lower, slope * upper
        least, most = -1 - larger(*ends), 1 - smaller(*ends)
        least, most = least - gamma(4) * abs(least), most + gamma(4) * abs(most)
        return xp.where(far, least, low), xp.where(far, most, high)


def _met(angle: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """The first and the last of the points `angle + 2 pi k` in `[lower, upper]`.

    `f(y) - slope y` is linear along such points, so no other one is extreme.
    """
    xp, turn = namespace(angle, lower, upper), 2 * math.pi
    first, last = xp.ceil((lower - angle) / turn), xp.floor((upper - angle) / turn)
    return angle + turn * first, angle + turn * last


@dataclasses.dataclass(frozen=True)
class Sin(PeriodicUnit):
    """`sin y`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Sin().interval(np.array([1.0]), np.array([2.0]))]
        [[0.841], [1.0]]
    """

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`sin y`."""
        return namespace(y).sin(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`cos y`."""
        return namespace(y).cos(y)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`cos y = s` at `arccos s`, its negative, and a period apart from these."""
        angle = namespace(slope, lower).arccos(smaller(larger(slope, -1.0), 1.0))
        return *_met(angle, lower, upper), *_met(-angle, lower, upper)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`|f'''| = |cos|`."""
        low, high = Cos().interval(lower, upper)
        return larger(-low, high)


@dataclasses.dataclass(frozen=True)
class Cos(PeriodicUnit):
    """`cos y`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Cos().interval(np.array([-1.0]), np.array([2.0]))]
        [[-0.416], [1.0]]
    """

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`cos y`."""
        return namespace(y).cos(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`-sin y`."""
        return -namespace(y).sin(y)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`-sin y = s` at `-arcsin s`, at `pi + arcsin s`, and a period apart from these."""
        angle = namespace(slope, lower).arcsin(smaller(larger(slope, -1.0), 1.0))
        return *_met(-angle, lower, upper), *_met(math.pi + angle, lower, upper)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`|f'''| = |sin|`."""
        low, high = Sin().interval(lower, upper)
        return larger(-low, high)


@dataclasses.dataclass(frozen=True)
class Atan(SmoothUnit):
    """`arctan y`, whose derivative is `v = 1 / (1 + y^2)`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Atan().interval(np.array([-1.0]), np.array([2.0]))]
        [[-0.785], [1.107]]
    """

    image = (-1.5707963267948968, 1.5707963267948968)  # next to pi/2, outwards
    rises = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`arctan y`."""
        return namespace(y).arctan(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / (1 + y^2)`; beyond 1e150, where squares overflow, as there."""
        size = smaller(abs(y), 1e150)
        return 1 / (1 + size * size)

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`v = s` where `y^2 = (1 - s) / s`."""
        slope = smaller(larger(slope, TINY), 1.0)
        point = namespace(slope, lower).sqrt((1 - slope) / slope)
        return point, -point

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`f''' = v^2 (6 - 8 v)`, extreme at the ends and at `v = 1/2`, where it is 1/2."""
        far, near = (self.derivative(reach(lower, upper)) for reach in (farthest, nearest))
        ends = larger(*(v * v * (abs(6 - 8 * v) + SLACK * 14) for v in (far, near)))
        top = namespace(lower, upper).where((far <= 0.5) & (near >= 0.5), 0.5, 0.0)
        return larger(ends, top) * (1 + SLACK) + TINY
