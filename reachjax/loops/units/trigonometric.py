"""Sine, cosine, `sin y / y` and arctangent."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.powers import Reciprocal, Square
from reachjax.loops.units.smooth import SLACK, SmoothUnit, farthest, nearest
from reachjax.numerics.rounding import (
    TINY,
    constant,
    errors,
    gamma,
    is_counted,
    larger,
    namespace,
    select,
    smaller,
)

FAR = 1e5
"""Up to this size of arguments sines and cosines of numpy and of XLA were compared with exact ones,
near their zeros too. Beyond, they are numbers in `[-1, 1]`."""


class WaveUnit(SmoothUnit):
    """A unit that goes up and down without end, between the two ends of its `image`.

    Attributes:
        far: the largest size of arguments of which more is known than that.
        crest: an argument at which it is 1, and half a turn from which it is -1; None of others.
    """

    far: ClassVar[float] = FAR
    crest: ClassVar[float | None] = None

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where arguments are not too large."""
        if self.crest is not None and not is_counted():  # rounding alone sets that limit
            return super().defined(lower, upper)
        return farthest(lower, upper) <= self.far

    def _plain_interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        if self.crest is None:
            return super()._plain_interval(lower, upper)
        first, last = self(lower), self(upper)
        high, low = (_meets(self.crest + away, lower, upper) for away in (0.0, math.pi))
        least = select(low, -1.0, smaller(first, last))
        return least, select(high, 1.0, larger(first, last))

    def extent(self, lower: Array, upper: Array) -> tuple[Any, Any]:
        """Bounds of the value for arguments of any size."""
        return self.image

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Ends of `f(y) - slope y`; of large arguments, those of numbers in its extent."""
        xp = namespace(slope, lower, upper)
        low, high = super().remainder(slope, lower, upper)
        if self.crest is not None and not is_counted():
            return low, high
        far = ~self.defined(lower, upper) & super().defined(lower, upper)
        far = far & (abs(slope) < math.inf)
        if xp is np and not far.any():
            return low, high
        slope, lower, upper = (select(far, each, 0.0) for each in (slope, lower, upper))
        ends, (least, most) = (slope * lower, slope * upper), self.extent(lower, upper)
        least, most = least - larger(*ends), most - smaller(*ends)
        # slopes may be too small for floats
        flushed = errors(lambda: TINY * (1 + farthest(lower, upper)) + gamma(4) * farthest(*ends))
        least, most = least - gamma(4) * abs(least), most + gamma(4) * abs(most)
        least, most = least - flushed, most + flushed
        return select(far, least, low), select(far, most, high)


def _meets(angle: float, lower: Array, upper: Array) -> Array:
    """Whether a point `angle + 2 pi k` is in `[lower, upper]`; in JAX, without derivatives."""
    lower, turn = constant(lower), 2 * math.pi
    return angle + turn * jnp.ceil((lower - angle) / turn) <= upper


def _met(angle: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """The first and the last of the points `angle + 2 pi k` in `[lower, upper]`.

    `f(y) - slope y` is linear along such points, so no other one is extreme.
    """
    xp, turn = namespace(angle, lower, upper), 2 * math.pi
    first, last = xp.ceil((lower - angle) / turn), xp.floor((upper - angle) / turn)
    return angle + turn * first, angle + turn * last


@dataclasses.dataclass(frozen=True)
class Sin(WaveUnit):
    """The sine `sin y`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Sin().interval(np.array([1.0]), np.array([2.0]))]
        [[0.841], [1.0]]
    """

    image = (-1.0, 1.0)
    crest = math.pi / 2

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `sin y`."""
        return namespace(y).sin(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative `cos y`."""
        return namespace(y).cos(y)

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """The first part of a wave on a tape."""
        return tape.wave(*y)[0]

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`cos y = s` at `arccos s`, its negative, and a period apart from these."""
        angle = namespace(slope, lower).arccos(smaller(larger(slope, -1.0), 1.0))
        return *_met(angle, lower, upper), *_met(-angle, lower, upper)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`|f'''| = |cos|`."""
        low, high = Cos().interval(lower, upper)
        return larger(-low, high)


@dataclasses.dataclass(frozen=True)
class Cos(WaveUnit):
    """The cosine `cos y`.

    Example:
        >>> import numpy as np
        >>> [end.round(3).tolist() for end in Cos().interval(np.array([-1.0]), np.array([2.0]))]
        [[-0.416], [1.0]]
    """

    image = (-1.0, 1.0)
    crest = 0.0

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `cos y`."""
        return namespace(y).cos(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative `-sin y`."""
        return -namespace(y).sin(y)

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """The second part of a wave on a tape."""
        return tape.wave(*y)[1]

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """`-sin y = s` at `-arcsin s`, at `pi + arcsin s`, and a period apart from these."""
        angle = namespace(slope, lower).arcsin(smaller(larger(slope, -1.0), 1.0))
        return *_met(-angle, lower, upper), *_met(math.pi + angle, lower, upper)

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """`|f'''| = |sin|`."""
        low, high = Sin().interval(lower, upper)
        return larger(-low, high)


def _bends(periods: int) -> np.ndarray:
    """The ends of the pieces of `[0, 2 pi periods]` on which `(sin y / y)'` falls and rises.

    They are the zeros of the second derivative, one between each two multiples of `pi`, where its
    sign is that of `(-1)^(k + 1)`.
    """
    low = math.pi * np.arange(2 * periods)
    high, sign = low + math.pi, (-1.0) ** np.arange(2 * periods)
    for _ in range(60):
        y = low / 2 + high / 2
        before = sign * (2 * (np.sin(y) - y * np.cos(y)) - y * y * np.sin(y)) < 0
        low, high = np.where(before, y, low), np.where(before, high, y)
    return np.array([0.0, *low, 2 * math.pi * periods])


BENDS = _bends(4)
STEPS = 30
"""Halvings of a piece, which leave a billionth of it."""

SERIES = tuple(np.array([(-1.0) ** k / math.factorial(2 * k + 1) for k in range(11)]))
"""`sin y / y` in powers of `y^2`; for `|y| <= 1` the rest is less than 1e-22."""


def _series(y: Array, order: int) -> Array:
    """An odd derivative of `sin y / y`, for `|y| <= 1`."""
    found, square = 0.0, y * y
    for k in reversed(range((order + 1) // 2, len(SERIES))):
        found = SERIES[k] * math.perm(2 * k, order) + square * found
    return y * found


@dataclasses.dataclass(frozen=True)
class Sinc(WaveUnit):
    """`sin y / y`, and 1 at 0: the mean of `cos(t y)` over `t` from 0 to 1.

    So its third derivative has no size over 1/4, nor its fourth over 1/5. `jnp.sinc(x)` is that of
    `y = pi x`.

    Example:
        >>> [end.round(3).tolist() for end in Sinc().interval(np.array([-1.0]), np.array([5.0]))]
        [[-0.217], [1.0]]
    """

    image = (-0.2172336282112217, 1.0)
    far = float(BENDS[-1])

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`sin y / y`."""
        xp = namespace(y)
        some = xp.where(y == 0, 1.0, y)
        return xp.where(y == 0, 1.0, xp.sin(some) / some)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`(cos y - sin y / y) / y`."""
        xp, near = namespace(y), abs(y) <= 1
        some = xp.where(near, 2.0, y)
        far = (xp.cos(some) - self(some)) / some
        return xp.where(near, _series(xp.where(near, y, 0.0), 1), far)

    def extent(self, lower: Array, upper: Array) -> tuple[Any, Any]:
        """Sizes are `1 / |y|` at most."""
        most = (1 + SLACK) / larger(nearest(lower, upper), 1.0)
        return larger(-most, self.image[0]), smaller(most, self.image[1])

    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """Where the derivative is the slope, by halves of each piece on which it is monotone.

        It is odd, so that those of negative `y` are those of the opposite slope.
        """
        xp = namespace(slope, lower, upper)
        sought = xp.stack([slope, -slope])[:, None]
        shape = (2, len(BENDS) - 1, *slope.shape)
        ends = BENDS.reshape(-1, *np.ones(slope.ndim, int))
        low, high = (xp.broadcast_to(each, shape) for each in (ends[:-1], ends[1:]))
        sign = (-1.0) ** np.arange(len(BENDS) - 1).reshape(-1, *np.ones(slope.ndim, int))

        def halved(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            y = low / 2 + high / 2
            before = sign * (self.derivative(y) - sought) > 0
            return xp.where(before, y, low), xp.where(before, high, y)

        if xp is np:
            for step in range(STEPS):
                low, high = halved(step, (low, high))
        else:
            low, high = jax.lax.fori_loop(0, STEPS, halved, (low, high))
        right, left = low / 2 + high / 2
        return *right, *-left

    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """What it is in the middle, and by how much the fourth can take it from there."""
        xp, y = namespace(lower, upper), lower / 2 + upper / 2
        near = abs(y) <= 1
        some = xp.where(near, 2.0, y)
        second = -self(some) - 2 * self.derivative(some) / some
        far = (abs(xp.cos(some) + 3 * second) + 8 * SLACK) / abs(some)
        middle = xp.where(near, abs(_series(xp.where(near, y, 0.0), 3)), far)
        found = (middle + larger(upper - y, y - lower) / 5) * (1 + SLACK) + TINY
        return smaller(found, 0.25)


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
        """The value `arctan y`."""
        return namespace(y).arctan(y)

    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1 / (1 + y^2)`; beyond 1e150, where squares overflow, as there."""
        size = smaller(abs(y), 1e150)
        return 1 / (1 + size * size)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int:
        """The derivative `1 / (1 + y^2)`."""
        more = tape.affine(lambda square: square + 1.0, tape.unit(Square(), y))
        return tape.unit(Reciprocal(least=1.0), more)

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
