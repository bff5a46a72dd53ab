"""Whether sets cover another one, as its cells do: what each leaves out of it is beside a box."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.sets.base import AbstractSet
from reachjax.sets.box import Box

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
        cut = _cut(piece, there if len(there) else known)
        if not len(there) and X.misses(Box(*map(jnp.asarray, piece))):
            continue
        if cut is None:
            return False
        axis, value = cut
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


def _cut(piece: Ends, boxes: Float[np.ndarray, "c 2 n"]) -> tuple[int, float] | None:
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
