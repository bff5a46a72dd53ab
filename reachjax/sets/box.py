"""Boxes: one interval per coordinate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from reachjax.numerics.checks import (
    Numbers,
    is_concrete,
    require_double_precision,
    within_time_axis,
)
from reachjax.numerics.pytrees import converted, pytree
from reachjax.numerics.rounding import TINY, exponents, gamma, raised, shifted
from reachjax.sets import outlines
from reachjax.sets.base import Matrix, Vector
from reachjax.sets.polyhedral_set import PolyhedralSet
from reachjax.sets.unusable import UnusableSetError

MOST_CORNERS = 2**16

LOWEST = 2**20
"""Less than any exponent of a product, its sign turned."""


@pytree
class Box(PolyhedralSet):
    """The box `lower <= x <= upper`; a flat one (`lower == upper` somewhere) is allowed.

    Both may carry a leading time axis when the box is a time-varying input box; `at(t)` then gives
    the box of one time.

    Args:
        lower: `(n,)` or `(time, n)`, in the units of the coordinates.
        upper: same shape as `lower`.

    Raises:
        ValueError: shapes differ, a bound is not finite, or `lower > upper` in a coordinate.

    Example:
        >>> box = Box([2.5, -0.25], [3.0, 0.25])
        >>> float(box.volume())
        0.25
    """

    lower: Float[Array, "*time n"] = converted(converter=Numbers("(n,)", "(time, n)"))
    upper: Float[Array, "*time n"] = converted(converter=Numbers("(n,)", "(time, n)"))

    def __post_init__(self):
        lower, upper = self.lower, self.upper
        if lower.shape != upper.shape:
            raise ValueError(
                f"Box.lower and Box.upper must have one shape, "
                f"but {lower.shape} and {upper.shape} arrived"
            )
        if not is_concrete(lower, upper):
            # an empty box inside jax.jit: what is computed from it is NaN
            self._set(upper=jnp.where(lower <= upper, upper, jnp.nan))
        elif (above := np.asarray(lower) > np.asarray(upper)).any():
            where = tuple(int(i) for i in np.argwhere(above)[0])
            raise ValueError(
                f"Box.lower must not exceed Box.upper, but at {where} "
                f"lower is {lower[where]} and upper {upper[where]}: the box is empty"
            )

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.lower.shape[-1]

    @property
    def steps(self) -> int | None:
        """The number of times that a time-varying box is given for; None for a constant one."""
        return self.lower.shape[0] if self.lower.ndim == 2 else None

    def at(self, t) -> Box:
        """The box at time `t`.

        Raises:
            ValueError: the box is not given for this time (where the time is a plain number).
        """
        if self.steps is None:
            return self
        within_time_axis("Box", t, self.steps)
        return Box(self.lower[t], self.upper[t])

    @property
    def center(self) -> Float[Array, " n"]:
        """The midpoint of the box."""
        return (self.lower + self.upper) / 2

    @property
    def widths(self) -> Float[Array, " n"]:
        """The length of each side."""
        return self.upper - self.lower

    @property
    def facets(self) -> tuple[Float[Array, "2n n"], Float[Array, " 2n"]]:
        """`-x <= -lower`, then `x <= upper`."""
        self._single()
        with jax.ensure_compile_time_eval():  # normals are numbers also in compiled code
            normals = jnp.asarray(np.vstack([-np.eye(self.dimension), np.eye(self.dimension)]))
            if is_concrete(self):
                return normals, jnp.concatenate([-self.lower, self.upper])
        return normals, jnp.concatenate([-self.lower, self.upper])

    def _single(self) -> None:
        if self.steps is not None:
            raise UnusableSetError(
                f"a time-varying box (bounds of shape {self.lower.shape}) is a sequence of sets: "
                "take one by at(t)"
            )

    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """`max a . x` over the box, attained at a corner; rounded up."""
        self._single()
        return _support(self.lower, self.upper, self._directions(directions))

    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the box: comparisons are exact."""
        require_double_precision(set=self)
        x = np.asarray(self._points(point))  # numpy knows subnormal numbers, XLA does not
        return bool(np.all((np.asarray(self.lower) <= x) & (x <= np.asarray(self.upper))))

    def misses(self, box: Box) -> bool:
        """Whether another box has no point in common."""
        return bool(jnp.any((self.lower > box.upper) | (box.lower > self.upper)))

    def cut(self, box: Box) -> Box:
        """The points that lie in another box as well."""
        return Box(jnp.maximum(self.lower, box.lower), jnp.minimum(self.upper, box.upper))

    def brought_inside(self, point: Vector, middle: Vector, scale: Matrix) -> Vector:
        """The closest point, which surely is in the box."""
        return jnp.clip(point, self.lower, self.upper)

    def outline(self, i: int, j: int) -> Float[np.ndarray, "p 2"]:
        """The corners of the shadow: the box may have too many of its own to list."""
        self._single()
        here = np.array([i, j])
        return outlines.hull(np.asarray(Box(self.lower[here], self.upper[here]).vertices()))

    def vertices(self) -> Float[Array, "2**n n"]:
        """All corners, flat coordinates included.

        Raises:
            ValueError: there are more than 65536 of them.
        """
        self._single()
        if 2**self.dimension > MOST_CORNERS:
            raise ValueError(
                f"a box of dimension {self.dimension} has {2**self.dimension} corners, "
                f"more than the {MOST_CORNERS} that are listed"
            )
        upper = np.stack(np.unravel_index(np.arange(2**self.dimension), (2,) * self.dimension), 1)
        return jnp.where(jnp.asarray(upper, dtype=bool), self.upper, self.lower)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly."""
        self._single()
        shape = (count, self.dimension)
        draws = jax.random.uniform(key, shape, dtype=self.lower.dtype)
        return jnp.clip(self.lower + draws * self.widths, self.lower, self.upper)

    def volume(self) -> Float[Array, ""]:
        """The product of the widths."""
        self._single()
        return jnp.prod(self.widths)

    def bounding_box(self) -> Box:
        """The box itself."""
        self._single()
        return self


@jax.jit
def _support(
    lower: Float[Array, " n"], upper: Float[Array, " n"], directions: Float[Array, "m n"]
) -> Float[Array, " m"]:
    chosen = jnp.where(directions > 0, upper, lower)
    (D, powers), (ends, others) = _normalised(directions), _normalised(chosen)
    terms, logs = D * ends, powers + others
    by = jnp.max(jnp.where(terms != 0, logs, -LOWEST), axis=1)
    by = jnp.where(by > -LOWEST, by, 0)
    terms = shifted(terms, logs - by[:, None])
    # products of powers of two are exact, and where there is one term nothing is added
    rounded = (terms != 0) & (abs(D) != 1) & (abs(ends) != 1)
    inexact = jnp.any(rounded, axis=1) | (jnp.sum(terms != 0, axis=1) > 1)
    rounding = gamma(len(lower)) * jnp.sum(abs(terms), axis=1) + len(lower) * TINY
    return raised(jnp.sum(terms, axis=1) + jnp.where(inexact, rounding, 0.0), by)


def _normalised(numbers: Float[Array, "*batch n"]) -> tuple[Array, Array]:
    """Numbers in `[1, 2)`, or zero, and the powers of two that they are multiplied by."""
    powers = exponents(numbers[..., None])
    return shifted(numbers, -powers), powers
