"""What every set of states can do.

A set enters the semidefinite program through its **facts**: rows `r` over `[x, 1]` with
`r . [x, 1] >= 0` on the set. For a polytope `A x <= b` these are the rows of `[-A, b]`, whose
pairwise products span the quadratic constraint of the paper's proposition 1. An ellipsoid has a
**cone fact** instead, `|R [x, 1]| <= s [x, 1]`, whose square is that of its proposition 2. Nobody
else asks what kind a set is: whatever depends on that is a question here.

Two kinds of sets are bounded by facets and by an ellipsoid. A box is the plainest of the first, and
every set has one around it.
"""

from __future__ import annotations

import abc
from functools import partial
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from reachjax.numerics.checks import (
    Numbers,
    as_floats,
    evaluated,
    is_concrete,
    require_double_precision,
    same_size,
    within_time_axis,
)
from reachjax.numerics.pytrees import Replaceable, converted, pytree
from reachjax.numerics.rounding import (
    TINY,
    exponents,
    gamma,
    holds_subnormals,
    lengths,
    raised,
    shifted,
)
from reachjax.sets import outlines, supports
from reachjax.sets.balance import balanced
from reachjax.sets.unusable import UnusableSetError


class NormalForm(NamedTuple):
    """The ellipsoid `|A x + b| <= 1`, the paper's (there `A` is symmetric).

    Attributes:
        A: `(n, n)`.
        b: `(n,)`.
    """

    A: Float[Array | np.ndarray, "n n"]
    b: Float[Array | np.ndarray, " n"]

    def of(self, inner: NormalForm) -> NormalForm:
        """This form in `x`, given in `y = inner.A x + inner.b`."""
        return NormalForm(self.A @ inner.A, self.A @ inner.b + self.b)

    @property
    def inverse(self) -> NormalForm:
        """`x = A^-1 y - A^-1 b`."""
        inverse = np.linalg.inv(self.A)
        return NormalForm(inverse, -inverse @ self.b)


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
    def intervals(self) -> tuple[Float[Array, "*time n"], Float[Array, "*time n"]] | None:
        """The ends of its coordinates, if the set is all that lies between; None of others."""
        return None

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[PolyhedralSet | None, RoundSet | None]:
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
        box = self.bounding_box()
        if is_concrete(box):  # compiles nothing
            with np.errstate(over="ignore"):
                return jnp.asarray(np.diag((np.asarray(box.upper) - np.asarray(box.lower)) / 2))
        return jnp.diag(box.widths / 2)

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

    def drawn(self, count: int, seed: int) -> Float[np.ndarray, "count n"]:
        """Points drawn uniformly, on the host: a first call compiles nothing for boxes."""
        return np.asarray(self.sample(jax.random.key(seed), count))

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


MOST_DIMENSIONS = 12
"""Corners are among the states that are simulated up to this dimension, where a box has 4096."""

SWEEPS = 20
"""Rounds of projections onto the facets of a polytope, one after the other."""


class RoundSet(AbstractSet):
    """A set that an ellipsoid bounds, `(x - center)' shape^-1 (x - center) <= 1`."""

    center: Vector
    shape: Matrix

    @property
    @abc.abstractmethod
    def normal_form(self) -> NormalForm:
        """The pair `(A, b)`: the set is `|A x + b| <= 1`, up to rounding."""

    @abc.abstractmethod
    def from_ball(self) -> Matrix:
        """A matrix `M` with `x = center + M w`, `|w| <= 1`, for every `x` of the exact set."""

    @abc.abstractmethod
    def normal_towards(self, box: Box) -> Vector:
        """The normal, in the set's metric, at the point of a box closest to its centre."""


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

        An offset is looser than the support where its facet does not touch the set. It is brought
        to the direction's length by a product that is not rounded upwards, for what is shown or
        differentiated: nothing is proved by it.
        """
        A, b = self.facets
        offsets, found = supports.offsets_along(A, b, directions)
        known = is_concrete((A, directions))
        if known and np.all(found):
            return offsets
        support = self.support(directions)
        if not known:  # where a facet touches, its normal has a derivative too
            rounding = supports.TOUCHING * (abs(offsets) + abs(support))
            found = found & (offsets - support > rounding)
        return jnp.where(found, offsets, support)

    def separation(self, other: PolyhedralSet) -> Float[Array, ""]:
        """How far the facets of another set may move outward before it meets this bounded one."""
        return supports.separation(*self.facets, *other.facets)

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
    def intervals(self) -> tuple[Float[Array, "*time n"], Float[Array, "*time n"]]:
        """The bounds, of all times where there are several."""
        return self.lower, self.upper

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
        rows = self._directions(directions)
        if is_concrete((self, rows)) and holds_subnormals((self, rows)):
            return jnp.asarray(_support_in_numpy(*map(np.asarray, (self.lower, self.upper, rows))))
        return _support(self.lower, self.upper, rows)

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
        xp = np if is_concrete((self, box)) else jnp  # numpy knows subnormal numbers
        return Box(xp.maximum(self.lower, box.lower), xp.minimum(self.upper, box.upper))

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
        if is_concrete(self):  # compiles nothing
            return jnp.asarray(np.where(upper, np.asarray(self.upper), np.asarray(self.lower)))
        return jnp.where(jnp.asarray(upper, dtype=bool), self.upper, self.lower)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly."""
        self._single()
        return _uniform(self.lower, self.upper, key, count)

    def drawn(self, count: int, seed: int) -> Float[np.ndarray, "count n"]:
        """Points drawn uniformly, by numpy."""
        self._single()
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        shares = np.random.default_rng(seed).random((count, len(lower)), lower.dtype)
        return np.clip((1 - shares) * lower + shares * upper, lower, upper)

    def volume(self) -> Float[Array, ""]:
        """The product of the widths."""
        self._single()
        return jnp.prod(self.widths)

    def bounding_box(self) -> Box:
        """The box itself."""
        self._single()
        return self


@partial(jax.jit, static_argnames="count")
def _uniform(
    lower: Float[Array, " n"], upper: Float[Array, " n"], key: PRNGKeyArray, count: int
) -> Float[Array, "count n"]:
    draws = jax.random.uniform(key, (count, len(lower)), dtype=lower.dtype)
    return jnp.clip(lower + draws * (upper - lower), lower, upper)


@jax.jit
def _support(
    lower: Float[Array, " n"], upper: Float[Array, " n"], directions: Float[Array, "m n"]
) -> Float[Array, " m"]:
    chosen = jnp.where(directions > 0, upper, lower)
    (D, powers), (ends, others) = _normalised(directions), _normalised(chosen)
    terms, logs = D * ends, powers + others
    some = terms != 0  # also what becomes zero beside the largest one
    by = jnp.max(jnp.where(some, logs, -LOWEST), axis=1)
    by = jnp.where(by > -LOWEST, by, 0)
    terms = shifted(terms, logs - by[:, None])
    # products of powers of two are exact, and where there is one term nothing is added
    rounded = some & (abs(D) != 1) & (abs(ends) != 1)
    inexact = jnp.any(rounded, axis=1) | (jnp.sum(some, axis=1) > 1)
    rounding = gamma(len(lower)) * jnp.sum(abs(terms), axis=1) + len(lower) * TINY
    return raised(jnp.sum(terms, axis=1) + jnp.where(inexact, rounding, 0.0), by)


def _support_in_numpy(
    lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"], directions: np.ndarray
) -> Float[np.ndarray, " m"]:
    """The support of a box, rounded up, of numbers some of which XLA takes for zero."""
    with np.errstate(all="ignore"):
        terms = directions * np.where(directions > 0, upper, lower)
        rounding = gamma(len(lower) + 2) * abs(terms).sum(axis=1) + 2 * len(lower) * TINY
        found = terms.sum(axis=1) + rounding
    return np.where(np.isnan(found), np.inf, found)


def _normalised(numbers: Float[Array, "*batch n"]) -> tuple[Array, Array]:
    """Numbers in `[1, 2)`, or zero, and the powers of two that they are multiplied by."""
    powers = exponents(numbers[..., None])
    return shifted(numbers, -powers), powers
