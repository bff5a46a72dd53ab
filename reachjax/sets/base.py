"""What every set of states can do.

A set enters the semidefinite program through its **facts**: rows `r` over `[x, 1]` with
`r . [x, 1] >= 0` on the set. For a polytope `A x <= b` these are the rows of `[-A, b]`, whose
pairwise products span the quadratic constraint of the paper's proposition 1. An ellipsoid has a
**cone fact** instead, `|R [x, 1]| <= s [x, 1]`, whose square is that of its proposition 2. Nobody
else asks what kind a set is: whatever depends on that is a question here.
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

if TYPE_CHECKING:
    from reachjax.sets.box import Box
    from reachjax.sets.ellipsoid import Ellipsoid
    from reachjax.sets.polyhedral_set import PolyhedralSet

Vector = Float[Array, " n"]
Matrix = Float[Array, "n n"]

INSIDE = 1 - 1e-9
"""What is projected onto a set that is no box ends this close to its edge, seen from inside."""


class AbstractSet(Replaceable, abc.ABC):
    """A closed convex set of states in `n` dimensions."""

    needs_programs = False
    """Whether `closed_form` is but a box, so that supports are worth their linear programs."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """The number `n` of coordinates."""

    @property
    def steps(self) -> int | None:
        """The number of times that a time-varying set is given for; None for a constant one."""
        return None

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[PolyhedralSet | None, Ellipsoid | None]:
        """What its facets bound, and the ellipsoid that bounds it; None of what it has not."""

    @property
    def facets(self) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """The pair `(A, b)`: `A x <= b` on the set; without rows where it has no such part."""
        polytope, _ = self.parts
        return polytope.facets if polytope else (jnp.zeros((0, self.dimension)), jnp.zeros(0))

    def facts(self) -> Float[Array, "m n+1"]:
        """The rows `[-a, b]`: a facet's slack `b - a . x` is never negative on the set."""
        A, b = self.facets
        return jnp.hstack([-A, b[:, None]])

    def cone_facts(self) -> Float[Array, "r n+1"]:
        """Rows `[s; R]` with `|R [x, 1]| <= s [x, 1]` on the set; none where no ellipsoid is."""
        _, ball = self.parts
        return ball.cone_facts() if ball else jnp.zeros((0, self.dimension + 1))

    @abc.abstractmethod
    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch m"]:
        """What the set bounds by its `limits`, at each point: `A x`, or `|A x + b|`."""

    @property
    @abc.abstractmethod
    def limits(self) -> Float[Array, " m"]:
        """What the bounded values do not exceed on the set, up to rounding: `b`, or 1."""

    def contains(
        self, points: Float[ArrayLike, "*batch n"], tolerance: float = 0.0
    ) -> Bool[Array, "*batch"]:
        """Whether each point lies in the set, enlarged by `tolerance` in the facts' scale."""
        return _satisfied(self, self._points(points), tolerance)

    @abc.abstractmethod
    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""

    def surely_empty(self) -> bool:
        """Whether its two parts surely have no point in common; a set of one part does not say."""
        polytope, ball = self.parts
        return bool(polytope and ball and ball.separation(polytope) > 0)

    @abc.abstractmethod
    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """The largest value of each direction on the set, rounded up; differentiable."""

    def row_ranges(self, rows: Float[Array, "m n"]) -> tuple[Vector, Vector]:
        """Least and largest values of rows on the set, rounded outwards; differentiable."""
        ends = self.support(jnp.concatenate([-rows, rows]))
        lower, upper = -ends[: len(rows)], ends[len(rows) :]
        return lower, jnp.maximum(lower, upper)

    def closed_form(self, box: Box) -> AbstractSet:
        """A set around this one, from a box around it, whose support needs no linear program."""
        return box

    @abc.abstractmethod
    def bounding_box(self) -> Box:
        """The smallest box around the set; differentiable."""

    def scale(self) -> Float[Array, "n n"]:
        """A matrix of half-widths, which maps the unit ball to about the size of the set."""
        return jnp.diag(self.bounding_box().widths / 2)

    def bounds_along(self, directions: Float[Array, "m n"]) -> Float[Array, " m"]:
        """Upper bounds of `a . x` over the set that cost little in compiled code: the support."""
        return self.support(directions)

    def separation(self, other: PolyhedralSet) -> Float[Array, ""]:
        """How far the facets of another set may move outward before it meets this bounded one.

        Negative if they overlap. A lower bound, rounding included; differentiable. Here, the best
        that one facet of the other set gives, or the box around this one.
        """
        C, d, norms = other.facets_in_units()
        facet = jnp.max((-self.support(-C) - d) / norms)
        return jnp.maximum(facet, self.bounding_box().separation(other))

    @abc.abstractmethod
    def misses(self, box: Box) -> bool:
        """Whether the set surely has no point in a box."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly from the set."""

    def sample_boundary(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"] | None:
        """Points of the curved surface, up to rounding; None where there are facets alone."""
        return None

    def corners(self) -> Float[Array, "v n"]:
        """Corners of the facets that are in the set; none where there are too many to list."""
        return jnp.zeros((0, self.dimension))

    @abc.abstractmethod
    def nearest(self, point: Vector, scale: Matrix) -> Vector:
        """About the closest point of the set where `scale` is the unit; it may lie outside."""

    def brought_inside(self, point: Vector, middle: Vector, scale: Matrix) -> Vector:
        """A point of the set, about the closest one, on the way from one in its interior.

        What a set bounds is convex: on the way from the middle it grows at most linearly.
        """
        near, limits = self.nearest(point, scale), self.limits
        here, there = self.bounded_values(middle), self.bounded_values(near)
        # where the middle is as far outside, by rounding, a share would be 0 / 0
        grown = jnp.where(there > here, there - here, 1.0)
        share = jnp.where(there > limits, jnp.maximum(limits - here, 0.0) / grown, 1.0)
        return middle + INSIDE * jnp.min(share) * (near - middle)

    @abc.abstractmethod
    def outline(self, i: int, j: int) -> Float[np.ndarray, "p 2"]:
        """Points around the set's shadow on two coordinates, in order."""

    @abc.abstractmethod
    def volume(self) -> Float[Array, ""] | float:
        """The `n`-dimensional volume (length, area, ...)."""

    def size(self) -> Float[Array, ""]:
        """The volume, or a stand-in where it takes too long; differentiable."""
        return jnp.asarray(self.volume())

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


@jax.jit
def _satisfied(
    X: AbstractSet, points: Float[Array, "*batch n"], tolerance: float
) -> Bool[Array, "*batch"]:
    return jnp.all(X.bounded_values(points) <= X.limits + tolerance, axis=-1)
