"""Supports, separations and volumes of polytopes, with their derivatives.

All are optimal values of linear programs, or volumes, found in numpy on the host together with
their slopes: hold the multipliers `y` and the optimal point `x` fixed and differentiate the
Lagrangian (the envelope theorem). Where a maximum is attained at more than one point, the slope is
one of several generalised gradients: of a box's facet with respect to its normal, say, that at one
of the facet's corners.

A set that is empty, unbounded or too thin raises an error on plain arrays. Inside `jax.jit`, where
it may come from weights that went astray in training, its values and slopes are NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.checks import is_concrete, require_double_precision
from reachjax.numerics.host import all_finite, on_host
from reachjax.numerics.rounding import exponents, shifted
from reachjax.numerics.rounding import lengths as row_lengths
from reachjax.sets import (
    AbstractSet,
    Box,
    Intersection,
    PolyhedralSet,
    Polytope,
    hulls,
    polyhedra,
)
from reachjax.sets.balance import balanced, lengths

Slopes = tuple[np.ndarray, ...]
Values = Callable[..., tuple[np.ndarray, Slopes]]
"""From arrays to values `(k,)` and, for each array, their derivatives `(k, *shape)`."""


def bounding_box(X: AbstractSet) -> Box:
    """The set's bounding box; differentiable, also inside `jax.jit`."""
    if isinstance(X, Intersection):
        return X.boxed(bounding_box(X.polytope))
    if not isinstance(X, Polytope):
        return X.bounding_box()
    ends = _values(_box, 2 * X.dimension, X.A, X.b)
    return Box(-ends[: X.dimension], ends[X.dimension :])


def support(X: AbstractSet, directions: Float[Array, "m n"]) -> Float[Array, " m"]:
    """The set's support function, rounded up; differentiable, also inside `jax.jit`."""
    if isinstance(X, Intersection):
        return jnp.minimum(*(support(part, directions) for part in X.parts))
    if not isinstance(X, Polytope):
        return X.support(directions)
    return _values(_support, len(directions), X.A, X.b, directions)


def row_ranges(
    X: Polytope, rows: Float[Array, "m n"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Least and largest values of rows, rounded outward; differentiable, also inside `jax.jit`."""
    ends = _values(_support, 2 * len(rows), X.A, X.b, jnp.concatenate([-rows, rows]))
    return -ends[: len(rows)], jnp.maximum(-ends[: len(rows)], ends[len(rows) :])


def separation(X: AbstractSet, Y: PolyhedralSet) -> Float[Array, ""]:
    """How far the facets of `Y` may move outward before it meets `X`; negative if they overlap.

    A lower bound, rounding included; differentiable, also inside `jax.jit`. `X` is bounded. If it
    is round, the bound is the best that one facet of `Y` gives, or the bounding box of `X`; of an
    intersection, the better one of its two parts'.
    """
    if isinstance(X, Intersection):
        return jnp.maximum(*(separation(part, Y) for part in X.parts))
    if not isinstance(X, PolyhedralSet):
        C, d, norms = facets_in_units(Y)
        facet = jnp.max((-X.support(-C) - d) / norms)
        return jnp.maximum(facet, separation(X.bounding_box(), Y))
    return _values(_separation, 1, *X.facets, *Y.facets)[0]


def facets_in_units(
    Y: PolyhedralSet, inner: bool = False
) -> tuple[Float[Array, "m n"], Float[Array, " m"], Float[Array, " m"]]:
    """Facets `C x <= d` whose largest coefficients are in `[1, 2)`, and their norms.

    Of numbers, the set is exactly the same, or where offsets cannot be, larger; or smaller, if
    `inner`. Signs of what is computed from them then are right whatever underflows.
    """
    C, d = Y.facets
    if is_concrete(C, d):
        C, d = (jnp.asarray(part) for part in balanced(np.asarray(C), np.asarray(d), inner))
    else:
        by = exponents(C)
        C, d = shifted(C, -by[:, None]), shifted(d, -by)
    return C, d, row_lengths(C)


def polytope_volume(X: Polytope) -> Float[Array, ""]:
    """The volume; differentiable: moving facet `i` by `db_i` sweeps `area_i db_i / |a_i|`."""
    return _values(_volume, 1, X.A, X.b)[0]


def _values(compute: Values, count: int, *arrays: Array) -> Array:
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


def _backward(compute, count, slopes, cotangent):
    return tuple(jnp.tensordot(cotangent, slope, 1) for slope in slopes)


_linearised.defvjp(_forward, _backward)


def _box(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Slopes]:
    lower, upper, Y, points = polyhedra.bounding_box_and_multipliers(A, b)
    return np.concatenate([-lower, upper]), (-Y[:, :, None] * points[:, None, :], Y)


def _support(A: np.ndarray, b: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, Slopes]:
    values, Y, points = polyhedra.support_and_multipliers(A, b, D)
    return values, (-Y[:, :, None] * points[:, None, :], Y, _own(points))


def _own(points: np.ndarray) -> np.ndarray:
    """Derivatives of maxima in the directions: each depends on its own."""
    return np.eye(len(points))[:, :, None] * points[:, None, :]


def _separation(
    A: np.ndarray, b: np.ndarray, C: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, Slopes]:
    """From the Lagrangian `s + y . (A x - b) + w . (C x - s |c| - d)`."""
    value, swept, y, w, x = polyhedra.separation_and_multipliers(A, b, C, d)
    units = C / lengths(C)[:, None]
    slopes = (swept, -y, w[:, None] * (x - value * units), -w)
    return np.array([value]), tuple(slope[None] for slope in slopes)


def _volume(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Slopes]:
    volume, areas, centroids = hulls.facet_areas(A, b)
    swept = areas / lengths(A)
    return np.array([volume]), ((-swept[:, None] * centroids)[None], swept[None])
