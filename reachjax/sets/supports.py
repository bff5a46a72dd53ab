"""Supports, boxes, separations and volumes of polytopes `A x <= b`, with their derivatives.

All are optimal values of linear programs, or volumes, found in numpy on the host together with
their slopes: hold the multipliers `y` and the optimal point `x` fixed and differentiate the
Lagrangian (the envelope theorem). Where a maximum is attained at more than one point, the slope is
one of several generalised gradients: of a box's facet with respect to its normal, say, that at one
of the facet's corners.

A set that is empty, unbounded or too thin raises an error on plain arrays. Inside `jax.jit`, where
it may come from weights that went astray in training, its values and slopes are NaN. What has a
formula has it there, without a call to the host.

The formulas are: the ends of a polytope whose facets are all along the axes, and a polygon's area.
In compiled code a call to the host costs more than the forms that bound a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.checks import is_concrete, require_double_precision
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import all_finite, on_host
from reachjax.sets import hulls, linear_programs
from reachjax.sets.balance import lengths
from reachjax.sets.linear_programs import separation_and_multipliers

Slopes = tuple[np.ndarray, ...]
Values = Callable[..., tuple[np.ndarray, Slopes]]
"""From arrays to values `(k,)` and, for each array, their derivatives `(k, *shape)`."""

Normals = Float[Array, "m n"]
Offsets = Float[Array, " m"]


def bounding_box(A: Normals, b: Offsets) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Lower and upper bounds of each coordinate, rounded outwards."""
    if not is_concrete((A, b)) and (known := box_ends(A, b)) is not None:
        return known
    ends, n = _values(_box, 2 * A.shape[1], A, b), A.shape[1]
    return -ends[:n], ends[n:]


def support(A: Normals, b: Offsets, directions: Float[Array, "k n"]) -> Float[Array, " k"]:
    """The largest value of each direction, rounded up."""
    return _values(_support, len(directions), A, b, directions)


def separation(A: Normals, b: Offsets, C: Normals, d: Offsets) -> Float[Array, ""]:
    """How far the facets of `C x <= d` may move outward before it meets `A x <= b`, or less."""
    if not is_concrete((A, b, C, d)):
        one, other = box_ends(A, b), box_ends(C, d)
        if one is not None and other is not None:
            return boxes_apart(one, other)
    return _values(_separation, 1, A, b, C, d)[0]


def volume(A: Normals, b: Offsets) -> Float[Array, ""]:
    """The volume: moving facet `i` by `db_i` sweeps `area_i db_i / |a_i|`."""
    if not is_concrete((A, b)):
        if (ends := box_ends(A, b)) is not None:
            return jnp.prod(ends[1] - ends[0])
        if A.shape[1] == 2:
            return area(A, b)
    return _values(_volume, 1, A, b)[0]


def _values(compute: Values, count: int, *arrays: Array) -> Array:
    if is_concrete(arrays):  # nothing to differentiate, and errors are raised, in `jax.jit` too
        return _forward(compute, count, *arrays)[0]
    values: Any = _linearised(compute, count, *arrays)
    return values


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _linearised(compute: Values, count: int, *arrays: Array) -> Array:
    return _forward(compute, count, *arrays)[0]


def _forward(compute, count, *arrays):
    require_double_precision(argument=arrays)
    values = jax.ShapeDtypeStruct((count,), float)
    slopes = tuple(jax.ShapeDtypeStruct((count, *array.shape), float) for array in arrays)
    shapes, traced = (values, slopes), not is_concrete(arrays)

    def computed(arguments):
        try:
            if all_finite(arguments):
                return compute(*arguments)
        except (ValueError, RuntimeError):
            if not traced:
                raise
        return jax.tree.map(lambda part: np.full(part.shape, np.nan), shapes)

    return on_host(computed, shapes, arrays)


@lenient
def _backward(compute, count, slopes, cotangent):
    return tuple(jnp.tensordot(cotangent, slope, 1) for slope in slopes)


_linearised.defvjp(_forward, _backward)


def _box(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Slopes]:
    lower, upper, Y, points = linear_programs.bounding_box(A, b)
    return np.concatenate([-lower, upper]), (-Y[:, :, None] * points[:, None, :], Y)


def _support(A: np.ndarray, b: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, Slopes]:
    values, Y, points = linear_programs.support(A, b, D)
    return values, (-Y[:, :, None] * points[:, None, :], Y, _own(points))


def _own(points: np.ndarray) -> np.ndarray:
    """Derivatives of maxima in the directions: each depends on its own."""
    return np.eye(len(points))[:, :, None] * points[:, None, :]


def _separation(
    A: np.ndarray, b: np.ndarray, C: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, Slopes]:
    """From the Lagrangian `s + y . (A x - b) + w . (C x - s |c| - d)`."""
    value, swept, y, w, x = separation_and_multipliers(A, b, C, d)
    units = C / lengths(C)[:, None]
    slopes = (swept, -y, w[:, None] * (x - value * units), -w)
    return np.array([value]), tuple(slope[None] for slope in slopes)


def _volume(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Slopes]:
    volume, areas, centroids = hulls.facet_areas(A, b)
    swept = areas / lengths(A)
    return np.array([volume]), ((-swept[:, None] * centroids)[None], swept[None])


ROUNDED = 8 * float(np.finfo(float).eps)
"""What rounding leaves of unit normals that are parallel, and of facets that are the same."""

TOUCHING = 1e-9
"""A facet that is closer to a set, as a part of their distances from zero, touches it."""

EMPTY = 1e-9
"""A polygon whose facets miss one another by a larger part of its size is empty, not a point."""


def box_ends(
    A: Float[Array, "m n"], b: Float[Array, " m"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]] | None:
    """Ends of each coordinate, if all facets are `x_i <= b` and `-x_i <= b`; exact.

    NaN where the polytope is empty. None if it is no such polytope, or its normals are traced.
    """
    if not is_concrete(A):
        return None
    rows = np.asarray(A)
    above, below = (rows == 1).T, (rows == -1).T
    along = (np.count_nonzero(rows, axis=1) == 1) & (above | below).any(axis=0)
    if not (along.all() and above.any(axis=1).all() and below.any(axis=1).all()):
        return None
    upper = jnp.where(above, b, jnp.inf).min(axis=1)
    lower = jnp.where(below, -b, -jnp.inf).max(axis=1)
    known = _unless((lower > upper).any())
    return lower * known, upper * known


def boxes_apart(
    one: tuple[Float[Array, " n"], Float[Array, " n"]],
    other: tuple[Float[Array, " n"], Float[Array, " n"]],
) -> Float[Array, ""]:
    """How far the facets of the other box may move outward before it meets the one; rounded down.

    They move inward where the boxes overlap: until the other one is away, or has no point left.
    """
    empty = (other[0] - other[1]) / 2
    gap = jnp.maximum(jnp.maximum(one[0] - other[1], other[0] - one[1]), empty).max()
    return gap - ROUNDED * jnp.abs(jax.lax.stop_gradient(gap))


def offsets_along(
    A: Float[Array, "m n"], b: Float[Array, " m"], directions: Float[Array, "k n"]
) -> tuple[Float[Array, " k"], Bool[Array | np.ndarray, " k"]]:
    """The least offset of the facets whose normal is each direction, up to length and rounding.

    Returns:
        The offsets, infinite where no facet has that normal, and whether one has: known numbers
        where normals and directions are.
    """
    known = is_concrete((A, directions))
    xp = np if known else jnp
    held = (A, directions) if known else jax.lax.stop_gradient((A, directions))
    normals, wanted = map(xp.asarray, held)
    sizes, lengths = (xp.abs(rows).max(axis=1) for rows in (normals, wanted))
    along = [xp.where(size > 0, size, 1.0) for size in (sizes, lengths)]
    apart = (wanted / along[1][:, None])[:, None] - normals / along[0][:, None]
    same = (xp.abs(apart).max(axis=2) <= ROUNDED) & (sizes > 0) & (lengths > 0)[:, None]
    xp = np if known and is_concrete(b) else jnp
    scaled = xp.asarray(b) * (lengths[:, None] / along[0])
    return jnp.asarray(xp.where(same, scaled, np.inf).min(axis=1)), same.any(axis=1)


def _unless(bad: Array) -> Float[Array, ""]:
    """One, or NaN: as a factor it makes a value NaN together with its derivatives."""
    return jnp.where(bad, jnp.nan, 1.0)


@jax.jit
def area(A: Float[Array, "m 2"], b: Float[Array, " m"]) -> Float[Array, ""]:
    """The area of a polygon: half the sum of its edges' lengths times their distances.

    An edge that moves outwards sweeps its length: that is the derivative. NaN where the polygon is
    empty or unbounded.
    """
    normals, offsets = jax.lax.stop_gradient((A, b))
    norms = jnp.hypot(normals[:, 0], normals[:, 1])
    normals, distances = normals / norms[:, None], offsets / norms
    along = jnp.stack([-normals[:, 1], normals[:, 0]], axis=1)
    lower, upper = _edges(normals, distances, along)
    edge = (upper >= lower) & jnp.isfinite(lower) & jnp.isfinite(upper)
    middle = jnp.where(edge, (lower + upper) / 2, 0.0)
    middles = distances[:, None] * normals + middle[:, None] * along
    inside = jnp.where(edge[:, None], middles, 0.0).sum(axis=0) / jnp.maximum(edge.sum(), 1)
    # from a point inside: distances of a set far from the origin are all alike
    distances = distances - normals @ inside
    lengths = jnp.maximum(upper - lower, 0.0)
    area = lengths @ distances / 2
    empty = jnp.max(upper - lower) < -EMPTY * jnp.max(jnp.abs(distances))
    moved = (b - (A * middles).sum(axis=1)) / norms
    swept = lengths @ (moved - jax.lax.stop_gradient(moved))
    return (area + swept) * _unless(empty | ~jnp.isfinite(area))


def _edges(
    normals: Array, distances: Array, along: Array
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Where each facet's line enters and leaves the others' half-planes, from its foot."""
    same, across = normals @ normals.T, along @ normals.T  # [i, j]: of line i and facet j
    room = distances - distances[:, None] * same
    order = jnp.arange(len(distances))
    own = order[:, None] == order
    rounded = ROUNDED * (jnp.abs(distances) + jnp.abs(distances[:, None]))
    parallel = own | (jnp.abs(across) <= ROUNDED)
    # of facets that are the same, the first one has the edge
    first = (same > 0) & (order < order[:, None]) & (room <= rounded)
    hidden = ~own & ((room < -rounded) | first)
    cut = room / jnp.where(parallel, 1.0, across)
    inf = jnp.inf
    upper = jnp.where(parallel, jnp.where(hidden, -inf, inf), jnp.where(across > 0, cut, inf))
    lower = jnp.where(parallel | (across > 0), -inf, cut)
    return lower.max(axis=1), upper.min(axis=1)
