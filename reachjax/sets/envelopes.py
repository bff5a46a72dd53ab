"""Supports, boxes, separations and volumes of polytopes `A x <= b`, with their derivatives.

All are optimal values of linear programs, or volumes, found in numpy on the host together with
their slopes: hold the multipliers `y` and the optimal point `x` fixed and differentiate the
Lagrangian (the envelope theorem). Where a maximum is attained at more than one point, the slope is
one of several generalised gradients: of a box's facet with respect to its normal, say, that at one
of the facet's corners.

A set that is empty, unbounded or too thin raises an error on plain arrays. Inside `jax.jit`, where
it may come from weights that went astray in training, its values and slopes are NaN. What has a
formula has it there, without a call to the host (`formulas`).
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
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import all_finite, on_host
from reachjax.sets import formulas, hulls, polyhedra
from reachjax.sets.balance import lengths
from reachjax.sets.separation import separation_and_multipliers

Slopes = tuple[np.ndarray, ...]
Values = Callable[..., tuple[np.ndarray, Slopes]]
"""From arrays to values `(k,)` and, for each array, their derivatives `(k, *shape)`."""

Normals = Float[Array, "m n"]
Offsets = Float[Array, " m"]


def bounding_box(A: Normals, b: Offsets) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Lower and upper bounds of each coordinate, rounded outwards."""
    if not is_concrete((A, b)) and (known := formulas.box_ends(A, b)) is not None:
        return known
    ends, n = _values(_box, 2 * A.shape[1], A, b), A.shape[1]
    return -ends[:n], ends[n:]


def support(A: Normals, b: Offsets, directions: Float[Array, "k n"]) -> Float[Array, " k"]:
    """The largest value of each direction, rounded up."""
    return _values(_support, len(directions), A, b, directions)


def separation(A: Normals, b: Offsets, C: Normals, d: Offsets) -> Float[Array, ""]:
    """How far the facets of `C x <= d` may move outward before it meets `A x <= b`, or less."""
    if not is_concrete((A, b, C, d)):
        one, other = formulas.box_ends(A, b), formulas.box_ends(C, d)
        if one is not None and other is not None:
            return formulas.boxes_apart(one, other)
    return _values(_separation, 1, A, b, C, d)[0]


def volume(A: Normals, b: Offsets) -> Float[Array, ""]:
    """The volume: moving facet `i` by `db_i` sweeps `area_i db_i / |a_i|`."""
    if not is_concrete((A, b)):
        if (ends := formulas.box_ends(A, b)) is not None:
            return jnp.prod(ends[1] - ends[0])
        if A.shape[1] == 2:
            return formulas.area(A, b)
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
    lower, upper, Y, points = polyhedra.bounding_box(A, b)
    return np.concatenate([-lower, upper]), (-Y[:, :, None] * points[:, None, :], Y)


def _support(A: np.ndarray, b: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, Slopes]:
    values, Y, points = polyhedra.support(A, b, D)
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
