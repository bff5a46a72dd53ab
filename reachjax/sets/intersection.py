"""The part of a polytope that lies in an ellipsoid.

Facets know the corners that a set does not have, an ellipsoid the directions that lie between
facets: together they enclose less than either. The linear facts of the one and the cone fact of the
other hold together. What would need a program of its own, a support or a volume, is the smaller one
of the two parts': an upper bound.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from reachjax.numerics.checks import is_concrete, require_kind, same_size
from reachjax.numerics.pytrees import pytree
from reachjax.sets import outlines
from reachjax.sets.base import AbstractSet, Box, Matrix, PolyhedralSet, Vector
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.unusable import ThinSetError, UnusableSetError

DRAWS = (1, 9, 81)
"""So many times the points wanted are drawn, in turn, until enough of them lie in both parts."""


@pytree
class Intersection(AbstractSet):
    """The points of a bounded polytope that lie in an ellipsoid.

    Args:
        polytope: a `Box` or a `Polytope`.
        ellipsoid: of the same dimension.

    Raises:
        TypeError: a part is of another kind.
        ValueError: dimensions differ, or the polytope is a time-varying box.

    Example:
        >>> region = Intersection(Box([0.0, -1.0], [2.0, 1.0]), Ellipsoid([0.0, 0.0], jnp.eye(2)))
        >>> region.contains([[0.5, 0.5], [-0.5, 0.5], [0.9, 0.9]]).tolist()
        [True, False, False]
        >>> region.support([[1.0, 0.0], [-1.0, 0.0]]).round(9).tolist()
        [1.0, 0.0]
    """

    polytope: PolyhedralSet
    ellipsoid: Ellipsoid

    def __post_init__(self):
        require_kind("Intersection.polytope", self.polytope, PolyhedralSet, "a Box or a Polytope")
        require_kind("Intersection.ellipsoid", self.ellipsoid, Ellipsoid, "an Ellipsoid")
        if self.polytope.steps is not None:
            raise ValueError(
                "Intersection.polytope must be one box, but a time-varying one arrived"
            )
        same_size(
            "Intersection.polytope has dimension",
            "Intersection.ellipsoid has dimension",
            (self.polytope.dimension, self.ellipsoid.dimension),
        )

    @property
    def parts(self) -> tuple[PolyhedralSet, Ellipsoid]:
        """The polytope and the ellipsoid."""
        return self.polytope, self.ellipsoid

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.ellipsoid.dimension

    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch m+1"]:
        """`A x` of each facet, and then the ellipsoid's `|A x + b|`."""
        return jnp.concatenate([part.bounded_values(points) for part in self.parts], axis=-1)

    @property
    def limits(self) -> Float[Array, " m+1"]:
        """`b` of the polytope, and then 1."""
        return jnp.concatenate([part.limits for part in self.parts])

    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""
        return all(part.surely_contains(point) for part in self.parts)

    def misses(self, box: Box) -> bool:
        """Whether one of the parts surely has no point in a box."""
        return any(part.misses(box) for part in self.parts)

    def separation(self, other: PolyhedralSet) -> Float[Array, ""]:
        """The better one of the two parts'."""
        return jnp.maximum(*(part.separation(other) for part in self.parts))

    def closed_form(self, box: Box) -> Intersection:
        """The part of the ellipsoid that is in the box."""
        return self.replace(polytope=box)

    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """An upper bound of `max a . x`: the smaller of the two parts'.

        It is not attained where the maximum lies on the edge at which the parts meet.

        Raises:
            ValueError: the polytope is empty or unbounded.
        """
        return jnp.minimum(*(part.support(directions) for part in self.parts))

    def bounding_box(self) -> Box:
        """The points that are in the boxes around both parts; not always the smallest box.

        Raises:
            ValueError: the polytope is empty or unbounded, or these boxes have no point in common.
        """
        box, other = (part.bounding_box() for part in self.parts)
        lower, upper = jnp.maximum(box.lower, other.lower), jnp.minimum(box.upper, other.upper)
        if is_concrete(lower, upper) and bool(jnp.any(lower > upper)):
            raise UnusableSetError("the polytope and the ellipsoid have no point in common")
        return Box(lower, upper)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly: drawn from one part, those kept that are in the other.

        Raises:
            RuntimeError: hardly any are, whichever part they are drawn from: the set is empty, or
                thin beside both.
        """
        for times in DRAWS:
            for drawn, other in (self.parts[::-1], self.parts):
                points = drawn.sample(key, times * count)
                kept = np.asarray(points)[np.asarray(other.contains(points))]
                if len(kept) >= count:
                    return jnp.asarray(kept[:count])
        raise ThinSetError(
            f"fewer than {count} of {DRAWS[-1] * count} points of the polytope are in the "
            "ellipsoid, and the other way round: the intersection is empty, or too thin to be "
            "sampled"
        )

    def sample_boundary(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points of the surface, up to rounding: samples pushed outwards from their mean.

        Raises:
            RuntimeError: the set cannot be sampled.
        """
        points = self.sample(key, count)
        middle = points.mean(axis=0)
        along = points - middle
        A, b = self.polytope.facets
        slack, rate = b - A @ middle, along @ A.T
        to_facets = jnp.min(jnp.where(rate > 0, slack / rate, jnp.inf), axis=-1)
        # |y + s w| = 1 in the coordinates in which the ellipsoid is the unit ball
        form, _ = self.ellipsoid.normal_form
        y, w = form @ (middle - self.ellipsoid.center), along @ form.T
        mixed, size = w @ y, jnp.sum(w**2, axis=-1)
        to_surface = (jnp.sqrt(mixed**2 + size * (1 - y @ y)) - mixed) / size
        reach = jnp.fmin(to_facets, to_surface)  # of a single point, neither is a number
        return middle + jnp.fmax(reach, 1.0)[:, None] * along

    def corners(self) -> Float[Array, "v n"]:
        """The corners of the polytope that are in the ellipsoid."""
        corners = self.polytope.corners()
        return corners[self.ellipsoid.contains(corners)]

    def nearest(self, point: Vector, scale: Matrix) -> Vector:
        """The point of the polytope that is closest to the closest one of the ellipsoid."""
        return self.polytope.nearest(self.ellipsoid.nearest(point, scale), scale)

    def outline(self, i: int, j: int) -> Float[np.ndarray, "p 2"]:
        """What the shadows of the two parts have in common."""
        return outlines.cut(
            self.polytope.outline(i, j), self.ellipsoid.projection(i, j).normal_form
        )

    def size(self) -> Float[Array, ""]:
        """An upper bound of the volume, the smaller size of the two parts."""
        return jnp.minimum(*(part.size() for part in self.parts))

    def volume(self) -> Float[Array, ""]:
        """An upper bound of the volume: that of the smaller part.

        Raises:
            ValueError: the polytope is empty or unbounded.
        """
        return jnp.minimum(*(jnp.asarray(part.volume()) for part in self.parts))
