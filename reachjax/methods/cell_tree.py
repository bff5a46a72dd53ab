"""Cells of an initial set: the tree of its halvings, whose leaves cover it at any moment.

Whatever works on cells holds them nowhere else. A cell is settled, or exchanged for its halves, by
one assignment, so that an interruption, and another one while that is dealt with, loses none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from reachjax.methods.steps import boxed
from reachjax.numerics.checks import described, whole_number
from reachjax.sets import AbstractSet, Box
from reachjax.sets.cells import Cell, grid, halves_along


class Node:
    """A part of the initial set, with its halves or what is found of it.

    Args:
        lower: `(n,)`, a corner of the box that it lies in.
        upper: `(n,)`, the opposite corner.
        part: of the set; None where that is the whole box.
        parent: what it is a half of; None of a root.
        found: what is known of it; None as long as nothing is.

    Attributes:
        axis: along which coordinate it is halved; -1 where it is not.
        halves: the parts of it that the initial set reaches.
        height: so many halvings up is the part whose forms bound it; 0 where its own do.
    """

    def __init__(
        self,
        lower: Float[np.ndarray, " n"],
        upper: Float[np.ndarray, " n"],
        part: AbstractSet | None = None,
        parent: Node | None = None,
        found: Any = None,
    ):
        self.lower, self.upper, self._part = lower, upper, part
        self.parent, self.found = parent, found
        self.axis, self.halves, self.height = -1, list[Node](), 0

    @classmethod
    def of(cls, cell: Cell, parent: Node | None = None) -> Node:
        """The node of a cell."""
        return cls(np.asarray(cell.box.lower), np.asarray(cell.box.upper), cell.part, parent)

    @cached_property
    def box(self) -> Box:
        """The box that it lies in."""
        return Box(self.lower, self.upper)

    @property
    def is_box(self) -> bool:
        """Whether it is a box, and no part of another set."""
        return self.part.intervals is not None

    @property
    def part(self) -> AbstractSet:
        """The part of the set."""
        return self.box if self._part is None else self._part

    @property
    def ends(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lower and upper corner of its box."""
        return self.lower, self.upper

    @property
    def widths(self) -> Float[np.ndarray, " n"]:
        """The lengths of its box's sides."""
        return self.upper - self.lower

    @property
    def depth(self) -> int:
        """The number of halvings from its root."""
        return 0 if self.parent is None else 1 + self.parent.depth

    def before(self, generations: int) -> Node | None:
        """The ancestor this many halvings up; None above the root."""
        node: Node | None = self
        for _ in range(generations):
            node = node and node.parent
        return node

    @property
    def source(self) -> Node:
        """The part whose forms bound it."""
        node = self.before(self.height)
        assert node is not None  # it has one
        return node

    @property
    def parts(self) -> Iterator[Node]:
        """The node and all below it, each half with all of its own before the next."""
        left = [self]
        while left:
            node = left.pop()
            yield node
            left += node.halves[::-1]

    @property
    def axes(self) -> list[int]:
        """Along which coordinates it and its parts are halved, as `from_tree` takes them."""
        return [node.axis if node.halves else -1 - node.height for node in self.parts]

    @property
    def leaves(self) -> list[Node]:
        """The cells that cover it: of its parts those that are not halved."""
        return [node for node in self.parts if not node.halves]


class CellTree:
    """The cells of a set.

    Args:
        X: the set.
        roots: cells that cover it.
        most: how many there may be; None for any number.

    Attributes:
        roots: as given.
        most: as given.
        count: how many there are that are bounded by forms of their own.
        sides: `(n,)`, of the box around the set, by which those of cells are measured; 1 where it
            is flat.
    """

    def __init__(self, X: AbstractSet, roots: Sequence[Node], most: int | None = None):
        self._X, self.roots, self.most = X, roots, most
        self.count = len(roots)
        box = boxed(X, "X0")
        sides = np.asarray(box.upper) - np.asarray(box.lower)
        self.sides = np.where(sides > 0, sides, 1.0)

    @classmethod
    def whole(cls, X: AbstractSet, most: int | None = None) -> CellTree:
        """The set itself, as one cell."""
        return cls(X, [Node.of(Cell(boxed(X, "X0"), X))], most)

    @classmethod
    def over(cls, X: AbstractSet, cells: Any) -> CellTree:
        """The equal parts that a user asks for, or the whole set and how many parts it may have.

        Raises:
            TypeError: `cells` is neither a number nor one for each coordinate.
            ValueError: there is not a positive number for each coordinate.
        """
        if isinstance(cells, np.ndarray | jax.Array) and cells.ndim < 2:
            cells = cells.tolist()
        if isinstance(cells, int | np.integer):
            return cls.whole(X, whole_number("cells", cells, 1))
        if isinstance(cells, Sequence) and not isinstance(cells, str):
            return cls(X, [Node.of(cell) for cell in grid(X, cells)])
        raise TypeError(
            "cells must be a whole number, or one for each coordinate, but "
            f"{described(cells)} arrived"
        )

    @property
    def leaves(self) -> list[Node]:
        """All cells, which cover the set."""
        return [leaf for root in self.roots for leaf in root.leaves]

    @property
    def is_full(self) -> bool:
        """Whether there may be no more cells that are bounded on their own."""
        return self.most is not None and self.count >= self.most

    def longest(self, node: Node) -> int:
        """The coordinate along which a cell is longest, in parts of the set's sides."""
        return int(np.argmax(node.widths / self.sides))

    def volume(self, node: Node) -> float:
        """The volume of a cell's box, in parts of the set's."""
        return float(np.prod(node.widths / self.sides))

    def halvings(self, node: Node) -> int:
        """How often a box of the set's size was halved to get one of this size."""
        widths = node.widths
        flat = widths > 0
        return -round(float(np.log2(widths[flat] / self.sides[flat]).sum()))

    def can_halve(self, node: Node, axis: int) -> bool:
        """Whether a cell has an inside along a coordinate, and there may be more cells."""
        lower, upper = node.lower[axis], node.upper[axis]
        return not self.is_full and bool(lower < (lower + upper) / 2 < upper)

    def halved(self, node: Node, axis: int) -> list[Node]:
        """The halves of a cell that the set reaches, which do not stand in its place yet."""
        if self._X.intervals is None:
            return [Node.of(cell, node) for cell in halves_along(self._X, node.box, axis)]
        along = np.arange(len(node.lower)) == axis
        middle = (node.lower + node.upper) / 2
        below, above = np.where(along, middle, node.upper), np.where(along, middle, node.lower)
        return [Node(node.lower, below, None, node), Node(above, node.upper, None, node)]

    def replace(self, node: Node, halves: list[Node], axis: int) -> None:
        """Let halves stand in the place of a cell, perhaps halved themselves already."""
        node.axis = axis
        node.halves = halves  # from here on they stand there
        own = sum(not leaf.height for leaf in node.leaves)
        self.count += own - (not node.height)
