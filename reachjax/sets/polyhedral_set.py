"""What sets that are bounded by facets have in common."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from reachjax.numerics.checks import evaluated, is_concrete, require_double_precision
from reachjax.numerics.rounding import TINY, exponents, gamma, lengths, shifted
from reachjax.sets import envelopes, formulas, outlines
from reachjax.sets.balance import balanced
from reachjax.sets.base import AbstractSet, Matrix, Vector

if TYPE_CHECKING:
    from reachjax.sets.box import Box

MOST_DIMENSIONS = 12
"""Corners are among the states that are simulated up to this dimension, where a box has 4096."""

SWEEPS = 20
"""Rounds of projections onto the facets of a polytope, one after the other."""


class PolyhedralSet(AbstractSet):
    """A set bounded by facets, `A x <= b`."""

    @property
    @abc.abstractmethod
    def facets(self) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """The pair `(A, b)`: the set is `A x <= b`."""

    @abc.abstractmethod
    def vertices(self) -> Float[Array, "v n"]:
        """The corners; their convex hull is the set."""

    @abc.abstractmethod
    def cut(self, box: Box) -> PolyhedralSet:
        """The points that lie in a box."""

    @property
    def parts(self) -> tuple[Self, None]:
        """The set itself, and no ellipsoid."""
        return self, None

    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch m"]:
        """`A x` of each facet."""
        return self._points(points) @ self.facets[0].T

    @property
    def limits(self) -> Float[Array, " m"]:
        """The offsets `b`."""
        return self.facets[1]

    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""
        require_double_precision(set=self)
        x = np.asarray(self._points(point))  # numpy knows subnormal numbers, XLA does not
        A, b = balanced(*(np.asarray(part) for part in self.facets), inner=True)
        with np.errstate(over="ignore", invalid="ignore"):
            rounding = gamma(self.dimension) * (abs(A) @ abs(x)) + TINY * ((A != 0) @ (x != 0))
            return bool(np.all(A @ x + rounding <= b))

    def facets_in_units(
        self, inner: bool = False
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"], Float[Array, " m"]]:
        """Facets `C x <= d` whose largest coefficients are in `[1, 2)`, and their norms.

        Of numbers, the set is exactly the same, or where offsets cannot be, larger; or smaller, if
        `inner`. Signs of what is computed from them then are right whatever underflows.
        """
        if is_concrete(self):  # of numbers also while something else is compiled
            with jax.ensure_compile_time_eval():
                A, b = self.facets
                C, d = balanced(np.asarray(A), np.asarray(b), inner)
                return jnp.asarray(C), jnp.asarray(d), jnp.asarray(np.linalg.norm(C, axis=1))
        C, d = self.facets
        with evaluated(C):  # normals may be known where offsets are not
            by = exponents(C)
            C, norms = shifted(C, -by[:, None]), lengths(shifted(C, -by[:, None]))
        return C, shifted(d, -by), norms

    def bounds_along(self, directions: Float[Array, "m n"]) -> Float[Array, " m"]:
        """Offsets of the facets whose normal is a direction, and the support of other directions.

        An offset is looser than the support where its facet does not touch the set.
        """
        A, b = self.facets
        offsets, found = formulas.offsets_along(A, b, directions)
        known = is_concrete((A, directions))
        if known and np.all(found):
            return offsets
        support = self.support(directions)
        if not known:  # where a facet touches, its normal has a derivative too
            rounding = formulas.TOUCHING * (abs(offsets) + abs(support))
            found = found & (offsets - support > rounding)
        return jnp.where(found, offsets, support)

    def separation(self, other: PolyhedralSet) -> Float[Array, ""]:
        """How far the facets of another set may move outward before it meets this bounded one."""
        return envelopes.separation(*self.facets, *other.facets)

    def misses(self, box: Box) -> bool:
        """Whether the set surely has no point in a box: a separating direction proves it."""
        return bool(self.separation(box) > 0)

    def corners(self) -> Float[Array, "v n"]:
        """The vertices; none in many dimensions, or of a set that is too thin to have any."""
        try:
            return self.vertices() if self.dimension <= MOST_DIMENSIONS else super().corners()
        except RuntimeError:
            return super().corners()

    def nearest(self, point: Vector, scale: Matrix) -> Vector:
        """The closest point where `scale` is the unit, by ascent in one facet's multiplier a time.

        Source: Hildreth, A quadratic programming procedure (1957).
        """
        A, b = self.facets
        along = A @ scale @ scale.T
        squares = jnp.sum(A * along, axis=1)
        squares = jnp.where(squares > 0, squares, 1.0)

        def onto(carry, facet):
            point, weights = carry
            over = (A[facet] @ point - b[facet]) / squares[facet]
            weight = jnp.maximum(weights[facet] + over, 0.0)
            moved = point - (weight - weights[facet]) * along[facet]
            return (moved, weights.at[facet].set(weight)), None

        order = jnp.tile(jnp.arange(len(b)), SWEEPS)
        return jax.lax.scan(onto, (point, jnp.zeros(len(b))), order)[0][0]

    def outline(self, i: int, j: int) -> Float[np.ndarray, "p 2"]:
        """The corners of the shadow on two coordinates, in order."""
        return outlines.hull(np.asarray(self.vertices())[:, [i, j]])
