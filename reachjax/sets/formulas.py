"""Sizes of polytopes that are formulas: boxes, and polygons in the plane.

In compiled code a call to the host costs more than the forms that bound a loop. So what has a
formula has it there: the ends of a polytope whose facets are all along the axes, and a polygon's
area. Plain arrays get theirs from linear programs and Qhull, which say what is wrong with a set.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.checks import is_concrete

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
