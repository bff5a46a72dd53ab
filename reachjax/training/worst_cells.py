"""Cells of an initial set to train on: those of which a decision proved least, and some others."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from reachjax.methods.cell_tree import CellTree, Node
from reachjax.sets import Box
from reachjax.verdicts.verdict import DecidedCell, VerdictStatus

OTHERS = 4
"""One in so many cells is drawn from those that are not the worst, so that these stay as good."""


def worst_cells(
    X0: Box, known: Sequence[DecidedCell], cells: int, count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "c n"], Float[np.ndarray, "c n"]]:
    """Corners of cells where margins are least, of which there may be fewer than asked for.

    The set is halved where least is proved, into as many cells as asked for: a cell is as bad as
    the worst one within that was decided.

    Args:
        X0: the initial set.
        known: cells that were decided, if any were.
        cells: into how many the set is cut.
        count: how many of these are returned.
        rng: draws those that are not the worst.

    Example:
        >>> lower, upper = worst_cells(Box([0.0], [4.0]), (), 4, 4, np.random.default_rng(0))
        >>> sorted(zip(lower.ravel().tolist(), upper.ravel().tolist()))
        [(0.0, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, 4.0)]
    """
    tree, number = CellTree.whole(X0), itertools.count()
    lower = np.array([cell.lower for cell in known]).reshape(len(known), X0.dimension)
    upper = np.array([cell.upper for cell in known]).reshape(len(known), X0.dimension)
    proved = np.array([cell.status is VerdictStatus.PROVED for cell in known], bool)
    margins = np.array([cell.margin for cell in known])
    flat = np.asarray(X0.widths) == 0

    def entry(node: Node) -> tuple[bool, float, float, int, Node]:
        shared = np.minimum(upper, node.upper) - np.maximum(lower, node.lower)
        inside = ((shared > 0) | flat).all(axis=1)
        done = bool(inside.any() and proved[inside].all())
        open_ones = inside if done else inside & ~proved
        least = float(margins[open_ones].min(initial=np.inf if done else 0.0))
        least = -np.inf if np.isnan(least) or not inside.any() else least
        return done, least, -tree.volume(node), next(number), node

    queue = [entry(node) for node in tree.leaves]
    while len(queue) < cells:
        *_, node = heapq.heappop(queue)
        axis = tree.longest(node)
        if not tree.can_halve(node, axis):  # it is a point, and so are all others
            heapq.heappush(queue, (True, np.inf, 0.0, next(number), node))
            break
        for half in tree.halved(node, axis):
            heapq.heappush(queue, entry(half))
    ranked = [node for *_, node in sorted(queue, key=lambda one: one[:4])]
    worst = ranked[: count - count // OTHERS]
    rest = ranked[len(worst) :]
    picked = rng.permutation(len(rest))[: count - len(worst)]
    chosen = [*worst, *(rest[k] for k in picked)]
    return np.array([node.lower for node in chosen]), np.array([node.upper for node in chosen])
