"""What every set of states can do.

A set enters the semidefinite program through its **facts**: rows `r` over `[x, 1]` with
`r . [x, 1] >= 0` on the set. For a polytope `A x <= b` these are the rows of `[-A, b]`, whose
pairwise products span the quadratic constraint of the paper's proposition 1. A round set has a
**cone fact** instead, `|R [x, 1]| <= s [x, 1]`, whose square is that of its proposition 2.
"""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from reachjax.numerics.checks import Numbers, as_floats, require_double_precision, same_size
from reachjax.numerics.pytrees import Replaceable
from reachjax.numerics.rounding import TINY, gamma
from reachjax.sets.balance import balanced

if TYPE_CHECKING:
    from reachjax.sets.box import Box

MOST_DIMENSIONS = 12
"""Corners are among the states that are simulated up to this dimension, where a box has 4096."""


class AbstractSet(Replaceable, abc.ABC):
    """A closed convex set of states in `n` dimensions."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """The number `n` of coordinates."""

    @abc.abstractmethod
    def facts(self) -> Float[Array, "m n+1"]:
        """Rows `r` with `r . [x, 1] >= 0` for every `x` of the set."""

    def cone_facts(self) -> Float[Array, "r n+1"]:
        """Rows `[s; R]` with `|R [x, 1]| <= s [x, 1]` for every `x` of the set; none by default."""
        return jnp.zeros((0, self.dimension + 1))

    @abc.abstractmethod
    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch m"]:
        """What the set bounds, at each point: `A x` (by `b`), or `|A x + b|` (by 1)."""

    @abc.abstractmethod
    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""

    @abc.abstractmethod
    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """The largest value of each direction on the set (rounded up where it is computed)."""

    def _directions(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, "m n"]:
        require_double_precision(set=self)
        rows = Numbers("(m, n)")(directions, "directions")
        same_size(
            "the set's dimension is",
            "the dimension of directions is",
            (self.dimension, rows.shape[1]),
        )
        return rows

    def _points(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch n"]:
        rows = as_floats(points, "points")
        arrived = rows.shape[-1] if rows.ndim else None
        same_size("the set's dimension is", "the dimension of points is", (self.dimension, arrived))
        return rows

    @abc.abstractmethod
    def contains(
        self, points: Float[ArrayLike, "*batch n"], tolerance: float = 0.0
    ) -> Bool[Array, "*batch"]:
        """Whether each point lies in the set, enlarged by `tolerance` in the facts' scale."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly from the set."""

    @abc.abstractmethod
    def volume(self) -> Float[Array, ""] | float:
        """The `n`-dimensional volume (length, area, ...)."""

    @abc.abstractmethod
    def bounding_box(self) -> Box:
        """The smallest box around the set."""


class PolyhedralSet(AbstractSet):
    """A set bounded by facets, `A x <= b`."""

    @property
    @abc.abstractmethod
    def facets(self) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """The pair `(A, b)`: the set is `A x <= b`."""

    @abc.abstractmethod
    def vertices(self) -> Float[Array, "v n"]:
        """The corners; their convex hull is the set."""

    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""
        require_double_precision(set=self)
        x = np.asarray(self._points(point))  # numpy knows subnormal numbers, XLA does not
        A, b = balanced(*(np.asarray(part) for part in self.facets), inner=True)
        with np.errstate(over="ignore", invalid="ignore"):
            rounding = gamma(self.dimension) * (abs(A) @ abs(x)) + TINY * ((A != 0) @ (x != 0))
            return bool(np.all(A @ x + rounding <= b))

    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch m"]:
        """`A x` of each facet."""
        return self._points(points) @ self.facets[0].T

    def facts(self) -> Float[Array, "m n+1"]:
        """The rows `[-a, b]`: a facet's slack `b - a . x` is never negative."""
        A, b = self.facets
        return jnp.hstack([-A, b[:, None]])

    def contains(
        self, points: Float[ArrayLike, "*batch n"], tolerance: float = 0.0
    ) -> Bool[Array, "*batch"]:
        """Whether `A x <= b + tolerance` holds for each point."""
        return _satisfied(self, self._points(points), tolerance)


@jax.jit
def _satisfied(
    X: PolyhedralSet, points: Float[Array, "*batch n"], tolerance: float
) -> Bool[Array, "*batch"]:
    A, b = X.facets
    return jnp.all(points @ A.T <= b + tolerance, axis=-1)
