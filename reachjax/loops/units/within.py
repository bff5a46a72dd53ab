"""Numbers that are known to be small, whatever bounds say of how they came about."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import Line, Lines
from reachjax.loops.units.smooth import Quadratic, SmoothUnit
from reachjax.numerics.rounding import larger, namespace


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
