"""Cells: parts of a set that cover it, cut along coordinates.

A cell that is too thin to be told from an empty set is made larger, and then holds points beside
the set; none is left out unless a separating direction proves it empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import lsq_linear

from reachjax.numerics.checks import described, whole_number
from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection, PolyhedralSet, Polytope
from reachjax.sets.geometry import bounding_box, separation

TOUCHING = 1e-6
"""A cell that a set barely touches is enlarged by this part of its box."""

ENOUGH = 1000
"""A cell from which so many points cannot be drawn is too thin."""


class Cell(NamedTuple):
    """The part of a set that lies in a box, or a little more."""

    box: Box
    part: AbstractSet


def grid(X: AbstractSet, counts: Sequence[int]) -> list[Cell]:
    """Equal parts of the box around a set, those that it reaches.

    Args:
        X: the set.
        counts: how many parts each coordinate is cut into.

    Raises:
        TypeError: a count is no whole number, or the set is of an unknown kind.
        ValueError: there is not a positive number for each coordinate.

    Example:
        >>> [cell.part.lower.tolist() for cell in grid(Box([0.0, 0.0], [1.0, 2.0]), (1, 2))]
        [[0.0, 0.0], [0.0, 1.0]]
    """
    if len(counts) != X.dimension:
        raise ValueError(
            f"cells must be a number for each of {X.dimension} coordinates, but {counts} arrived"
        )
    box, ends = bounding_box(X), []
    for i, count in enumerate(counts):
        parts = whole_number(f"cells[{i}]", count, 1) + 1
        ends.append(np.linspace(box.lower[i], box.upper[i], parts))
    boxes = []
    for index in np.ndindex(*counts):
        lower = [end[i] for end, i in zip(ends, index, strict=True)]
        upper = [end[i + 1] for end, i in zip(ends, index, strict=True)]
        boxes.append(Box(lower, upper))
    return _reached(X, boxes)


def halves(X: AbstractSet, box: Box, scale: Float[np.ndarray, " n"]) -> list[Cell]:
    """The parts of a set in a box on either side of the middle of its longest side.

    Args:
        X: the set.
        box: the cell that is cut.
        scale: the unit in which each coordinate is measured.

    Example:
        >>> X = Box([0.0, 0.0], [1.0, 2.0])
        >>> [cell.part.upper.tolist() for cell in halves(X, X, np.ones(2))]
        [[1.0, 1.0], [1.0, 2.0]]
    """
    axis = int(np.argmax(np.asarray(box.widths) / scale))
    middle = box.center[axis]
    below = Box(box.lower, box.upper.at[axis].set(middle))
    above = Box(box.lower.at[axis].set(middle), box.upper)
    return _reached(X, [below, above])


def _reached(X: AbstractSet, boxes: Iterable[Box]) -> list[Cell]:
    """What a set has in common with boxes, but for those that it surely does not reach."""
    return [Cell(box, _within(X, box)) for box in boxes if not _apart(X, box)]


def _apart(X: AbstractSet, box: Box) -> bool:
    """Whether a set surely has no point in a box; a separating direction proves it."""
    if isinstance(X, Box):
        return False
    if isinstance(X, Intersection):
        return any(_apart(part, box) for part in X.parts)
    if isinstance(X, Ellipsoid):
        direction = _towards(X, box)[None]
        return bool(-box.support(-direction) > X.support(direction))
    if isinstance(X, PolyhedralSet):
        return bool(separation(X, box) > 0)
    raise TypeError(f"X0 must be a set that can be cut, but {described(X)} arrived")


def _towards(X: Ellipsoid, box: Box) -> Float[Array, " n"]:
    """The normal, in the ellipsoid's metric, at the point of a box closest to its centre."""
    A, b = (np.asarray(part) for part in X.normal_form)
    nearest = lsq_linear(A, -b, bounds=(box.lower, np.nextafter(box.upper, np.inf))).x
    return jnp.asarray(A.T @ (A @ nearest + b))


def _within(X: AbstractSet, box: Box) -> AbstractSet:
    """The points of a set that lie in a box, and few others."""
    if isinstance(X, Box):
        return box
    room = TOUCHING * jnp.max(box.widths)
    larger = Box(box.lower - room, box.upper + room)
    for around in (box, larger):
        cell = _cut(X, around)
        try:
            cell.sample(jax.random.key(0), ENOUGH)
        except (ValueError, RuntimeError):  # too thin to be told from an empty set
            continue
        return cell
    return _behind_a_tangent(X, larger)


def _behind_a_tangent(X: AbstractSet, box: Box) -> AbstractSet:
    """What facets leave of a box from which a set's round part cuts little."""
    if isinstance(X, Intersection):
        polytope, ball = _cut(X.polytope, box), X.ellipsoid
    elif isinstance(X, Ellipsoid):
        polytope, ball = box, X
    else:
        return box
    direction = _towards(ball, box)[None]
    assert isinstance(polytope, PolyhedralSet)
    (A, b), top = polytope.facets, ball.support(direction)
    return Polytope(jnp.concatenate([A, direction]), jnp.concatenate([b, top]))


def _cut(X: AbstractSet, box: Box) -> AbstractSet:
    if isinstance(X, Ellipsoid):
        return Intersection(box, X)
    if isinstance(X, Intersection):
        polytope = _cut(X.polytope, box)
        assert isinstance(polytope, PolyhedralSet)
        return X.replace(polytope=polytope)
    assert isinstance(X, PolyhedralSet)
    if isinstance(X, Box):
        return Box(jnp.maximum(X.lower, box.lower), jnp.minimum(X.upper, box.upper))
    (A, b), (C, d) = X.facets, box.facets
    return Polytope(jnp.concatenate([A, C]), jnp.concatenate([b, d]))
