"""Products added round by round, on the host: solve, see what the moments violate, solve again.

A moment matrix `X` stands for the worst trajectories that the products so far allow. On a true
trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit norm)
name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from reachjax.loops.units import Mark
from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import presolved
from reachjax.programs.relaxations import CuttingPlanes, FactLayout, LocalBounds, Products

VIOLATED = 1e-6
"""Products more negative than this are, rows of facts and the basis being of unit size."""

NONE = np.zeros((0, 2), dtype=int)
"""No pairs of facts."""


class CutPool:
    """The facts of a program that say something, and which of their products may be added.

    To begin with there are the products of the first set's facets and of the units that switch.
    What else `LocalBounds` has may be added like any other product.
    """

    def __init__(self, program: Program, layout: FactLayout):
        normal, products = presolved(program), program.products
        facts, self.columns = normal.generators.rows, normal.columns
        norms = np.sqrt((facts**2).sum(axis=1))
        linear = np.arange(len(norms)) < len(layout.linear)
        self.live = np.flatnonzero((norms > 0) & np.isfinite(norms) & linear)
        self.rows = facts[self.live] / norms[self.live, None]
        self.place = np.full(len(norms), -1)
        self.place[self.live] = np.arange(len(self.live))
        kept = np.isin(np.arange(len(products.free)), normal.kept)
        self.core = restricted(products, kept & _of_facts(products, _first(program, layout)))
        self.open = np.triu(np.ones((len(self.live),) * 2, dtype=bool), 1)
        self.open[self._entries(np.stack([self.core.left, self.core.right], axis=1))] = False
        self.layout = layout

    @cached_property
    def of_local_bounds(self) -> Bool[np.ndarray, "m m"]:
        """What `LocalBounds` has beyond the products to begin with."""
        groups, _ = LocalBounds(repeated=False).groups(self.layout)
        pairs = np.array(list(itertools.chain(*groups)), dtype=int).reshape(-1, 2)
        there = np.zeros_like(self.open)
        there[self._entries(pairs)] = True
        slopes = self.place[np.array(self.layout.products(Mark.SLOPE), dtype=int).reshape(-1, 2)]
        p, q = (places[places >= 0] for places in slopes.T)
        there[np.ix_(p, q)] = there[np.ix_(q, p)] = True
        return there & self.open

    def _entries(self, pairs: Int[np.ndarray, "p 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Where these pairs stand, those of facts that say something."""
        left, right = np.sort(self.place[pairs], axis=1).T
        return left[left >= 0], right[left >= 0]

    def addable(self, pairs: Int[np.ndarray, "p 2"]) -> Int[np.ndarray, "q 2"]:
        """The pairs among these that may be added."""
        places = np.sort(self.place[pairs], axis=1)
        return pairs[(places[:, 0] >= 0) & self.open[tuple(places.T)]]

    def missing(self, pairs: Int[np.ndarray, "p 2"]) -> Int[np.ndarray, "q 2"]:
        """What `LocalBounds` has beyond these and the products to begin with."""
        return self.live[np.argwhere(self._besides(pairs, self.of_local_bounds))]

    def _besides(
        self, pairs: Int[np.ndarray, "p 2"], entries: Bool[np.ndarray, "m m"]
    ) -> Bool[np.ndarray, "m m"]:
        """The entries among these that are none of the pairs."""
        besides = entries.copy()
        besides[self._entries(pairs)] = False
        return besides

    def violated(
        self, moment: Float[np.ndarray, "n n"], pairs: Int[np.ndarray, "p 2"], batch: int | None
    ) -> Int[np.ndarray, "q 2"]:
        """The most violated pairs that are not there yet; None for all that `LocalBounds` has."""
        allowed = self._besides(pairs, self.of_local_bounds if batch is None else self.open)
        X = moment[np.ix_(self.columns, self.columns)]
        values = np.where(allowed, self.rows @ X @ self.rows.T, 0.0)
        count = int((values < -VIOLATED).sum())
        count = count if batch is None else min(batch, count)
        if not count:
            return NONE
        worst = np.argpartition(values, count - 1, axis=None)[:count]
        return self.live[np.stack(np.unravel_index(worst, values.shape), axis=1)]


def _first(program: Program, layout: FactLayout) -> Bool[np.ndarray, " m"]:
    """The facts whose products a program begins with."""
    there = (program.facts.mid != 0).any(axis=1)
    first = np.zeros(len(there), dtype=bool)
    first[[0, *layout.set_facets[0], *layout.cone_rows]] = True
    for units in layout.units:
        paired = [units.rows[name] for name in dict.fromkeys(itertools.chain(*units.kind.zero))]
        # a smooth unit has no facts but those of its bounds
        blocks = paired or units.marked(Mark.SECTOR) or units.marked(Mark.BOUND)
        switching = there[np.array(blocks, dtype=int)].all(axis=0)
        first[np.array(list(units.rows.values()))[:, switching]] = True
    return first


def _of_facts(products: Products, facts: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " K"]:
    """Which multipliers weigh products of these facts alone."""
    other = ~(facts[products.left] & facts[products.right])
    return np.bincount(products.multiplier, other, len(products.free)) == 0


def restricted(products: Products, kept: np.ndarray) -> Products:
    """The products of these multipliers."""
    number, there = np.cumsum(kept) - 1, kept[products.multiplier]
    left, right, sign = (part[there] for part in (products.left, products.right, products.sign))
    return Products(left, right, sign, number[products.multiplier[there]], products.free[kept])


def joint(core: Products, pairs: Int[np.ndarray, "p 2"]) -> Products:
    """Products and pairs of a multiplier each."""
    count, more = len(core.free), len(pairs)
    added: tuple[Any, ...] = (
        pairs[:, 0],
        pairs[:, 1],
        np.ones(more),
        count + np.arange(more),
        np.zeros(more, dtype=bool),
    )
    own = core.left, core.right, core.sign, core.multiplier, core.free
    joined: Any = [np.concatenate(both) for both in zip(own, added, strict=True)]
    return Products(*joined)


IDLE = 1e-7
"""Multipliers below this part of the largest are at zero."""

Witness = Callable[[int, Float[np.ndarray, " n"]], float]
"""The value of a facet that a simulation attains, given its number and a moment's last column."""


class Rounds(NamedTuple):
    """By what products are added.

    Attributes:
        layout: of the program's facts.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain of a facet; rounds do not stop for them if it is None.
        warm_start: products that the first facet begins with, those that may be added.
        budget: of the time.
    """

    layout: FactLayout
    cuts: CuttingPlanes
    witness: Witness | None = None
    warm_start: Int[np.ndarray, "p 2"] = NONE
    budget: Budget = ENDLESS


class Shown(NamedTuple):
    """What one round shows: the moments, which added products are idle, whether that is enough."""

    moment: Float[np.ndarray, "n n"]
    idle: Bool[np.ndarray, " p"]
    enough: bool = False


def idle(multipliers: Float[np.ndarray, " K"], added: int) -> Bool[np.ndarray, " p"]:
    """Which of the products added, the last ones, have a multiplier at zero."""
    largest = abs(multipliers).max(initial=0.0)
    return multipliers[len(multipliers) - added :] <= IDLE * largest


def in_rounds(
    pool: CutPool,
    rounds: Rounds,
    pairs: Int[np.ndarray, "p 2"],
    solve: Callable[[Int[np.ndarray, "q 2"]], Shown],
) -> Int[np.ndarray, "q 2"]:
    """Solve and add what is violated, by turns; returns what there was at last.

    Products that stay idle for two rounds are dropped. When there are enough or the rounds have run
    out, the products of `LocalBounds` that are violated are added all the same, until none is: no
    bound is looser than its.

    Args:
        pool: what may be added.
        rounds: how many, of how many products, and until when.
        pairs: what is added from the beginning.
        solve: what a round with these products shows.
    """
    cuts = rounds.cuts
    resting = np.zeros(len(pairs), dtype=bool)
    for number in itertools.count():
        shown = solve(pairs)
        if rounds.budget.late:
            break
        if not np.isfinite(shown.moment).all():
            if number == 0 and len(missing := pool.missing(pairs)):
                pairs = np.concatenate([pairs, missing])  # no moment to choose by: all that is due
                solve(pairs)
            break
        last = shown.enough or number >= cuts.rounds
        more = pool.violated(shown.moment, pairs, None if last else cuts.batch)
        if not len(more):
            break
        kept = np.full(len(pairs), True) if last else ~(resting & shown.idle)
        pairs = np.concatenate([pairs[kept], more])
        resting = np.concatenate([shown.idle[kept], np.zeros(len(more), dtype=bool)])
    return pairs
