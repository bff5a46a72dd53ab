"""Where facts stand among the rows of a program: a list of blocks with names.

First the constant 1, then for each step of a window the facets of its set and the facts of its
units, those of one kind of unit together and block by block; last the rows of the first set's cone.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from functools import cached_property

from reachjax.loops.units import Facts, Mark, Product

Pair = tuple[int, int]
"""Two rows, by their numbers."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """The facts of all units of one kind in one step, without their rows.

    Attributes:
        size: how many units there are.
        blocks: names and marks of the blocks of facts.
        zero: blocks whose product is zero.
        products: of blocks, that relaxations may take.
    """

    size: int
    blocks: tuple[tuple[str, Mark], ...]
    zero: tuple[tuple[str, str], ...]
    products: tuple[Product, ...]

    @classmethod
    def of(cls, facts: Facts) -> Kind:
        """The kind of these facts, whose rows are `(k, n)`."""
        blocks = tuple((block.name, block.mark) for block in facts.blocks)
        return cls(len(facts.blocks[0].rows.mid), blocks, facts.zero, facts.products)


@dataclasses.dataclass(frozen=True)
class StepFacts:
    """The facts of one step: how many facets its set has, and the kinds of its units."""

    facets: int
    kinds: tuple[Kind, ...]


@dataclasses.dataclass(frozen=True)
class UnitRows:
    """Where the facts of the units of one kind in one step stand.

    Attributes:
        kind: of the units.
        rows: those of each block, by its name.
    """

    kind: Kind
    rows: dict[str, range]

    def marked(self, mark: Mark) -> list[range]:
        """The rows of the blocks that bear this mark."""
        return [self.rows[name] for name, its in self.kind.blocks if its is mark]


@dataclasses.dataclass(frozen=True)
class FactLayout:
    """Where each fact stands among the rows.

    Attributes:
        steps: of the window.
        cone: rows of the first set's cone fact, the level first; 0 when it has none.
    """

    steps: tuple[StepFacts, ...]
    cone: int = 0

    @cached_property
    def _blocks(self) -> tuple[list[range], list[UnitRows], range]:
        """Rows of the facets of each step, of the units of each step and kind, and of the cone."""
        end = 1

        def following(count: int) -> range:
            nonlocal end
            end += count
            return range(end - count, end)

        facets, units = [], []
        for step in self.steps:
            facets.append(following(step.facets))
            for kind in step.kinds:
                rows = {name: following(kind.size) for name, _ in kind.blocks}
                units.append(UnitRows(kind, rows))
        return facets, units, following(self.cone)

    @property
    def set_facets(self) -> Sequence[range]:
        """Facets of each set of states."""
        return self._blocks[0]

    @property
    def units(self) -> Sequence[UnitRows]:
        """Facts of the units, step by step and kind by kind."""
        return self._blocks[1]

    @property
    def cone_rows(self) -> range:
        """The level `s`, then the rows `R` with `|R x| <= s`."""
        return self._blocks[2]

    @property
    def linear(self) -> range:
        """Every fact but the cone."""
        return range(self.cone_rows.start)

    def marked(self, mark: Mark) -> list[int]:
        """Facts of units that rest on this, one block after the other."""
        wanted = {block: None for units in self.units for block in units.kind.blocks}
        found = (
            units.rows[name]
            for name, its in wanted
            if its is mark
            for units in self.units
            if (name, its) in units.kind.blocks
        )
        return list(itertools.chain(*found))

    @property
    def zero(self) -> list[Pair]:
        """Facts whose product is zero, step by step."""
        return [
            pair
            for units in self.units
            for left, right in units.kind.zero
            for pair in zip(units.rows[left], units.rows[right], strict=True)
        ]

    def products(self, mark: Mark) -> list[Pair]:
        """Facts of one unit whose product is of use and rests on this, product after product."""
        wanted = {p: None for units in self.units for p in units.kind.products if p.mark is mark}
        return [
            pair
            for product in wanted
            for units in self.units
            if product in units.kind.products
            for pair in zip(units.rows[product.left], units.rows[product.right], strict=True)
        ]
