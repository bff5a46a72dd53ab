"""Which products of facts enter the semidefinite program: that choice is the relaxation.

Facts are stacked as `[1; facets of the set; z; z - y; caps of z; caps of z - y]`, all but the first
once for each step of a window. The product of two of them is never negative on a trajectory, the
product `z (z - y)` is zero there. Weighted by multipliers they form `F' Gamma F` (propositions 1-2
and lemma 1 of the paper, and what others add to them). A diagonal entry of `Gamma` would only add a
positive semidefinite term, which never helps, so there is none; but an ellipsoid's rows come
squared, `s^2 - |R x|^2 >= 0`, in every relaxation (proposition 2).
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.numerics.checks import real_number, whole_number
from reachjax.numerics.pytrees import Replaceable, pytree


@dataclasses.dataclass(frozen=True)
class FactLayout:
    """Where each kind of fact stands among the rows.

    First the constant 1, then for each step of the window the facets of its set and the facts of
    its units, last the cone.

    Attributes:
        facets: of the set of states at each step of the window.
        units: of the loop.
        cone: rows of the first set's cone fact, the level first; 0 when it has none.
    """

    facets: tuple[int, ...]
    units: int
    cone: int = 0

    @property
    def steps(self) -> int:
        """How many steps the window has."""
        return len(self.facets)

    def _first(self, step: int) -> int:
        """The first row of a step."""
        return 1 + sum(self.facets[:step]) + 4 * self.units * step

    def _kind(self, number: int) -> tuple[int, ...]:
        """One kind of fact of every unit, step after step."""
        firsts = [
            self._first(step) + self.facets[step] + number * self.units
            for step in range(self.steps)
        ]
        return tuple(itertools.chain(*(range(first, first + self.units) for first in firsts)))

    @property
    def set_facets(self) -> tuple[range, ...]:
        """Facets of each set of states."""
        firsts = [self._first(step) for step in range(self.steps)]
        return tuple(
            range(first, first + count) for first, count in zip(firsts, self.facets, strict=True)
        )

    @property
    def output(self) -> tuple[int, ...]:
        """`z >= 0`."""
        return self._kind(0)

    @property
    def slack(self) -> tuple[int, ...]:
        """`z - y >= 0`."""
        return self._kind(1)

    @property
    def output_cap(self) -> tuple[int, ...]:
        """`max(u, 0) - z >= 0`."""
        return self._kind(2)

    @property
    def slack_cap(self) -> tuple[int, ...]:
        """`max(-l, 0) - (z - y) >= 0`."""
        return self._kind(3)

    @property
    def linear(self) -> range:
        """Every fact but the cone."""
        return range(self._first(self.steps))

    @property
    def cone_rows(self) -> range:
        """The level `s`, then the rows `R` with `|R x| <= s`."""
        first = self._first(self.steps)
        return range(first, first + self.cone)


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

    @abc.abstractmethod
    def groups(self, facts: FactLayout) -> tuple[list[list[tuple[int, int]]], int]:
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

    Products: facet x facet of the set (`Gamma` of proposition 1), `1 x z` (`eta`), `1 x (z - y)`
    (`nu`), the free `z (z - y)` (`lambda_i`), and with `repeated` the slope restriction between
    neurons (`lambda_ij` of lemma 1), which is `z_i (z_j - y_j) + z_j (z_i - y_i)` once the
    complementarities hold.

    Args:
        repeated: whether to include `lambda_ij`.
        remove_stable: whether neurons that interval bounds prove to be affine leave the basis,
            which the paper does not do.
    """

    repeated: bool = True
    remove_stable: bool = False

    def groups(self, facts: FactLayout) -> tuple[list[list[tuple[int, int]]], int]:
        """Free complementarities, then `Gamma`, `eta`, `nu`, `lambda_ij`."""
        free = [[pair] for pair in zip(facts.output, facts.slack, strict=True)]
        within = (itertools.combinations(facets, 2) for facets in facts.set_facets)
        signed = [[pair] for pair in itertools.chain(*within)]
        signed += [[(0, i)] for i in (*facts.output, *facts.slack)]
        if self.repeated:
            signed += _crossed(facts)
        return free + signed, len(free)


@dataclasses.dataclass(frozen=True)
class LocalBounds(AbstractRelaxation):
    """The paper's constraints and those that pre-activation bounds `l <= y <= u` give.

    Adds `z (u - z)`, `(z - y) (-l - (z - y))` and `(u - z) (-l - (z - y))`, the last being the
    triangle relaxation; stable neurons leave the basis. This is what the authors' code and DeepSDP
    (Fazlyab, Morari, Pappas, 2020) use.

    Args:
        repeated: whether to include `lambda_ij`.
        remove_stable: whether neurons that interval bounds prove to be affine leave the basis.
    """

    repeated: bool = True
    remove_stable: bool = True

    def groups(self, facts: FactLayout) -> tuple[list[list[tuple[int, int]]], int]:
        """The paper's groups, then the products of caps."""
        groups, free = PaperQC(self.repeated).groups(facts)
        for left, right in (
            (facts.output, facts.output_cap),
            (facts.slack, facts.slack_cap),
            (facts.output_cap, facts.slack_cap),
        ):
            groups += [[pair] for pair in zip(left, right, strict=True)]
        return groups, free


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

    def groups(self, facts: FactLayout) -> tuple[list[list[tuple[int, int]]], int]:
        """Free complementarities, then every other pair."""
        free = [[pair] for pair in zip(facts.output, facts.slack, strict=True)]
        vanishing = {pair for (pair,) in free}
        pairs = [
            [pair] for pair in itertools.combinations(facts.linear, 2) if pair not in vanishing
        ]
        return free + pairs, len(free)


@dataclasses.dataclass(frozen=True)
class CuttingPlanes(AbstractRelaxation):
    """Of all products of two facts those that matter, found by the dual.

    Begins with those of `LocalBounds(repeated=False)`. The moment matrix of each facet's program
    shows which other products it violates; the worst are added, and the program is solved again.
    About as tight as `AllProducts` with a tenth of the products, and never looser than
    `LocalBounds`, whose products it has inside `jax.jit`, where the dual is not seen.

    Args:
        rounds: how often products are added, at most.
        batch: how many at a time.
        gap: rounds stop where a simulated trajectory attains the bound up to this part of the
            interval of the facet.
        remove_stable: whether neurons that bounds prove to be affine leave the basis.

    Raises:
        TypeError: `rounds` or `batch` is no whole number, or `gap` is no number.
        ValueError: one of them is negative, or the batch is empty.
    """

    rounds: int = 8
    batch: int = 60
    gap: float = 1e-4
    remove_stable: bool = True

    linear_bounds: ClassVar[bool] = True

    def __post_init__(self):
        whole_number("CuttingPlanes.rounds", self.rounds, 0)
        whole_number("CuttingPlanes.batch", self.batch, 1)
        real_number("CuttingPlanes.gap", self.gap, 0.0)

    def groups(self, facts: FactLayout) -> tuple[list[list[tuple[int, int]]], int]:
        """The products to begin with."""
        return LocalBounds(repeated=False).groups(facts)


def _crossed(facts: FactLayout) -> list[list[tuple[int, int]]]:
    """`z_i (z_j - y_j)` and `z_j (z_i - y_i)` under one multiplier, for every pair of neurons."""
    z, r = facts.output, facts.slack
    return [[(z[i], r[j]), (z[j], r[i])] for i, j in itertools.combinations(range(len(z)), 2)]
