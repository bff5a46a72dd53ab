"""Which products of facts enter the semidefinite program: that choice is the relaxation.

Facts are stacked in blocks with names: first the constant 1, then for each step of a window the
facets of its set and the facts of its units, those of one kind of unit together and block by block;
last the rows of the first set's cone. The product of two of them is never negative on a trajectory,
and some are zero there, such as `z (z - y)` of a ReLU. Weighted by multipliers they form `F' Gamma
F` (propositions 1-2 and lemma 1 of the paper, and what others add to them). Facts of units and
their products are chosen by what they rest on. A diagonal entry of `Gamma` would only add a
positive semidefinite term, which never helps, so there is none; but an ellipsoid's rows come
squared, `s^2 - |R x|^2 >= 0`, in every relaxation (proposition 2).
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.loops.units import Facts, Mark, Product
from reachjax.numerics.checks import real_number, require_kind, whole_number
from reachjax.numerics.pytrees import Replaceable, pytree

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


Groups = tuple[list[list[Pair]], int]
"""Products that share a multiplier, the free groups first, and how many are free."""


@pytree
class Products(Replaceable):
    """Pairs of facts and the multiplier that weighs each.

    Attributes:
        left: `(p,)`, row numbers of facts.
        right: `(p,)`, row numbers of facts.
        sign: `(p,)`, 1 or -1: with which sign the product enters.
        multiplier: `(p,)`, the multiplier of each pair; several pairs may share one.
        free: `(K,)`, multipliers of either sign (the product is zero); the others are `>= 0`.
    """

    left: Int[Array, " p"]
    right: Int[Array, " p"]
    sign: Float[Array, " p"]
    multiplier: Int[Array, " p"]
    free: Bool[Array, " K"]

    @property
    def of_cone(self) -> Bool[Array, " p"]:
        """Which pairs are the squares of a cone's rows `R`, `s^2 - |R x|^2 >= 0`.

        No other products are subtracted.
        """
        return self.sign < 0


class AbstractRelaxation(abc.ABC):
    """A choice of products. Hashable and immutable: it is static where code is compiled.

    A subclass has a field `remove_stable`: whether units that bounds prove to be affine leave the
    basis.

    Attributes:
        linear_bounds: whether the pre-activation bounds are those of supports and linear
            relaxations, where they are better than those of intervals.
    """

    remove_stable: bool
    linear_bounds: ClassVar[bool] = False

    def __post_init__(self):
        for name in ("repeated", "remove_stable", "programs"):
            value = getattr(self, name, True)
            require_kind(f"{type(self).__name__}.{name}", value, bool, "True or False")

    @property
    def cuts(self) -> CuttingPlanes | None:
        """By which rounds products are added; None if a program has all of them at once."""
        return None

    @abc.abstractmethod
    def groups(self, facts: FactLayout) -> Groups:
        """Pairs of facts that share a multiplier, the free groups first, and how many are free."""

    def products(self, facts: FactLayout) -> Products:
        """The pairs as index arrays."""
        groups, free = self.groups(facts)
        # s^2 - |R x|^2 >= 0 under one multiplier: the level's square less those of the other rows
        groups = groups + [[(row, row) for row in facts.cone_rows]] * (facts.cone > 0)
        pairs = np.array(list(itertools.chain.from_iterable(groups)), dtype=int).reshape(-1, 2)
        owner = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        left, right = pairs.T
        sign = np.where(np.isin(left, facts.cone_rows[1:]), -1.0, 1.0)
        signed = np.arange(len(groups)) < free
        return Products(*jax.device_put((left, right, sign, owner, signed)))


@dataclasses.dataclass(frozen=True)
class PaperQC(AbstractRelaxation):
    """The paper's quadratic constraints, every neuron in the basis unless asked otherwise.

    Products: facet x facet of the set (`Gamma` of proposition 1), and for ReLUs `1 x z` (`eta`),
    `1 x (z - y)` (`nu`), the free `z (z - y)` (`lambda_i`), and with `repeated` the slope
    restriction between neurons (`lambda_ij` of lemma 1), which is `z_i (z_j - y_j) + z_j (z_i -
    y_i)` once the complementarities hold. Of other units, what stands in their place.

    Args:
        repeated: whether to include `lambda_ij`.
        remove_stable: whether neurons that interval bounds prove to be affine leave the basis,
            which the paper does not do.

    Raises:
        TypeError: one of them is neither True nor False.
    """

    repeated: bool = True
    remove_stable: bool = False

    def groups(self, facts: FactLayout) -> Groups:
        """Free complementarities, then `Gamma`, `eta`, `nu`, `lambda_ij`."""
        free = [[pair] for pair in facts.zero]
        within = (itertools.combinations(facets, 2) for facets in facts.set_facets)
        signed = [[pair] for pair in itertools.chain(*within)]
        signed += [[(0, i)] for i in facts.marked(Mark.SECTOR)]
        signed += [[pair] for pair in facts.products(Mark.SECTOR)]
        if self.repeated:
            signed += _crossed(facts)
        return free + signed, len(free)


@dataclasses.dataclass(frozen=True)
class LocalBounds(AbstractRelaxation):
    """The paper's constraints and those that pre-activation bounds `l <= y <= u` give.

    Adds, for ReLUs, `z (u - z)`, `(z - y) (-l - (z - y))` and `(u - z) (-l - (z - y))`, the last
    being the triangle relaxation; stable neurons leave the basis. This is what the authors' code
    and DeepSDP (Fazlyab, Morari, Pappas, 2020) use.

    Args:
        repeated: whether to include `lambda_ij`.
        remove_stable: whether neurons that interval bounds prove to be affine leave the basis.

    Raises:
        TypeError: one of them is neither True nor False.
    """

    repeated: bool = True
    remove_stable: bool = True

    def groups(self, facts: FactLayout) -> Groups:
        """The paper's groups, then the products that rest on bounds."""
        groups, free = PaperQC(self.repeated).groups(facts)
        return groups + [[pair] for pair in facts.products(Mark.BOUND)], free


@dataclasses.dataclass(frozen=True)
class LinearBounds(AbstractRelaxation):
    """No products, and so no programs: affine forms over the whole horizon (`programs.affine`).

    Each unit that switches is held between two parallel lines, and everything else is affine, so
    that every state is a row over the initial state and one column for each such unit. A tube takes
    milliseconds, is compiled, differentiated and mapped over like any other JAX function, and
    loosens with the number of units that switch, not with that of steps: nothing is wrapped.

    It bounds facets, of a `Template`. Neither `window` nor `solver` matter: forms always go back to
    the initial set, and there is nothing to solve.

    Args:
        programs: whether linear programs over the facets of an `X0` that is a polytope make bounds
            tighter. Compiled code has none, and penalties, which are the same function compiled or
            not, have none either: there a polytope counts as the box around it.

    Raises:
        TypeError: `programs` is neither True nor False.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> tube = reach(loop, Box([1.0], [2.0]), 3, Template.box(1), LinearBounds())
        >>> tube.sets[3].b.round(6).tolist()
        [0.432, -0.216]
    """

    programs: bool = True
    remove_stable: bool = dataclasses.field(default=True, init=False, repr=False)

    linear_bounds: ClassVar[bool] = True

    def groups(self, facts: FactLayout) -> Groups:
        """No products of facts."""
        return [], 0


@dataclasses.dataclass(frozen=True)
class AllProducts(AbstractRelaxation):
    """Every product of two facts: the tightest relaxation of this kind, and the largest.

    The doubly nonnegative relaxation (Shor's and the reformulation-linearization technique; Burer,
    2009). The number of products grows with the square of that of the facts.

    Args:
        remove_stable: whether neurons that bounds prove to be affine leave the basis.
    """

    remove_stable: bool = True

    linear_bounds: ClassVar[bool] = True

    def groups(self, facts: FactLayout) -> Groups:
        """Free complementarities, then every other pair."""
        free = facts.zero
        vanishing = {tuple(sorted(pair)) for pair in free}
        pairs = (pair for pair in itertools.combinations(facts.linear, 2) if pair not in vanishing)
        return [[pair] for pair in (*free, *pairs)], len(free)


@dataclasses.dataclass(frozen=True)
class CuttingPlanes(AbstractRelaxation):
    """The products of two facts that matter, found by the dual.

    Begins with those of `LocalBounds(repeated=False)`. The moment matrix of each facet's program
    shows which other products it violates; the worst are added, and the program is solved again.
    About as tight as `AllProducts` with a tenth of the products, and never looser than
    `LocalBounds`, whose products it has inside `jax.jit`, where the dual is not seen.

    Args:
        rounds: how often products are added, at most.
        batch: how many at a time.
        gap: rounds stop where a simulated trajectory attains the bound up to this part of the
            interval of the facet; None for that of `reach`.
        remove_stable: whether neurons that bounds prove to be affine leave the basis.

    Raises:
        TypeError: `rounds` or `batch` is no whole number, or `gap` is no number.
        ValueError: one of them is negative, or the batch is empty.
    """

    rounds: int = 8
    batch: int = 60
    gap: float | None = None
    remove_stable: bool = True

    linear_bounds: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        whole_number("CuttingPlanes.rounds", self.rounds, 0)
        whole_number("CuttingPlanes.batch", self.batch, 1)
        if self.gap is not None:
            real_number("CuttingPlanes.gap", self.gap, 0.0)

    @property
    def cuts(self) -> CuttingPlanes:
        """The cutting planes themselves."""
        return self

    def groups(self, facts: FactLayout) -> Groups:
        """The products to begin with."""
        return LocalBounds(repeated=False).groups(facts)


@dataclasses.dataclass(frozen=True)
class BranchAndCut(AbstractRelaxation):
    """The cheapest proof first: each facet climbs a ladder only while its gap is open.

    Its affine form over the whole horizon, the linear program with all facts of the horizon, splits
    of that by the phases of units, each a linear program, and last products of facts, by
    semidefinite programs as in `CuttingPlanes`. The first three go back to the initial set and know
    how all states depend on it. Of a loop with smooth units, whose forms are of the second degree,
    the initial set, if it has no curved surface, is halved into cells instead, each with forms of
    its own: what these leave out falls with the third power of the width. Where linear programs and
    splits close most of what they leave out, each cell has these, too. Where numbers are traced
    (inside `jax.jit`), where a window is given, and for ellipsoids, it is `CuttingPlanes`.

    Args:
        nodes: how many linear programs a facet may take before it gets products.
        products_by: the rounds in which these are added.
        remove_stable: whether neurons that bounds prove to be affine leave the basis.
        cells: how many cells there may be; 1 for none, and the ladder instead.

    Raises:
        TypeError: `nodes` or `cells` is no whole number, or `products_by` is no `CuttingPlanes`.
        ValueError: `nodes` is negative, or there is no cell.

    Source: branch and cut for unrolled networks as in Bunel, Turkaslan, Torr, Kohli, Kumar (NeurIPS
    2018), with the products of Burer (2009) for cuts.
    """

    nodes: int = 10_000
    products_by: CuttingPlanes = CuttingPlanes()
    remove_stable: bool = True
    cells: int = 1000

    linear_bounds: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        whole_number("BranchAndCut.nodes", self.nodes, 0)
        whole_number("BranchAndCut.cells", self.cells, 1)
        require_kind(
            "BranchAndCut.products_by", self.products_by, CuttingPlanes, "of type CuttingPlanes"
        )

    @property
    def cuts(self) -> CuttingPlanes:
        """By which rounds products are added."""
        return self.products_by

    def groups(self, facts: FactLayout) -> Groups:
        """The products to begin with."""
        return self.products_by.groups(facts)


def _crossed(facts: FactLayout) -> list[list[Pair]]:
    """`p_i q_j` and `p_j q_i` under one multiplier, for every two products of slopes `p q`."""
    slopes = itertools.combinations(facts.products(Mark.SLOPE), 2)
    return [[(p_i, q_j), (p_j, q_i)] for (p_i, q_i), (p_j, q_j) in slopes]
