"""Cells: parts of a set that cover it, cut along coordinates.

A cell that is too thin to be told from an empty set is made larger, and then holds points beside
the set; none is left out unless a separating direction proves it empty.

Parts cover a set if what each leaves out of it is beside a box.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.checks import is_concrete, whole_number
from reachjax.sets.base import AbstractSet, Box
from reachjax.sets.intersection import Intersection
from reachjax.sets.polytope import Polytope

TOUCHING = 1e-6
"""A cell that a set barely touches is enlarged by this part of its box."""

ENOUGH = 1000
"""A cell from which so many points cannot be drawn is too thin."""


class Cell(NamedTuple):
    """The part of a set that lies in a box, or a little more.

    Attributes:
        box: the box.
        part: the part of the set.
        source: the cell that it is a part of and whose bounds are its own; None if it has its own.
    """

    box: Box
    part: AbstractSet
    source: Cell | None = None

    @property
    def whole(self) -> Cell:
        """The cell whose bounds are its own: its source, or itself."""
        return self.source or self


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
    xp = np if is_concrete(box) else jnp  # numpy knows subnormal numbers, XLA does not
    lower, upper = xp.asarray(box.lower), xp.asarray(box.upper)

    def ends(index: np.ndarray) -> Float[Array, "cells n"]:
        within = index * ((upper - lower) / many) + lower
        return jnp.asarray(xp.where(index == many, upper, within))  # exact ends

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
            its own before the next: along which coordinate it is halved, or -1 if it is not. A
            cell may also have -2, -3, ...: what is proved of it is proved of what it is a part of,
            1, 2, ... halvings before.

    Raises:
        ValueError: an entry is missing, is left over, or is no coordinate.

    Example:
        >>> X = Box([0.0, 0.0], [1.0, 1.0])
        >>> [cell.box.upper.tolist() for cell in from_tree(X, [1, -1, 0, -1, -1])]
        [[1.0, 0.5], [0.5, 1.0], [1.0, 1.0]]
    """
    found, left = [], [(Cell(X.bounding_box(), X),)]  # each behind all that it is a part of
    for axis in axes:
        if not left or not -len(left[-1]) <= axis < X.dimension:
            break
        line = left.pop()
        if axis < 0:
            source = None if axis == -1 else line[int(axis)]
            found.append(line[-1]._replace(source=source))
        else:
            halves = halves_along(X, line[-1].box, int(axis))
            left += [(*line, half) for half in halves[::-1]]
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
    return Intersection(polytope, cast(Any, ball)) if ball else polytope


def _behind_a_tangent(cell: AbstractSet, box: Box) -> AbstractSet:
    """What facets leave of a box from which an ellipsoid cuts little."""
    (A, b), (_, ball) = cell.facets, cell.parts
    if ball is None:
        return box
    direction = ball.normal_towards(box)[None]
    top = ball.support(direction)
    return Polytope(jnp.concatenate([A, direction]), jnp.concatenate([b, top]))


Ends = Float[np.ndarray, "2 n"]
"""Lower and upper ends of a box."""


def covers(parts: Sequence[AbstractSet], X: AbstractSet) -> bool:
    """Whether each point of a set surely is in one of its parts; False where that is not seen.

    A part is seen to hold what the set has in some box if each of its facets holds all of the set
    or is a side of the box, and its ellipsoid is the set's.

    Example:
        >>> cells = [Box([0.0], [1.0]), Box([1.0], [3.0])]
        >>> covers(cells, Box([0.0], [2.0])), covers(cells[1:], Box([0.0], [2.0]))
        (True, False)
    """
    boxes = [box for part in parts if (box := _box_of(part, X)) is not None]
    if not boxes:
        return False
    around = X.bounding_box()
    known = np.stack(boxes)
    left = [(np.stack([np.asarray(around.lower), np.asarray(around.upper)]), known)]
    while left:
        piece, there = left.pop()
        inside = (there[:, 0] <= piece[0]).all(axis=1) & (there[:, 1] >= piece[1]).all(axis=1)
        if inside.any():
            continue
        meets = (there[:, 0] < piece[1]).all(axis=1) & (there[:, 1] > piece[0]).all(axis=1)
        there = there[meets]
        place = _edge(piece, there if len(there) else known)
        if not len(there) and X.misses(Box(*map(jnp.asarray, piece))):
            continue
        if place is None:
            return False
        axis, value = place
        for end in (0, 1):
            half = piece.copy()
            half[1 - end, axis] = value
            left.append((half, there))
    return True


def _box_of(part: AbstractSet, X: AbstractSet) -> Ends | None:
    """A box of which a part holds all that the set has there; None if none is seen."""
    if not _same_ball(part, X):
        return None
    own = np.column_stack(X.facets)
    n = X.dimension
    ends = np.stack([np.full(n, -np.inf), np.full(n, np.inf)])
    for row in np.column_stack(part.facets):
        normal, offset = row[:-1], row[-1]
        if (own == row).all(axis=1).any():
            continue
        (there,) = np.nonzero(normal)
        if len(there) != 1 or abs(normal[there[0]]) != 1.0:
            if offset >= X.support(normal[None])[0]:
                continue
            return None
        i, side = there[0], int(normal[there[0]] > 0)
        ends[side, i] = min(ends[side, i], offset) if side else max(ends[side, i], -offset)
    return ends


def _same_ball(part: AbstractSet, X: AbstractSet) -> bool:
    (_, own), (_, ball) = part.parts, X.parts
    if own is None or ball is None:
        return own is None
    pairs = (own.center, ball.center), (own.shape, ball.shape)
    return all(np.array_equal(*pair) for pair in pairs)


def _edge(piece: Ends, boxes: Float[np.ndarray, "c 2 n"]) -> tuple[int, float] | None:
    """A side of a box that goes through a piece, through as few other boxes as may be."""
    best, fewest = None, len(boxes) + 1
    for axis in range(piece.shape[1]):
        lower, upper = boxes[:, 0, axis], boxes[:, 1, axis]
        values = np.unique(np.concatenate([lower, upper]))
        values = values[(values > piece[0, axis]) & (values < piece[1, axis])]
        if not len(values):
            continue
        split = ((lower[:, None] < values) & (upper[:, None] > values)).sum(axis=0)
        middle = (piece[0, axis] + piece[1, axis]) / 2
        k = np.lexsort((abs(values - middle), split))[0]
        if split[k] < fewest:
            best, fewest = (axis, float(values[k])), int(split[k])
    return best
