"""What is not known but for a set that it is in, as layers of units of a step.

A **disturbance** is a relation `z = y + d` with `|d| <= 1`: a number that is new at each step. Its
facts are `1 - (z - y) >= 0` and `1 + (z - y) >= 0`. Both of its lines are parallel to `y`, so an
affine form holds it exactly, by a column of its own.

What else is known of several of them, such as the facets of a polytope, a **constraint** states: of
its input `y` it is known that `y >= 0`. Its value is zero, so it adds no column.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from jaxtyping import Array, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark, Product
from reachjax.numerics.rounding import gamma, namespace


@dataclasses.dataclass(frozen=True)
class Disturbance(AbstractUnit):
    """Anything in `[y - 1, y + 1]`; where one value is asked for, `y`.

    Example:
        >>> import jax.numpy as jnp
        >>> Disturbance()(jnp.array([0.5])).tolist()
        [0.5]
        >>> [end.tolist() for end in Disturbance().interval(jnp.zeros(1), jnp.zeros(1))]
        [[-1.0], [1.0]]
    """

    free: ClassVar[bool] = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`y`, as `d` is zero."""
        return y

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`[l - 1, u + 1]`, rounded outwards."""
        low, high = lower - 1.0, upper + 1.0
        xp = namespace(lower, upper)
        rounding = [gamma(1) * xp.where(end == 0, 0.0, abs(end) + 1.0) for end in (lower, upper)]
        return low - rounding[0], high + rounding[1]

    def lines(self, lower: Array, upper: Array) -> Lines:
        """`y - 1` and `y + 1`."""
        one = namespace(lower, upper).ones_like(lower)
        return Lines(below=Line(one, -one), above=Line(one, one))

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """`1 - (z - y) >= 0` and `1 + (z - y) >= 0`, whose product is `1 - d^2 >= 0`."""
        d = z - y
        blocks = Block(1.0 - d, "below", Mark.SECTOR), Block(1.0 + d, "above", Mark.SECTOR)
        return Facts(blocks, (), (Product("below", "above", Mark.SECTOR),))


@dataclasses.dataclass(frozen=True)
class Constraint(AbstractUnit):
    """Zero, of an input that is never negative.

    Args:
        closed: whether such facts alone bound the disturbances that were drawn before, as the
            facets of a polytope do: then derivatives need not know of the box around it.

    Example:
        >>> import jax.numpy as jnp
        >>> Constraint().facts(jnp.array([0.5]), None, None, None)["known"].tolist()
        [0.5]
    """

    closed: bool = False

    stated: ClassVar[bool] = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value zero."""
        return 0.0 * y

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The ends of zero."""
        zero = namespace(lower, upper).zeros_like(lower)
        return zero, zero

    def lines(self, lower: Array, upper: Array) -> Lines:
        """The line zero, twice."""
        zero = namespace(lower, upper).zeros_like(lower)
        return Lines(below=Line(zero, zero), above=Line(zero, zero))

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """`y >= 0`."""
        return Facts((Block(y, "known", Mark.SECTOR),), (), ())
