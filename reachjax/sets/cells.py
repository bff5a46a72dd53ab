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

from reachjax.numerics.checks import whole_number
from reachjax.sets.base import AbstractSet
from reachjax.sets.box import Box
from reachjax.sets.intersection import Intersection
from reachjax.sets.polytope import Polytope

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
        TypeError: a count is no whole number.
        ValueError: there is not a positive number for each coordinate.

    Example:
        >>> [cell.part.lower.tolist() for cell in grid(Box([0.0, 0.0], [1.0, 2.0]), (1, 2))]
        [[0.0, 0.0], [0.0, 1.0]]
    """
    lower, upper = grid_ends(X.bounding_box(), counts)
    return _reached(X, [Box(*ends) for ends in zip(lower, upper, strict=True)])


def grid_ends(
    box: Box, counts: Sequence[int]
) -> tuple[Float[Array, "cells n"], Float[Array, "cells n"]]:
    """Lower and upper corners of equal parts of a box, which move with it.

    Args:
        box: the box.
        counts: how many parts each coordinate is cut into.

    Raises:
        TypeError: a count is no whole number.
        ValueError: there is not a positive number for each coordinate.
    """
    if not isinstance(counts, Sequence) or len(counts) != box.dimension:
        raise ValueError(
            f"cells must be a number for each of {box.dimension} coordinates, but {counts} arrived"
        )
    numbers = [whole_number(f"cells[{i}]", count, 1) for i, count in enumerate(counts)]
    index = np.stack(np.meshgrid(*map(np.arange, numbers), indexing="ij"), axis=-1)
    index, many = index.reshape(-1, len(numbers)), np.asarray(numbers)

    def ends(index: np.ndarray) -> Float[Array, "cells n"]:
        within = index * (box.widths / many) + box.lower
        return jnp.where(index == many, box.upper, within)  # exactly, and so nothing is left out

    return ends(index), ends(index + 1)


def halves_along(X: AbstractSet, box: Box, axis: int) -> list[Cell]:
    """The parts of a set in a box on either side of its middle along one coordinate.

    Example:
        >>> X = Box([0.0, 0.0], [1.0, 2.0])
        >>> [cell.part.upper.tolist() for cell in halves_along(X, X, 1)]
        [[1.0, 1.0], [1.0, 2.0]]
    """
    middle = box.center[axis]
    below = Box(box.lower, box.upper.at[axis].set(middle))
    above = Box(box.lower.at[axis].set(middle), box.upper)
    return _reached(X, [below, above])


def from_tree(X: AbstractSet, axes: Sequence[int]) -> list[Cell]:
    """The cells that halving a set again and again leaves.

    Args:
        X: the set, which no part is left out of.
        axes: of the box around it, and then of the halves that the set reaches, each with all of
            its own before the next: along which coordinate it is halved, or -1 if it is not.

    Raises:
        ValueError: an entry is missing, is left over, or is no coordinate.

    Example:
        >>> X = Box([0.0, 0.0], [1.0, 1.0])
        >>> [cell.box.upper.tolist() for cell in from_tree(X, [1, -1, 0, -1, -1])]
        [[1.0, 0.5], [0.5, 1.0], [1.0, 1.0]]
    """
    found, left = [], [Cell(X.bounding_box(), X)]
    for axis in axes:
        if not left or not -1 <= axis < X.dimension:
            break
        cell = left.pop()
        if axis < 0:
            found.append(cell)
        else:
            left += halves_along(X, cell.box, int(axis))[::-1]
    else:
        if not left:
            return found
    raise ValueError(
        f"axes must be those of a tree over {X.dimension} coordinates, but {axes} arrived"
    )


def _reached(X: AbstractSet, boxes: Iterable[Box]) -> list[Cell]:
    """What a set has in common with boxes, but for those that it surely does not reach."""
    if isinstance(X, Box):
        return [Cell(box, X.cut(box)) for box in boxes if not X.misses(box)]
    return [Cell(box, _within(X, box)) for box in boxes if not X.misses(box)]


def _within(X: AbstractSet, box: Box) -> AbstractSet:
    """The points of a set that lie in a box, and few others."""
    room = TOUCHING * jnp.max(box.widths)
    larger = Box(box.lower - room, box.upper + room)
    for around in (box, larger):
        cell = _cut(X, around)
        try:
            cell.sample(jax.random.key(0), ENOUGH)
        except (ValueError, RuntimeError):  # too thin to be told from an empty set
            continue
        return cell
    return _behind_a_tangent(_cut(X, larger), larger)


def _cut(X: AbstractSet, box: Box) -> AbstractSet:
    """The points of a set that lie in a box."""
    polytope, ball = X.parts
    polytope = polytope.cut(box) if polytope else box
    return Intersection(polytope, ball) if ball else polytope


def _behind_a_tangent(cell: AbstractSet, box: Box) -> AbstractSet:
    """What facets leave of a box from which an ellipsoid cuts little."""
    (A, b), (_, ball) = cell.facets, cell.parts
    if ball is None:
        return box
    direction = ball.normal_towards(box)[None]
    top = ball.support(direction)
    return Polytope(jnp.concatenate([A, direction]), jnp.concatenate([b, top]))
