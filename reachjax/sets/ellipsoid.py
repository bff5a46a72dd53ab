"""Ellipsoids.

With `Q` the shape matrix and `L L' = Q` its Cholesky factor, `(x - q)' Q^-1 (x - q) <= 1` is
`|A x + b| <= 1` with `A = L^-1` and `b = -A q`, the paper's form (there `A` is symmetric; any
orthogonal multiple describes the same set).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray
from scipy.optimize import lsq_linear

from reachjax.numerics.checks import (
    Numbers,
    evaluated,
    is_concrete,
    require_double_precision,
    same_size,
    whole_number,
)
from reachjax.numerics.pytrees import converted, pytree
from reachjax.numerics.rounding import settled
from reachjax.sets import outlines, outward
from reachjax.sets.base import Box, Matrix, NormalForm, RoundSet, Vector

SINGULAR = 1e-14
"""A shape matrix counts as singular if scaling its diagonal to 1 leaves no larger eigenvalue."""


@pytree
class Ellipsoid(RoundSet):
    """The ellipsoid `(x - center)' shape^-1 (x - center) <= 1` (the paper's proposition 2).

    Args:
        center: `(n,)`, in the units of the states.
        shape: `(n, n)`, symmetric and positive definite; the squares of the half-axes are its
            eigenvalues.

    Raises:
        ValueError: sizes differ, an entry is not finite, or `shape` is not symmetric or not
            positive definite (a flat ellipsoid has no facts).

    Example:
        >>> ellipsoid = Ellipsoid([1.0, 0.0], [[4.0, 0.0], [0.0, 1.0]])
        >>> ellipsoid.support([[1.0, 0.0], [0.0, 2.0]]).round(9).tolist()
        [3.0, 2.0]
        >>> round(float(ellipsoid.volume() / jnp.pi), 9)
        2.0
    """

    center: Float[Array, " n"] = converted(converter=Numbers("(n,)"))
    shape: Float[Array, "n n"] = converted(converter=Numbers("(n, n)"))

    def __post_init__(self):
        center, shape = self.center, self.shape
        same_size(
            "Ellipsoid.center has length",
            "Ellipsoid.shape has a number of rows of",
            (len(center), len(shape)),
        )
        same_size(
            "its number of rows is",
            "Ellipsoid.shape must be square: its number of columns is",
            (shape.shape[0], shape.shape[1]),
        )
        if is_concrete(shape):
            _require_positive_definite(np.asarray(shape))
        with evaluated(shape):
            object.__setattr__(self, "shape", (shape + shape.T) / 2)

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.center.shape[0]

    @property
    def normal_form(self) -> NormalForm:
        """The pair `(A, b)`: the set is `|A x + b| <= 1`, up to rounding."""
        with evaluated(self):
            factor = jnp.linalg.cholesky(self.shape)
            A = solve_triangular(factor, jnp.eye(self.dimension), lower=True)
            return NormalForm(A, -A @ self.center)

    @classmethod
    def enclosing(
        cls, form: NormalForm, level: Float[Array | np.ndarray, ""] | float = 1.0
    ) -> Ellipsoid:
        """An ellipsoid that surely contains `|A x + b| <= level`; larger by rounding only.

        Args:
            form: `A`, which is invertible, and `b`.
            level: above 0.

        Raises:
            ValueError: `A` is singular, or the level is not above 0.

        Example:
            >>> form = Ellipsoid([1.0, 0.0], [[4.0, 0.0], [0.0, 1.0]]).normal_form
            >>> Ellipsoid.enclosing(form, 2.0).shape.round(6).tolist()
            [[16.0, 0.0], [0.0, 4.0]]
        """
        require_double_precision(form=form)
        A, b = form
        if is_concrete(level) and level <= 0:
            raise ValueError(f"level must be above 0, but {level} arrived")
        if is_concrete(A) and np.linalg.slogdet(np.asarray(A)).sign == 0:
            raise ValueError(f"form.A must be invertible, but it is\n{np.asarray(A)}")
        inverse = jnp.linalg.inv(A)
        q, Q = -inverse @ b, inverse @ inverse.T
        # one rounding of both, whatever the compiler fuses: it is these that are proved
        q, Q = settled((q, (Q + Q.T) / 2))
        return cls(q, Q * outward.inflation(A, b, q, Q, jnp.asarray(level)))

    def from_ball(self) -> Float[Array, "n n"]:
        """A matrix `M` with `x = center + M w`, `|w| <= 1`, for every `x` of the exact set.

        It is the Cholesky factor, larger by rounding only.
        """
        return outward.ball_map(self.normal_form.A, self.center, self.shape)

    scale = from_ball  # in this unit the ellipsoid is a ball

    @property
    def parts(self) -> tuple[None, Ellipsoid]:
        """No facets, and the ellipsoid itself."""
        return None, self

    def closed_form(self, box: Box) -> Ellipsoid:
        """The ellipsoid itself."""
        return self

    def cone_facts(self) -> Float[Array, "n+1 n+1"]:
        """The rows `[s; A, b]` with `|A x + b| <= s` on the set, `s` being 1 up to rounding."""
        A, b = self.normal_form
        s = outward.level(A, self.center, self.shape)
        level = jnp.zeros(self.dimension + 1).at[-1].set(s)
        return jnp.vstack([level, jnp.hstack([A, b[:, None]])])

    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """`a . q + sqrt(a' Q a)`, rounded up."""
        return outward.support(self.center, self.shape, self._directions(directions))

    def bounded_values(self, points: Float[ArrayLike, "*batch n"]) -> Float[Array, "*batch 1"]:
        """`|A x + b|`, at most 1 on the set."""
        A, _ = self.normal_form
        return jnp.linalg.norm((self._points(points) - self.center) @ A.T, axis=-1, keepdims=True)

    @property
    def limits(self) -> Float[Array, " 1"]:
        """The limit 1."""
        return jnp.ones(1)

    def surely_contains(self, point: Float[ArrayLike, " n"]) -> bool:
        """Whether a point lies in the set in exact arithmetic; False where rounding may decide."""
        require_double_precision(set=self)
        x = self._points(point)
        if x.ndim != 1:
            raise ValueError(f"point must be one of shape (n,), but {x.shape} arrived")
        return bool(outward.surely_inside(self.normal_form.A, self.center, self.shape, x))

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly: directions on the sphere, radii `u^(1/n)`."""
        count = whole_number("count", count, 1)
        along, radial = jax.random.split(key)
        radii = jax.random.uniform(radial, (count, 1), dtype=self.center.dtype)
        return self._mapped(_directions(along, count, self.center) * radii ** (1 / self.dimension))

    def sample_boundary(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points of the surface, up to rounding."""
        count = whole_number("count", count, 1)
        return self._mapped(_directions(key, count, self.center))

    def nearest(self, point: Vector, scale: Matrix) -> Vector:
        """The closest point where the ellipsoid is a ball."""
        return self.center + (point - self.center) / jnp.maximum(self.bounded_values(point), 1.0)

    def normal_towards(self, box: Box) -> Float[Array, " n"]:
        """The normal, in the ellipsoid's metric, at the point of a box closest to its centre."""
        A, b = (np.asarray(part) for part in self.normal_form)
        nearest = lsq_linear(A, -b, bounds=(box.lower, np.nextafter(box.upper, np.inf))).x
        return jnp.asarray(A.T @ (A @ nearest + b))

    def misses(self, box: Box) -> bool:
        """Whether the set surely has no point in a box: a separating direction proves it."""
        direction = self.normal_towards(box)[None]
        return bool(-box.support(-direction) > self.support(direction))

    def outline(self, i: int, j: int) -> Float[np.ndarray, "p 2"]:
        """Points of the shadow's ellipse."""
        shadow = self.projection(i, j)
        return np.asarray(shadow.center) + outlines.circle() @ np.linalg.cholesky(shadow.shape).T

    def _mapped(self, points: Float[Array, "count n"]) -> Float[Array, "count n"]:
        """From the unit ball to the set."""
        return self.center + points @ jnp.linalg.cholesky(self.shape).T

    def volume(self) -> Float[Array, ""]:
        """The volume of the unit ball times the product of the half-axes."""
        n = self.dimension
        ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
        return ball * jnp.prod(jnp.diag(jnp.linalg.cholesky(self.shape)))

    def bounding_box(self) -> Box:
        """The smallest box around the set, rounded outwards."""
        eye = jnp.eye(self.dimension)
        return Box(-self.support(-eye), self.support(eye))

    def projection(self, *coordinates: int) -> Ellipsoid:
        """The shadow on some coordinates, an ellipsoid again.

        Raises:
            TypeError: a coordinate is no whole number.
            ValueError: there is no such coordinate, or one is named twice.

        Example:
            >>> Ellipsoid([1.0, 2.0, 3.0], jnp.eye(3)).projection(2, 0).center.tolist()
            [3.0, 1.0]
        """
        distinct = {whole_number("a coordinate", i, 0) for i in coordinates}
        if not coordinates or len(distinct) < len(coordinates) or max(distinct) >= self.dimension:
            raise ValueError(
                f"coordinates must be distinct and among 0 .. {self.dimension - 1}, "
                f"but {coordinates} arrived"
            )
        index = np.array(coordinates)
        return Ellipsoid(self.center[index], self.shape[np.ix_(index, index)])


def _require_positive_definite(matrix: np.ndarray) -> None:
    widths = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = matrix / np.outer(widths, widths)
    if widths.all() and not np.allclose(scaled, scaled.T, rtol=0, atol=1e-12):
        raise ValueError(f"Ellipsoid.shape must be symmetric, but it is\n{matrix}")
    if not widths.all() or np.linalg.eigvalsh((scaled + scaled.T) / 2)[0] <= SINGULAR:
        raise ValueError(
            "Ellipsoid.shape must be positive definite, but its eigenvalues are "
            f"{np.linalg.eigvalsh((matrix + matrix.T) / 2).tolist()}"
        )


def _directions(key: PRNGKeyArray, count: int, like: Array) -> Float[Array, "count n"]:
    draws = jax.random.normal(key, (count, len(like)), dtype=like.dtype)
    return draws / jnp.linalg.norm(draws, axis=1, keepdims=True)
